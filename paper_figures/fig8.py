"""Figure 8: HiPPO under different time commitments."""

import sys

from paper_figures import curves

if __name__ == "__main__":
    sys.exit(curves.main("fig8"))
