"""One file per figure and table of the paper; they read numbers and draw, and train nothing."""

import analysis  # noqa: F401  its commands and these end alike when their reader has gone
