"""Figure 8: HiPPO under different time commitments."""

import functools
import sys

from paper_figures import curves

main = functools.partial(curves.main, "fig8")

if __name__ == "__main__":
    sys.exit(main())
