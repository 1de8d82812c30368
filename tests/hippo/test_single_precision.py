"""Single precision, in which runs really train, stays close to double precision: forward, backward and one update.

The same code in double precision is held against plain torch in test_networks.py and test_direct.py. Bounds are for
every processor: tests/hippo/test_kernel_sets.py runs this file with the kernels of several.
"""

import copy
import dataclasses

import numpy as np
import pytest
import torch
from torch import nn

from hippo.core import networks
from hippo.core.advantages import Baselines
from hippo.core.hierarchy import HierarchicalPolicy, collect
from hippo.core.levels import levels
from hippo.core.networks import grouped_layers, mlp
from hippo.core.on_policy import improve, make_optimizer
from tests.hippo.test_training import learner
from tests.hippo.toy import TargetEnv

GRADIENT = 2e-5  # bound of the error of a gradient, of its largest entry; 1.5e-6 was seen


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def activated(x: np.ndarray, bias: float, is_tanh: bool = True) -> np.ndarray:
    y = x[:, None].copy()
    networks._activate(y, np.array([bias], x.dtype), is_tanh)
    return y[:, 0]


def test_tanh_is_within_four_units_of_the_seventh_digit_and_saturates_at_one():
    x = np.concatenate([np.linspace(-12, 12, 400_001), [1e-30, -1e-7, 50.0, -np.inf]]).astype(np.float32)
    exact = np.tanh(x.astype(np.float64))
    ours = activated(x, 0.0)
    np.testing.assert_allclose(ours, exact, rtol=4e-7, atol=0)
    assert np.abs(ours).max() == 1.0
    for is_tanh in (True, False):
        assert np.isnan(activated(np.array([np.nan], np.float32), 0.0, is_tanh))
    np.testing.assert_array_equal(activated(np.float32([0.25, -0.5]), 0.75), activated(np.float32([1.0, 0.25]), 0.0))
    above, below = (np.array(c, np.float64)[:6][::-1] for c in (networks.P, networks.Q))  # the fraction cut too early
    assert np.abs(x * np.polyval(above, x * x) / np.polyval(below, x * x) - exact)[np.abs(x) < 9].max() > 1e-4


@pytest.mark.parametrize("rows", [1, 3, 4, 50, 1000])
@pytest.mark.parametrize("sizes", [(17, 32, 32, 1), (64, 64, 6), (17, 256, 64, 3)])
def test_single_precision_is_close_to_float64(rows, sizes):
    """Also of a first weight whose memory is transposed and a bias whose memory is strided."""
    net = mlp(sizes, generator())
    x = torch.randn(rows, sizes[0], generator=generator(), requires_grad=True)
    weight = torch.randn(sizes[0], sizes[1], 3, generator=generator(1))[..., 1].T.unsqueeze(0).requires_grad_()
    bias = torch.randn(sizes[1], 3, generator=generator(2))[:, 1].unsqueeze(0).requires_grad_()
    leaves = [x, weight, bias, *(p for layer in net.layers[1:] for p in layer.parameters())]
    y = grouped_layers(x, [rows], weight, bias, net.layers[1:], nn.Tanh)
    gradient = torch.randn(y.shape, generator=generator(3))
    ours = torch.autograd.grad(y, leaves, gradient)
    exact = [leaf.detach().double().requires_grad_() for leaf in leaves]
    reference = exact[0] @ exact[1][0].T + exact[2]
    for w, b in zip(exact[3::2], exact[4::2], strict=True):
        reference = torch.tanh(reference) @ w.T + b
    torch.testing.assert_close(y.double(), reference, rtol=1e-4, atol=1e-4)
    for mine, theirs in zip(ours, torch.autograd.grad(reference, exact, gradient.double()), strict=True):
        torch.testing.assert_close(mine.double(), theirs, rtol=1e-4, atol=5e-4)


def one_update(config, policy, baselines, batch):
    """Log-probabilities before and the parameters before and after, all with gradients, of one step of `improve`."""
    advantage, returns = torch.randn(2, *batch.steps.reward.shape, generator=generator(1), dtype=torch.float64)
    both = levels(policy, batch, advantage, advantage)
    critics = baselines.critics(batch, {"single": returns, "skill": returns}) if config.values_in_loop else []
    trained = nn.ModuleList([policy, baselines] if critics else [policy])
    log_probs = [level.log_prob(slice(None)).detach() for level in both]
    before = copy.deepcopy(trained)
    improve(config, both, critics, make_optimizer(config, trained.parameters()), None, batch.steps.num_steps, 0, 0)
    return log_probs, list(before.parameters()), list(trained.parameters())


@pytest.mark.parametrize(("name", "minibatch_size"), [("hippo random p", 0), ("hippo, modern", 2000)])
def test_an_update_in_single_precision_is_close_to_float64(name, minibatch_size):
    """Of both levels at once: autograd's in full batches, and the gradients written out for minibatches."""
    config = dataclasses.replace(learner(name)[1], updates=1, minibatch_size=minibatch_size)
    policy, baselines = HierarchicalPolicy(config, 2, 2, 2, generator()), Baselines(config, 2, generator(), True)
    batch = collect(policy, TargetEnv(config.num_envs, 0), config, 0, 0)
    exact = dataclasses.replace(batch, steps=copy.copy(batch.steps), time_left=batch.time_left.double())
    exact.steps.obs, exact.steps.action = batch.steps.obs.double(), batch.steps.action.double()
    networks64 = copy.deepcopy(policy).double(), copy.deepcopy(baselines).double()
    log_probs, before, after = one_update(config, policy, baselines, batch)
    log_probs64, before64, after64 = one_update(config, *networks64, exact)
    for mine, theirs in zip(log_probs, log_probs64, strict=True):
        torch.testing.assert_close(mine.double(), theirs, rtol=1e-5, atol=1e-5)
    compared = 0
    for p, q, p64, q64 in zip(before, after, before64, after64, strict=True):
        error = GRADIENT * float(q64.grad.abs().max())
        torch.testing.assert_close(q.grad.double(), q64.grad, rtol=0, atol=error)
        # Adam's first step is lr g / (|g| + eps): as good as the gradient is, relatively.
        clear = q64.grad.abs() > 100 * error
        step, step64 = ((new - old).detach().double()[clear] for old, new in ((p, q), (p64, q64)))
        torch.testing.assert_close(step, step64, rtol=0, atol=0.01 * config.learning_rate)
        compared += int(clear.sum())
    assert compared > 0.5 * sum(q.numel() for q in after)
