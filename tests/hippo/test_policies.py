"""Policies against torch.distributions and against the one-hot formulas written out."""

import math

import numpy as np
import pytest
import torch

from hippo.core.policies import (
    GaussianPolicy,
    Manager,
    SkillPolicy,
    gaussian_entropy,
    gaussian_log_prob,
    grouped_gaussian_log_prob,
    sample_categorical,
)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_gaussian_log_prob_and_entropy_are_those_of_the_distribution():
    mean, action = torch.randn(2, 5, 3, generator=generator(), dtype=torch.float64)
    log_std = torch.tensor([0.3, -1.0, 0.0], dtype=torch.float64)
    reference = torch.distributions.Independent(torch.distributions.Normal(mean, log_std.exp()), 1)
    torch.testing.assert_close(gaussian_log_prob(mean, log_std, action), reference.log_prob(action))
    torch.testing.assert_close(gaussian_entropy(log_std), reference.entropy()[0])
    # At the mean of a standard normal in two dimensions: -ln(2 pi).
    zero = torch.zeros(2, dtype=torch.float64)
    assert float(gaussian_log_prob(zero, zero, zero)) == pytest.approx(-math.log(2 * math.pi), abs=1e-12)


@pytest.mark.parametrize("counts", [[9], [2, 0, 4, 3]])
def test_the_grouped_log_probability_and_its_gradients_are_those_of_the_plain_formula(counts):
    mean, action = torch.randn(2, 9, 3, generator=generator(), dtype=torch.float64)
    log_std = torch.randn(len(counts), 3, generator=generator(1), dtype=torch.float64, requires_grad=True)
    gradient = torch.randn(9, generator=generator(2), dtype=torch.float64)
    mean.requires_grad_()
    group = torch.arange(len(counts)).repeat_interleave(torch.tensor(counts))
    ours = grouped_gaussian_log_prob(mean, log_std, action, counts)
    plain = gaussian_log_prob(mean, log_std[group], action)
    torch.testing.assert_close(ours, plain)
    for mine, theirs in zip(*(torch.autograd.grad(y, (mean, log_std), gradient) for y in (ours, plain)), strict=True):
        torch.testing.assert_close(mine, theirs)


@pytest.mark.parametrize("per_skill", [False, True])
def test_the_three_log_probabilities_of_the_skill_policy_agree(per_skill):
    policy = SkillPolicy(3, 4, 2, [8, 6], generator(), log_std_per_skill=per_skill).double()
    with torch.no_grad():
        policy.log_std_parameter.normal_(generator=generator(2))
    obs, action = torch.randn(9, 3, dtype=torch.float64), torch.randn(9, 2, dtype=torch.float64)
    skill = torch.tensor([0, 0, 0, 1, 1, 2, 3, 3, 3])
    everything = policy.log_prob_all(obs, action)
    torch.testing.assert_close(policy.log_prob(obs, skill, action), everything[torch.arange(9), skill])
    mean = torch.from_numpy(policy.actor()(obs.numpy(), skill.numpy(), np.zeros((9, 2))))
    noisy = torch.from_numpy(policy.actor()(obs.numpy(), skill.numpy(), np.ones((9, 2))))
    torch.testing.assert_close(noisy - mean, policy.log_std().exp()[skill])
    torch.testing.assert_close(
        gaussian_log_prob(mean, policy.log_std()[skill], action), everything[torch.arange(9), skill]
    )


def test_networks_have_the_papers_sizes():
    # Facts about the authors' networks: Ant, random p: skills 17 680 and manager 2 822 parameters; flat 29 264.
    count = lambda net: sum(p.numel() for p in net.parameters())  # noqa: E731
    assert count(SkillPolicy(28, 6, 8, [64, 64], generator())) == 17_680
    assert count(Manager(48, 6, [32, 32], generator())) == 2_822
    assert count(GaussianPolicy(47, 8, [256, 64], generator())) == 29_264
    # Snake, ego observation, random p: skills 10 696, manager 2 342, flat 25 160.
    assert count(SkillPolicy(13, 6, 4, [64, 64], generator())) == 10_696
    assert count(Manager(33, 6, [32, 32], generator())) == 2_342
    assert count(GaussianPolicy(32, 4, [256, 64], generator())) == 25_160


def test_initial_weights_are_glorot_uniform_with_zero_bias_and_unit_std():
    policy = GaussianPolicy(20, 3, [256, 64], generator())
    first = policy.mean[0]
    bound = math.sqrt(6 / (20 + 256))
    assert 0.98 * bound < first.weight.abs().max() <= bound
    assert not first.bias.any()
    assert policy.log_std.exp().tolist() == [1.0, 1.0, 1.0]


def test_the_standard_deviation_has_a_floor():
    policy = GaussianPolicy(2, 1, [4], generator())
    with torch.no_grad():
        policy.log_std_parameter.fill_(-50.0)
    assert float(policy.log_std.exp()) == pytest.approx(1e-4)


def test_inverse_cdf_sampling_worked_by_hand():
    # Probabilities 0.2, 0.3, 0.5: u in [0, 0.2) -> 0, [0.2, 0.5) -> 1, [0.5, 1) -> 2.
    logits = np.log([[0.2, 0.3, 0.5]] * 6).astype(np.float32) + 7  # logits are known up to a constant
    uniform = np.array([0.0, 0.19, 0.21, 0.49, 0.51, 0.9999999], np.float32)
    assert sample_categorical(logits, uniform).tolist() == [0, 0, 1, 1, 2, 2]


def test_the_numpy_twins_of_manager_and_flat_policy_compute_what_torch_does():
    obs = torch.randn(7, 5, generator=generator(1))
    manager, flat = Manager(5, 3, [8, 6], generator()), GaussianPolicy(5, 2, [8, 6], generator())
    np.testing.assert_allclose(manager.actor()(obs.numpy()), manager.logits(obs).detach(), rtol=1e-5, atol=1e-6)
    action = flat.actor()(obs.numpy(), np.zeros((7, 2), np.float32))
    assert action.dtype == np.float32
    np.testing.assert_allclose(action, flat.mean(obs).detach(), rtol=1e-5, atol=1e-6)
    with torch.no_grad():
        flat.log_std_parameter.fill_(1.0)
    moved = flat.actor()(obs.numpy(), np.ones((7, 2), np.float32)) - action
    np.testing.assert_allclose(moved, np.full((7, 2), np.e), rtol=1e-5)
