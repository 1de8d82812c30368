"""From a configuration to finished runs: compose, train, sweep."""

import ctypes
import os
import signal
import sys

# One thread per training process, said before numpy or torch is imported; parallelism is over runs.
for _name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

# Freed memory stays with the process: given back, its pages would be cleared anew at every gradient step, a sixth of
# its time. glibc only.
_MAP_FROM, _TRIM_FROM = -3, -1  # M_MMAP_THRESHOLD and M_TRIM_THRESHOLD of malloc.h
if hasattr(ctypes.CDLL(None), "mallopt"):
    ctypes.CDLL(None).mallopt(_MAP_FROM, 32 * 2**20)  # the largest that glibc takes
    ctypes.CDLL(None).mallopt(_TRIM_FROM, 2**31 - 1)

# `python -m` is looking for one of our commands: until that runs (experiments/command_line.py), Ctrl-C ends quietly.
if sys.argv[:1] == ["-m"] and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, signal.SIG_DFL)
