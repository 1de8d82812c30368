"""Figure 7: HIRO with and without the torso's x and y, and HiPPO."""

import sys

from paper_figures import curves

if __name__ == "__main__":
    sys.exit(curves.main("fig7"))
