"""Figure 3: HiPPO with random, fixed and no time commitment, flat PPO, and PPO with action repeat, from scratch."""

import sys

from paper_figures import curves

if __name__ == "__main__":
    sys.exit(curves.main("fig3"))
