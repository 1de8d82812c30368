"""Figure 6: given skills adapted, kept fixed, and HiPPO from scratch."""

import sys

from paper_figures import curves

if __name__ == "__main__":
    sys.exit(curves.main("fig6"))
