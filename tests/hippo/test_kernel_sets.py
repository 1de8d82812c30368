"""The numeric tests on other processors' kernels: each set in a process of its own, which says what was chosen."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests import ROOT

TESTS = [
    "tests/hippo/test_golden.py",
    "tests/hippo/test_single_precision.py",
    "tests/envs/test_env_golden.py",
    "tests/analysis/test_analysis.py",
]
ONLY = [
    "-k",
    "stored_ones or single_precision or as_it_was or rliable",
]  # what compares with committed or exact numbers
# What a processor must be able to do, as Linux calls it, and how the library names what it then chose.
SETS = {
    ("OPENBLAS_CORETYPE", "Nehalem"): ("sse4_2", "Nehalem"),
    ("OPENBLAS_CORETYPE", "Sandybridge"): ("avx", "Sandybridge"),
    ("OPENBLAS_CORETYPE", "Haswell"): ("fma", "Haswell"),
    ("OPENBLAS_CORETYPE", "Zen"): ("fma", "Zen|Haswell"),  # where it was built without Zen's it takes Haswell's
    ("OPENBLAS_CORETYPE", "SkylakeX"): ("avx512vl", "SkylakeX"),
    ("MKL_ENABLE_INSTRUCTIONS", "SSE4_2"): ("sse4_2", "Intel(R) Streaming SIMD Extensions 4.2 (Intel(R) SSE4.2)"),
    ("MKL_ENABLE_INSTRUCTIONS", "AVX2"): ("avx2", "Intel(R) Advanced Vector Extensions 2 (Intel(R) AVX2)"),
    ("ATEN_CPU_CAPABILITY", "default"): ("sse4_2", "default"),
    ("ATEN_CPU_CAPABILITY", "avx2"): ("avx2", "avx2"),
    ("NUMBA_CPU_NAME", "generic"): ("sse4_2", "generic"),
}
QUICK = [("OPENBLAS_CORETYPE", "Nehalem"), ("ATEN_CPU_CAPABILITY", "default")]


def processor(field: str) -> set[str]:
    """The words of a field of /proc/cpuinfo; none where there is no such file or field."""
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.exists() else []
    return next((set(line.partition(":")[2].split()) for line in lines if line.startswith(field)), set())


@pytest.mark.parametrize(
    ("variable", "value"), [pytest.param(*each, marks=() if each in QUICK else pytest.mark.slow) for each in SETS]
)
def test_the_numeric_tests_pass_on_the_kernels_of(variable, value, tmp_path):
    needs, name = SETS[variable, value]
    if needs not in processor("flags"):
        pytest.skip(f"this processor has no {needs}, which {variable}={value} needs")
    if variable == "MKL_ENABLE_INSTRUCTIONS" and "GenuineIntel" not in processor("vendor_id"):
        pytest.skip(f"{variable}={value}: MKL heeds it on Intel's processors only")
    command = [sys.executable, "-m", "tests.hippo.kernels", *TESTS, *ONLY]
    environment = {key: text for key, text in os.environ.items() if not key.startswith("PYTEST")}
    environment[variable] = value
    if variable == "NUMBA_CPU_NAME":  # no feature of this processor, nor what was compiled for it
        environment |= {"NUMBA_CPU_FEATURES": "", "NUMBA_CACHE_DIR": str(tmp_path)}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    first, *rest = done.stdout.splitlines()
    chosen = json.loads(first)[variable]
    print(f"\n{variable}={value}: {chosen}; {rest[-1] if rest else done.stderr}")
    names = name.split("|")
    assert set([chosen] if isinstance(chosen, str) else chosen) <= set(names), f"{variable}={value} was not chosen"
    assert chosen
    assert done.returncode == 0, done.stdout + done.stderr
