"""One file per figure and table of the paper; they read numbers and draw, and train nothing."""
