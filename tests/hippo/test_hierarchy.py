"""The commitment and Algorithm 1, and both levels' log-probabilities, on a small environment."""

import pytest
import torch

from hippo.core.hierarchy import HierarchicalPolicy, collect, in_whole_periods, with_time
from hippo.core.levels import levels, policy_statistics
from hippo.hippo import HippoConfig
from tests.hippo.toy import TargetEnv


def setup(death_rate=0.0, horizon=40, num_envs=8, **settings):
    config = HippoConfig(iterations=1, batch_size=horizon * num_envs, horizon=horizon, **settings)
    envs = TargetEnv(num_envs, seed=0, horizon=horizon, death_rate=death_rate)
    policy = HierarchicalPolicy(config, 2, 2, 2, torch.Generator().manual_seed(0))
    return policy, collect(policy, envs, config, seed=0, iteration=0)


def segments(batch, env):
    """(start, end) of the segments of one environment, the last one possibly cut."""
    starts = batch.is_decision[:-1, env].nonzero().squeeze(-1).tolist()
    return list(zip(starts, [*starts[1:], len(batch.skill) - 1], strict=True))


@pytest.mark.parametrize("death_rate", [0.0, 0.1])
def test_random_commitments_follow_algorithm_1(death_rate):
    _, batch = setup(death_rate, period_min=2, period_max=5)
    done = batch.steps.done
    assert bool(done.any()) is True
    lengths = set()
    for env in range(8):
        for start, end in segments(batch, env):
            # One skill per segment, the time left counts down from p / p_max by 1 / p_max.
            assert len(set(batch.skill[start:end, env].tolist())) == 1
            steps_left = (batch.time_left[start:end, env] * 5).round().long().tolist()
            p = steps_left[0]
            assert 2 <= p <= 5
            assert steps_left == list(range(p, p - (end - start), -1))
            cut = end - start < p
            assert cut == bool(end == 40 or done[start:end, env].any()) or end - start == p
            if cut:
                assert end == 40 or bool(done[end - 1, env])
            lengths.add(p)
            assert not done[start : end - 1, env].any()  # an episode's end always ends the segment
    assert lengths == {2, 3, 4, 5}  # both bounds are inclusive


def test_a_fixed_period_decides_every_p_steps_and_hides_the_time():
    policy, batch = setup(period_min=10, period_max=10)
    assert batch.is_decision[:, 0].nonzero().squeeze(-1).tolist() == [0, 10, 20, 30, 40]
    assert policy.manager_input(batch.steps.obs, batch.time_left).shape[-1] == 2
    assert policy.skill_input(batch.steps.obs, batch.time_left).shape[-1] == 2


def test_the_period_is_drawn_before_the_manager_acts():
    # The manager's input at a decision holds the full new period, so with its time weight large its choice follows p.
    config = HippoConfig(iterations=1, batch_size=800, horizon=100, num_skills=2, period_min=1, period_max=2)
    policy = HierarchicalPolicy(config, 2, 2, 2, torch.Generator().manual_seed(0))
    with torch.no_grad():
        for layer in policy.manager.logits[::2]:
            layer.weight.zero_()
        policy.manager.logits[0].weight[0, -1] = 10.0  # hidden unit 0 sees only the time left
        policy.manager.logits[0].bias[0] = -7.5  # 10 * 1/2 - 7.5 < 0 < 10 * 1 - 7.5
        policy.manager.logits[2].weight[0, 0] = 10.0
        policy.manager.logits[4].weight[1, 0] = 50.0
    batch = collect(policy, TargetEnv(8, 0, horizon=100), config, 0, 0)
    decided = batch.is_decision[:-1]
    assert torch.equal(batch.skill[:-1][decided], (batch.time_left[:-1][decided] == 1.0).long())


def test_equal_draws_and_zero_time_columns_make_random_and_fixed_periods_the_same():
    # A random-period policy whose time columns are zero and whose draws are all 3 is the fixed-period policy.
    fixed, expected = setup(period_min=3, period_max=3)
    config = HippoConfig(iterations=1, batch_size=320, horizon=40, period_min=3, period_max=4)
    random = HierarchicalPolicy(config, 2, 2, 2, torch.Generator().manual_seed(1))
    with torch.no_grad():
        for name, mine in random.named_parameters():
            theirs = dict(fixed.named_parameters())[name]
            if mine.shape == theirs.shape:
                mine.copy_(theirs)
            elif name == "manager.logits.0.weight":
                mine.zero_()
                mine[:, :2] = theirs
            else:  # skills.first.weight: columns [o, time | z | o x z, time x z]
                assert name == "skills.first.weight"
                mine.zero_()
                mine[:, :2], mine[:, 3:9], mine[:, 9:21] = theirs[:, :2], theirs[:, 2:8], theirs[:, 8:20]
    config.period_max = 3  # draw 3 only; the policy keeps its time input
    batch = collect(random, TargetEnv(8, 0, horizon=40), config, 0, 0)
    torch.testing.assert_close(batch.steps.action, expected.steps.action, rtol=0, atol=1e-6)
    assert torch.equal(batch.skill, expected.skill)
    gradients = []
    for policy, b in ((random, batch), (fixed, expected)):
        advantage = b.steps.reward
        loss = sum((lv.log_prob(slice(None)) * lv.advantage).sum() for lv in levels(policy, b, advantage, advantage))
        loss.backward()
        gradients.append((float(loss.detach()), policy.skills.first.bias.grad, policy.manager.logits[4].weight.grad))
    for mine, theirs in zip(*gradients, strict=True):
        torch.testing.assert_close(torch.as_tensor(mine), torch.as_tensor(theirs), rtol=1e-4, atol=1e-4)


def test_levels_hold_what_was_done_and_how_likely_it_was():
    policy, batch = setup(death_rate=0.05, period_min=2, period_max=4)
    advantage = torch.randn(40, 8, dtype=torch.float64)
    manager, skill = levels(policy, batch, advantage, 2 * advantage)
    obs, time_left = batch.steps.obs[:-1], batch.time_left[:-1]
    decided = batch.is_decision[:-1]
    logits = policy.manager.logits(with_time(obs, time_left))
    expected = torch.distributions.Categorical(logits=logits).log_prob(batch.skill[:-1])[decided]
    torch.testing.assert_close(manager.log_prob(slice(None)), expected)
    torch.testing.assert_close(manager.advantage.double(), advantage[decided], rtol=0, atol=1e-6)
    # The skill rows are sorted by skill: compare as a sorted list of (log-probability, advantage).
    everything = policy.skills.log_prob_all(with_time(obs, time_left).flatten(0, 1), batch.steps.action.flatten(0, 1))
    own = everything[torch.arange(320), batch.skill[:-1].flatten()]
    torch.testing.assert_close(skill.log_prob(slice(None)).sort().values, own.sort().values)
    weighted = (skill.log_prob(slice(None)) * skill.advantage).sum()
    torch.testing.assert_close(weighted, (own * 2 * advantage.flatten()).sum().float(), rtol=1e-4, atol=1e-4)
    assert [lv.name for lv in levels(policy, batch, advantage, advantage, ["skill"])] == ["skill"]


def test_skills_do_not_see_beyond_the_robots_own_observation():
    config = HippoConfig(iterations=1, batch_size=40, horizon=40)
    policy = HierarchicalPolicy(config, 5, 3, 2, torch.Generator().manual_seed(0))
    obs = torch.randn(4, 5, requires_grad=True)
    policy.skills.means(policy.skill_input(obs, torch.ones(4))).sum().backward()
    assert obs.grad[:, :3].abs().sum() > 0
    assert not obs.grad[:, 3:].any()
    full = HippoConfig(iterations=1, batch_size=40, horizon=40, skill_observation="full")
    assert HierarchicalPolicy(full, 5, 3, 2, torch.Generator()).skill_view == 5


def test_whole_periods_worked_by_hand():
    # Segments of length 3, 2, 3, 1 in one column, p = 3: the second and the last are partial.
    decision = torch.tensor([1, 0, 0, 1, 0, 1, 0, 0, 1], dtype=torch.bool).unsqueeze(1)
    assert in_whole_periods(decision, 3).squeeze().int().tolist() == [1, 1, 1, 0, 0, 1, 1, 1, 0]


def test_policy_statistics_of_a_uniform_manager():
    policy, batch = setup(num_skills=4, period_min=5, period_max=5)
    with torch.no_grad():
        for p in policy.manager.parameters():
            p.zero_()
    s = policy_statistics(policy, batch)
    assert s["manager_entropy"] == pytest.approx(1.3862944, abs=1e-5)  # ln 4
    assert s["skill_entropy"] == pytest.approx(2.8378771, abs=1e-5)  # two dimensions of (1 + ln 2 pi) / 2
    assert s["commitment_mean"] == 5.0
    assert sum(s[f"skill_{z}_usage"] for z in range(4)) == pytest.approx(1.0)
