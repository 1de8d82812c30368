"""From a configuration to finished runs: compose, train, sweep."""

import ctypes
import os

# One thread per training process, said before numpy or torch is imported; parallelism is over runs.
for _name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

# Freed memory stays with the process: given back, its pages would be cleared anew at every gradient step, a sixth of
# its time. glibc only.
_MAP_FROM, _TRIM_FROM = -3, -1  # M_MMAP_THRESHOLD and M_TRIM_THRESHOLD of malloc.h
if hasattr(ctypes.CDLL(None), "mallopt"):
    ctypes.CDLL(None).mallopt(_MAP_FROM, 32 * 2**20)  # the largest that glibc takes
    ctypes.CDLL(None).mallopt(_TRIM_FROM, 2**31 - 1)
