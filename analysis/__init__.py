"""From finished runs to numbers: tidy frames and statistics; no torch, no MuJoCo."""

import signal
import sys

# `python -m` is looking for one of the commands: a reader that has gone (`| head -1`) and Ctrl-C end it quietly.
if sys.argv[:1] == ["-m"]:
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # not where a shell said "ignore"
        signal.signal(signal.SIGINT, signal.SIG_DFL)
