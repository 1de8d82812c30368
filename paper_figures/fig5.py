"""Figure 5: HiPPO against other hierarchical methods, from scratch."""

import functools
import sys

from paper_figures import curves

main = functools.partial(curves.main, "fig5")

if __name__ == "__main__":
    sys.exit(main())
