"""The clipped surrogate against numbers worked by hand, and the chunked update against a plain one."""

import math

import pytest
import torch

from experiments.config import compose_run
from hippo.core import ppo
from hippo.core.policies import GaussianPolicy


def test_clipped_surrogate_in_its_four_regimes():
    # clip 0.1. Ratio 1.5, A 2: min(3, 1.1 * 2) = 2.2 (gain clipped). Ratio 1.5, A -2: min(-3, -2.2) = -3 (loss kept).
    # Ratio 0.5, A 2: min(1, 1.8) = 1 (kept). Ratio 0.5, A -2: min(-1, -1.8) = -1.8 (clipped).
    log_ratio = torch.tensor([1.5, 1.5, 0.5, 0.5], dtype=torch.float64).log()
    advantage = torch.tensor([2.0, -2.0, 2.0, -2.0], dtype=torch.float64)
    objective = ppo.clipped_surrogate(log_ratio - 1.0, torch.full_like(log_ratio, -1.0), advantage, 0.1)
    torch.testing.assert_close(objective, torch.tensor([2.2, -3.0, 1.0, -1.8], dtype=torch.float64))
    only_clipped = log_ratio.exp().clamp(0.9, 1.1) * advantage
    assert not torch.allclose(only_clipped, objective)  # dropping the minimum is a different objective


def test_the_gradient_stops_where_the_gain_is_clipped():
    log_prob = torch.tensor([math.log(1.2), math.log(1.2)], dtype=torch.float64, requires_grad=True)
    advantage = torch.tensor([1.0, -1.0], dtype=torch.float64)
    ppo.clipped_surrogate(log_prob, torch.zeros(2, dtype=torch.float64), advantage, 0.1).sum().backward()
    torch.testing.assert_close(log_prob.grad, torch.tensor([0.0, -1.2], dtype=torch.float64))


def test_surrogate_statistics_worked_by_hand():
    # log w = ln 2: k3 = 2 - 1 - ln 2, |w - 1| = 1 > 0.1. log w = 0: k3 = 0, inside.
    kl, clipped = ppo.surrogate_statistics(torch.tensor([math.log(2.0), 0.0]), torch.zeros(2), 0.1)
    assert float(kl) == pytest.approx(1 - math.log(2.0), rel=1e-6)
    assert float(clipped) == 1.0


def test_a_chunked_update_is_the_full_batch_update(monkeypatch):
    def updated(chunk: int) -> torch.Tensor:
        monkeypatch.setattr(ppo, "CHUNK", chunk)
        policy = GaussianPolicy(3, 2, [8], torch.Generator().manual_seed(0)).double()
        g = torch.Generator().manual_seed(1)
        obs, action = torch.randn(50, 3, generator=g).double(), torch.randn(50, 2, generator=g).double()
        advantage = torch.randn(50, generator=g).double()
        level = ppo.Level("policy", lambda c: policy.log_prob(obs[c], action[c]), advantage)
        ppo.maximize([level], torch.optim.Adam(policy.parameters(), lr=1e-2), 4, 0.1, num_steps=50)
        return torch.nn.utils.parameters_to_vector(policy.parameters()).detach()

    torch.testing.assert_close(updated(7), updated(1000), rtol=0, atol=1e-12)


def test_one_update_is_the_plain_policy_gradient_step():
    # At the old policy every ratio is 1, so the surrogate's gradient is that of mean(A log pi).
    policy = GaussianPolicy(3, 2, [8], torch.Generator().manual_seed(0)).double()
    twin = GaussianPolicy(3, 2, [8], torch.Generator().manual_seed(0)).double()
    g = torch.Generator().manual_seed(1)
    obs, action = torch.randn(20, 3, generator=g).double(), torch.randn(20, 2, generator=g).double()
    advantage = torch.randn(20, generator=g).double()
    level = ppo.Level("policy", lambda c: policy.log_prob(obs[c], action[c]), advantage)
    metrics = ppo.maximize([level], torch.optim.SGD(policy.parameters(), lr=0.1), 1, 0.1, num_steps=20)
    (-(twin.log_prob(obs, action) * advantage).mean()).backward()
    with torch.no_grad():
        for mine, reference in zip(policy.parameters(), twin.parameters(), strict=True):
            torch.testing.assert_close(mine, reference - 0.1 * reference.grad, rtol=0, atol=1e-12)
    assert metrics["policy_approx_kl"] == pytest.approx(0.0, abs=1e-12)
    assert metrics["surrogate"] == pytest.approx(float(advantage.mean()), abs=1e-12)


def test_one_discount_for_all_in_the_modern_protocol_and_no_setting_that_changes_nothing_in_an_identity():
    flat = ["algo=ppo", "protocol=modern"]
    assert compose_run([*flat, "algo.action_repeat=10"]).config.discount_per_step
    assert not compose_run(["algo=ppo", "algo.action_repeat=10"]).config.discount_per_step  # as the authors' code
    same = {compose_run([*flat, f"algo.discount_per_step={value}"]).run_id for value in ("true", "false")}
    assert len(same) == 1
