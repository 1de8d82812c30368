"""Advantages of both levels on a batch small enough to work by hand."""

from types import SimpleNamespace

import pytest
import torch

from hippo.core.advantages import Baselines, advantages, masked_standardize
from hippo.core.hierarchy import Batch, HierarchicalPolicy, collect
from hippo.hippo import HippoConfig
from tests.hippo.toy import TargetEnv


def hand_batch(terminated, done, final=None):
    """Four steps of one environment, decisions at 0 and 2 (p = 2), skills 0 then 1, rewards 1 2 3 4."""
    reward = torch.tensor([[1.0], [2.0], [3.0], [4.0]], dtype=torch.float64)
    steps = SimpleNamespace(
        obs=torch.arange(5.0).view(5, 1, 1),
        reward=reward,
        scaled_reward=reward,
        terminated=torch.tensor(terminated).view(4, 1),
        done=torch.tensor(done).view(4, 1),
        final=lambda: (torch.empty(0, 1), torch.empty(0, dtype=torch.long), torch.empty(0, dtype=torch.long)),
    )
    return Batch(
        steps,
        skill=torch.tensor([[0], [0], [1], [1], [0]]),
        time_left=torch.tensor([[1.0], [0.5], [1.0], [0.5], [1.0]]),
        is_decision=torch.tensor([[True], [False], [True], [False], [True]]),
        used=torch.ones(4, 1, dtype=torch.bool),
    )


class HandBaselines:
    """V(s) = 10 s; V(s, z, t) = 100 z + 10 s + t."""

    def predict(self, kind, obs, time_left, skill):
        s = obs.squeeze(-1).double()
        return {"none": 0 * s, "single": 10 * s, "skill": 100 * skill + 10 * s + time_left.double()}[kind]


def config(**settings):
    return HippoConfig(
        iterations=1, batch_size=4, horizon=4, period_min=2, period_max=2, num_skills=2, gamma=0.5, **settings
    )


def test_the_next_skill_value_at_a_boundary_is_that_of_the_newly_drawn_skill():
    # lambda 0, gamma 0.5, V_l along the path: 1, 10.5, 121, 130.5, then (z 0, t 1) at s = 4: 41.
    # deltas: 1 + 5.25 - 1 = 5.25;  2 + 60.5 - 10.5 = 52;  3 + 65.25 - 121 = -52.75;  4 + 20.5 - 130.5 = -106
    batch = hand_batch([False] * 4, [False] * 4)
    out = advantages(batch, HandBaselines(), config(gae_lambda=0.0))
    target = out.returns["skill"].squeeze()
    values = torch.tensor([1, 10.5, 121, 130.5], dtype=torch.float64)
    torch.testing.assert_close(target - values, torch.tensor([5.25, 52, -52.75, -106], dtype=torch.float64))
    # Had the old skill been kept at the boundary (z 0 at s = 2: 21), step 1 would get 2 + 10.5 - 10.5 = 2.
    assert (target - values)[1] != 2.0


def test_managers_advantage_is_the_per_step_return_minus_v_at_decisions():
    # lambda 1, terminated at the end, gamma 0.5: returns 1 + 1 + 0.75 + 0.5 = 3.25, 4.5, 5, 4; V = 0, 10, 20, 30.
    batch = hand_batch([False, False, False, True], [False, False, False, True])
    out = advantages(batch, HandBaselines(), config())
    torch.testing.assert_close(
        out.returns["single"].squeeze(), torch.tensor([3.25, 4.5, 5.0, 4.0], dtype=torch.float64)
    )
    raw = torch.tensor([3.25, -5.5, -15.0, -26.0], dtype=torch.float64)
    expected = (raw - raw.mean()) / raw.std(correction=0)
    torch.testing.assert_close(out.manager.squeeze(), expected)


def test_the_semi_markov_advantage_is_standardised_over_decisions():
    batch = hand_batch([False, False, False, True], [False, False, False, True])
    out = advantages(batch, HandBaselines(), config(manager_advantage="smdp"))
    # lambda 1: the same 3.25 and -15 at the decisions, standardised by themselves to +1 and -1.
    torch.testing.assert_close(out.manager.squeeze(), torch.tensor([1.0, 0, -1.0, 0], dtype=torch.float64))


def test_no_baseline_leaves_the_returns_alone():
    batch = hand_batch([False, False, False, True], [False, False, False, True])
    out = advantages(batch, HandBaselines(), config(skill_baseline="none", manager_baseline="none"))
    raw = torch.tensor([3.25, 4.5, 5.0, 4.0], dtype=torch.float64)
    torch.testing.assert_close(out.skills.squeeze(), (raw - raw.mean()) / raw.std(correction=0))
    assert out.returns == {}


def test_a_dropped_partial_period_neither_teaches_nor_leaks_back():
    batch = hand_batch([False, False, False, True], [False, False, False, True])
    batch.used = torch.tensor([[True], [True], [False], [False]])
    out = advantages(batch, HandBaselines(), config(skill_baseline="none", manager_baseline="none"))
    # Only 1 + 0.5 * 2 = 2 and 2 remain, which standardise to zero; the dropped steps get zero.
    torch.testing.assert_close(out.skills.squeeze(), torch.zeros(4, dtype=torch.float64), rtol=0, atol=1e-6)
    batch.used = torch.ones(4, 1, dtype=torch.bool)
    assert advantages(batch, HandBaselines(), config(skill_baseline="none")).skills.abs().sum() > 1


def test_masked_standardize_uses_the_masked_entries_only():
    out = masked_standardize(torch.tensor([[1.0, 100.0], [3.0, -7.0]]), torch.tensor([[True, False], [True, False]]))
    torch.testing.assert_close(out, torch.tensor([[-1.0, 0.0], [1.0, 0.0]]))


@pytest.mark.parametrize("bootstrap", [False, True])
def test_the_horizon_bootstraps_only_where_asked(bootstrap):
    settings = HippoConfig(iterations=1, batch_size=80, horizon=10, bootstrap_horizon=bootstrap)
    generator = torch.Generator().manual_seed(0)
    policy = HierarchicalPolicy(settings, 2, 2, 2, generator)
    batch = collect(policy, TargetEnv(8, 0, horizon=10), settings, 0, 0)
    final_obs, step, _ = batch.steps.final()
    assert bool(batch.steps.done[-1].all())
    assert bool(batch.steps.terminated[-1].all()) is not bootstrap
    assert len(final_obs) == (8 if bootstrap else 0)
    baselines = Baselines(settings, 2, generator)
    estimate = advantages(batch, baselines, settings)
    baselines.fit(batch, estimate.returns)
    target = advantages(batch, baselines, settings).returns["single"][-1]
    value = baselines.predict("single", final_obs, torch.zeros(len(step)), torch.zeros(len(step), dtype=torch.long))
    follow = settings.gamma * value if bootstrap else 0.0
    torch.testing.assert_close(target, batch.steps.reward[-1] + follow)
