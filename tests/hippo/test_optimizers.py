"""Torch's optimizers as they are, to the bit, and a training process that never imports what they would import."""

import subprocess
import sys

import pytest
import torch

from hippo.core import optimizers

# Each takes time to import and is of no use to a process that trains.
IDLE = ("torch._dynamo", "torch._inductor", "sympy", "scipy.stats")


def trained(kind, **settings):
    """Weights and state after four steps, of which the last two from a restored state."""
    torch.manual_seed(0)
    layer, x = torch.nn.Linear(5, 3), torch.randn(7, 5)
    optimizer = kind(layer.parameters(), **settings)

    def loss():
        optimizer.zero_grad()
        value = (layer(x) - 1).square().sum()
        value.backward()
        return value

    for step in range(4):
        if step == 2:
            state = optimizer.state_dict()
            optimizer = kind(layer.parameters(), lr=7.0)
            optimizer.load_state_dict(state)
        optimizer.step(loss)
    return [p.detach().clone() for p in layer.parameters()], optimizer.state_dict()["state"]


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("Adam", {"lr": 0.1}),
        ("Adam", {"lr": 0.1, "eps": 1e-5, "fused": True}),
        ("LBFGS", {"max_iter": 3, "line_search_fn": "strong_wolfe"}),
    ],
)
def test_they_compute_what_torchs_compute_to_the_bit(name, settings):
    ours, theirs = (trained(getattr(of, name), **settings) for of in (optimizers, torch.optim))
    torch.testing.assert_close(ours, theirs, rtol=0, atol=0)
    assert not torch.equal(ours[0][0], trained(getattr(optimizers, name), **settings | {"lr": 0.01})[0][0])


@pytest.mark.parametrize("protocol", ["paper", "modern"])
def test_a_training_process_does_not_import_what_it_has_no_use_for(protocol, tmp_path):
    overrides = ["algo=ppo", "env=block_hopper", "scale=smoke", "iterations=2", "batch_size=400"]
    overrides += [f"protocol={protocol}", f"runs_dir={tmp_path}"]
    program = f"import sys; from experiments import train; print(train.main({overrides})); print(*sys.modules)"
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    *_, code, modules = ended.stdout.splitlines()
    assert code == "0"
    assert "torch.optim" in modules.split()
    assert not set(IDLE) & set(modules.split())
