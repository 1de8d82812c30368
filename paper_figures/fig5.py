"""Figure 5: HiPPO against other hierarchical methods, from scratch."""

import sys

from paper_figures import curves

if __name__ == "__main__":
    sys.exit(curves.main("fig5"))
