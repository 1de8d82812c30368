"""One thread everywhere, as in a training process, so that what the tests compare bit by bit is comparable."""

import experiments  # noqa: F401, I001  first: it says so to numpy's BLAS, which listens only when it is imported

import pytest
import torch

torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def no_remembered_costs(tmp_path, monkeypatch):
    """Tests neither read nor write what this machine's user has measured."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
