"""Figure 9: HiPPO with different numbers of skills."""

import functools
import sys

from paper_figures import curves

main = functools.partial(curves.main, "fig9")

if __name__ == "__main__":
    sys.exit(main())
