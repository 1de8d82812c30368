"""From a configuration to finished runs: compose, train, sweep."""

import os

# One thread per training process, said before numpy or torch is imported; parallelism is over runs.
for _name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
