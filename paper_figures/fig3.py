"""Figure 3: HiPPO with random, fixed and no time commitment, flat PPO, and PPO with action repeat, from scratch."""

import functools
import sys

from paper_figures import curves

main = functools.partial(curves.main, "fig3")

if __name__ == "__main__":
    sys.exit(main())
