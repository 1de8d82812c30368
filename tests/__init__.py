"""The tests, grouped as the packages are: `make test ONLY=envs` runs one group."""

from pathlib import Path

ROOT = Path(__file__).parent.parent
