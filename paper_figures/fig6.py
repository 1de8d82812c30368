"""Figure 6: given skills adapted, kept fixed, and HiPPO from scratch."""

import functools
import sys

from paper_figures import curves

main = functools.partial(curves.main, "fig6")

if __name__ == "__main__":
    sys.exit(main())
