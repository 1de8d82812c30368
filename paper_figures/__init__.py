"""One file per figure and table of the paper; they read numbers and draw, and train nothing."""

import os
import sys

import analysis  # noqa: F401  its commands and these end alike when their reader has gone

if "IPython" not in sys.modules:  # a notebook's shell hands down a back end that exists in the notebook only
    os.environ["MPLBACKEND"] = "agg"
