"""Figure 9: HiPPO with different numbers of skills."""

import sys

from paper_figures import curves

if __name__ == "__main__":
    sys.exit(curves.main("fig9"))
