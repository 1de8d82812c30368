"""Run tests on a stated set of a processor's kernels, and say which: `python -m tests.hippo.kernels TESTS...`.

Libraries choose when they are loaded, by variables of the environment; the first line printed is what they chose.
"""

import experiments  # noqa: F401, I001  first: one thread, as when training

import contextlib
import ctypes
import json
import os
import sys
import tempfile
from pathlib import Path

import pytest
import scipy.linalg  # noqa: F401  brings the BLAS that numba's np.dot calls
import torch
from numba.core.registry import cpu_target


CORE = ("scipy_openblas_get_corename64_", "scipy_openblas_get_corename", "openblas_get_corename")


def openblas() -> list[str]:
    """The cores that the loaded copies of OpenBLAS work for."""
    lines = Path("/proc/self/maps").read_text().splitlines()
    found = set()
    for path in sorted({line.split()[-1] for line in lines if "openblas" in line}):
        library = ctypes.CDLL(path)
        for name in CORE:
            with contextlib.suppress(AttributeError):
                function = getattr(library, name)
                function.restype = ctypes.c_char_p
                found.add(function().decode())
    return sorted(found)


def mkl() -> str:
    """The instructions in the heading that MKL prints before its first call."""
    with tempfile.TemporaryFile() as file:
        kept = os.dup(1)
        os.dup2(file.fileno(), 1)
        try:
            with torch.backends.mkl.verbose(torch.backends.mkl.VERBOSE_ON):
                torch.ones(64, 64) @ torch.ones(64, 64)
            ctypes.CDLL(None).fflush(None)
        finally:
            os.dup2(kept, 1)
        file.seek(0)
        heading = file.read().decode().partition("\n")[0]
    return heading.partition("architecture ")[2].partition(" enabled")[0]


def chosen() -> dict[str, object]:
    """What every library chose."""
    return {
        "OPENBLAS_CORETYPE": openblas(),
        "MKL_ENABLE_INSTRUCTIONS": mkl(),
        "ATEN_CPU_CAPABILITY": torch.backends.cpu.get_cpu_capability().lower(),
        "NUMBA_CPU_NAME": cpu_target.target_context.codegen().magic_tuple()[1],
    }


if __name__ == "__main__":
    print(json.dumps(chosen()), flush=True)
    sys.exit(pytest.main(["-q", "--no-header", "-p", "no:cacheprovider", "--durations=0", *sys.argv[1:]]))
