"""DIAYN's reward and discriminator against the fact sheet's golden numbers (D1, D2, D5)."""

import math

import pytest
import torch

from baselines import diayn
from baselines.diayn import DIAYNConfig, Discriminator, Distinguishable, skill_reward
from hippo.core.policies import SkillPolicy
from hippo.core.pretraining import collect
from tests.baselines.roam import RoamEnv


@pytest.mark.parametrize(("q", "expected"), [(1 / 6, 0.0), (1.0, 1.79176), (0.5, 1.0986)])
def test_d1_the_reward_is_log_q_less_log_p(q, expected):
    log_q = torch.tensor([math.log(q)], dtype=torch.float64)
    reward = skill_reward(log_q, torch.zeros(1), 6, entropy_weight=0.1)
    assert float(reward) == pytest.approx(expected, abs=5e-5)
    assert 100 * math.log(6) == pytest.approx(179.18, abs=5e-3)  # the discounted maximum at gamma 0.99


def test_d1_the_entropy_term_is_minus_alpha_log_pi():
    reward = skill_reward(torch.zeros(1), torch.tensor([-2.0]), 6, entropy_weight=0.1)
    assert float(reward) == pytest.approx(math.log(6) + 0.2)


def test_d5_without_log_p_every_step_would_cost_and_an_early_end_would_pay():
    confused = torch.full((5,), math.log(1 / 6), dtype=torch.float64)
    with_p = skill_reward(confused, torch.zeros(5), 6, 0.0)
    assert float(with_p.sum()) == pytest.approx(0.0, abs=1e-12)
    sure = torch.full((5,), math.log(0.9), dtype=torch.float64)
    assert float(skill_reward(sure, torch.zeros(5), 6, 0.0).sum()) > 0  # living on pays
    assert float(sure.sum()) < 0  # without log p it would not


def names(size):
    return ["x", "com_x", *[f"joint_{i}" for i in range(size - 3)], "com_z"]


def test_the_discriminator_does_not_see_absolute_place():
    discriminator = Discriminator(names(6), 4, [8], torch.Generator().manual_seed(0)).double()
    obs = torch.randn(7, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    moved = obs.clone()
    moved[:, :2] += 100.0
    assert torch.equal(discriminator.log_probs(moved), discriminator.log_probs(obs))
    moved[:, 5] += 1.0  # the height of the centre of mass is no absolute place
    assert not torch.allclose(discriminator.log_probs(moved), discriminator.log_probs(obs))


@pytest.mark.parametrize("robot", ["hopper", "half_cheetah"])
def test_of_the_robots_own_observation_it_leaves_out_exactly_com_x_and_com_y(robot):
    from hippo.envs import make

    envs = make(robot, 1, 0)
    hidden = set(envs.observation_names[: envs.robot_size]) & set(diayn.ABSOLUTE)
    discriminator = Discriminator(envs.observation_names[: envs.robot_size], 6, [8], torch.Generator())
    assert {"com_x"} <= hidden <= {"com_x", "com_y"}
    assert len(discriminator.seen) == envs.robot_size - len(hidden)
    envs.close()


def test_d2_log_q_begins_near_minus_log_n_and_rises_on_states_that_tell_skills_apart():
    generator = torch.Generator().manual_seed(0)
    discriminator = Discriminator(names(6), 6, [32], generator)
    optimizer = torch.optim.Adam(discriminator.parameters(), lr=1e-2)
    skill = torch.randint(6, (600,), generator=generator)
    obs = torch.randn(600, 6, generator=generator)
    obs[:, 3] += 10 * skill

    def mean_log_q():
        with torch.no_grad():
            return float(discriminator.log_probs(obs).gather(1, skill[:, None]).mean())

    discriminator.inputs.fit(obs[:, discriminator.seen])
    assert abs(mean_log_q() + math.log(6)) < 0.5
    discriminator.fit(optimizer, obs, skill, 60, 50, generator)
    assert mean_log_q() > -0.2
    # Skills that only differ in x stay hidden.
    blind = Discriminator(names(6), 6, [32], generator)
    obs = torch.randn(600, 6, generator=generator)
    obs[:, 0] += 10 * skill
    blind.fit(torch.optim.Adam(blind.parameters(), lr=1e-3), obs, skill, 5, 50, generator)
    with torch.no_grad():
        accuracy = (blind.log_probs(obs).argmax(1) == skill).double().mean()
    assert accuracy < 0.4


def test_the_reward_of_a_batch_is_computed_from_where_each_step_arrived():
    config = DIAYNConfig(iterations=1, batch_size=400, horizon=40, num_skills=3, entropy_weight=0.3)
    env = RoamEnv(10, 0, horizon=40, death_rate=0.1)
    policy = SkillPolicy(3, 3, 2, [8, 8], torch.Generator().manual_seed(0))
    paths = collect(policy, env, config, 0, 0)
    objective = Distinguishable(config, env.observation_names, 0)
    objective.learn(paths, 0, 0)
    with torch.no_grad():
        reward, metrics = objective.reward(paths, policy)
        right = 0
        for t in range(40):
            for n in range(10):
                z = int(paths.skill[t, n])
                log_q = objective.discriminator.log_probs(paths.next_obs[t, n][None])[0]
                mean, std = policy.means(paths.steps.obs[t, n][None])[0, z], policy.log_std()[z].exp()
                log_pi = torch.distributions.Normal(mean, std).log_prob(paths.steps.action[t, n]).sum()
                expected = float(log_q[z]) + math.log(3) - 0.3 * float(log_pi)
                assert float(reward[t, n]) == pytest.approx(expected, abs=1e-4)
                right += int(log_q.argmax()) == z
    assert metrics["discriminator_accuracy"] == pytest.approx(right / 400)


def test_the_reward_comes_from_the_discriminator_before_it_learns_from_the_batch(tmp_path):
    config = DIAYNConfig(iterations=1, batch_size=400, horizon=40, num_skills=3)
    objective = Distinguishable(config, RoamEnv.observation_names, 0)
    policy = SkillPolicy(3, 3, 2, [8, 8], torch.Generator().manual_seed(0))
    paths = collect(policy, RoamEnv(10, 0, horizon=40), config, 0, 0)
    with torch.no_grad():
        before, _ = objective.reward(paths, policy)
        again, _ = objective.reward(paths, policy)
    assert torch.equal(before, again)
    objective.learn(paths, 0, 0)
    with torch.no_grad():
        after, _ = objective.reward(paths, policy)
    assert not torch.equal(before, after)
