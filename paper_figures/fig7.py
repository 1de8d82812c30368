"""Figure 7: HIRO with and without the torso's x and y, and HiPPO."""

import functools
import sys

from paper_figures import curves

main = functools.partial(curves.main, "fig7")

if __name__ == "__main__":
    sys.exit(main())
