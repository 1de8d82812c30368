"""SNN4HRL's grid bonus against counts by hand (S1 to S5 of the fact sheet) and a slow reference."""

import collections
import math

import numpy as np
import pytest
import torch

from baselines import snn
from baselines.snn import PRESETS, Bonus, GridBonus, cells, entropy, headings, log_shares, turned
from hippo.core.policies import SkillPolicy
from hippo.core.pretraining import collect
from tests.baselines.roam import RoamEnv


def test_s1_a_cell_that_one_skill_visits_30_times_and_another_10_times():
    skill = np.array([0] * 30 + [1] * 10)
    bonus = log_shares(np.zeros((40, 2), int), skill, 6)
    np.testing.assert_allclose(bonus[:30], -0.28768, atol=5e-6)
    np.testing.assert_allclose(bonus[30:], -1.38629, atol=5e-6)
    np.testing.assert_allclose(0.05 * bonus[[0, 39]], [-0.01438, -0.06931], atol=5e-6)


def test_s2_own_cells_cost_nothing_and_shared_ones_log_6():
    skill = np.repeat(np.arange(6), 10)
    own = np.stack([skill, np.zeros(60, int)], 1)
    assert (log_shares(own, skill, 6) == 0).all()
    shared = np.tile(np.arange(10), 6)[:, None] * [1, 0]
    np.testing.assert_allclose(log_shares(shared, skill, 6), -1.79176, atol=5e-6)


def test_s3_the_mean_bonus_is_minus_the_entropy_of_the_skill_given_the_cell():
    rng = np.random.default_rng(0)
    skill = rng.integers(6, size=2000)
    cell = np.stack([rng.poisson(skill), rng.integers(2, size=2000)], 1)
    by_cell = collections.defaultdict(collections.Counter)
    for c, z in zip(map(tuple, cell), skill, strict=True):
        by_cell[c][z] += 1
    expected = [
        math.log(by_cell[tuple(c)][z] / sum(by_cell[tuple(c)].values())) for c, z in zip(cell, skill, strict=True)
    ]
    bonus = log_shares(cell, skill, 6)
    np.testing.assert_allclose(bonus, expected, rtol=1e-12)
    conditional = 0.0
    for counts in by_cell.values():
        share = np.array(list(counts.values())) / sum(counts.values())
        conditional -= sum(counts.values()) / 2000 * (share * np.log(share)).sum()
    assert bonus.mean() == pytest.approx(-conditional, rel=1e-12)
    information = bonus.mean() + entropy(skill)
    assert 0 < information < math.log(6)


def test_s4_sizes_of_the_skill_network_on_the_robots_own_observations():
    def count(obs_size, action_size):
        policy = SkillPolicy(obs_size, 6, action_size, [64, 64], torch.Generator())
        return sum(p.numel() for p in policy.parameters())

    assert count(27, 8) == 17_232
    assert count(17, 4) == 12_488
    assert count(12, 4) == 10_248


def test_s5_cell_indices_lie_within_the_grid():
    position = np.random.default_rng(0).normal(size=(500, 2)) * 3
    for density in (5, 10):
        reach = math.ceil(np.abs(position).max())
        index = cells(position, density)
        assert index.min() >= 0
        assert index.max() <= 2 * reach * density
    np.testing.assert_array_equal(
        cells(np.array([[-0.5, 1.2]]), 10), [[15, 32]]
    )  # F = 2: ceil(1.5 * 10), ceil(3.2 * 10)


def test_the_authors_bonus_of_a_step_with_all_skills_alike():
    bonus = PRESETS["hippo_authors"]
    assert bonus.coefficient * (bonus.mi_weight * math.log(1 / 6) + bonus.survival["ant"]) == pytest.approx(
        141.65, abs=5e-3
    )


def test_headings_come_from_the_entries_names():
    half = math.pi / 6
    quaternion = np.array([[9.0, math.cos(half), 0, 0, math.sin(half)]])
    np.testing.assert_allclose(headings(quaternion, ["z", "quat_w", "quat_x", "quat_y", "quat_z"]), [math.pi / 3])
    np.testing.assert_allclose(headings(np.array([[1.0, 0.7]]), ["x", "heading"]), [0.7])
    np.testing.assert_array_equal(headings(np.ones((4, 2)), ["z", "pitch"]), np.zeros(4))
    np.testing.assert_allclose(turned(np.array([1.0, 0.0]), np.array(math.pi / 2)), [0, 1], atol=1e-15)


class TurnedRoamer(RoamEnv):
    """Roams from a random place in a random direction: paths differ only in where they start and their heading."""

    observation_names = ("heading", "x_velocity", "y_velocity")

    def _observe(self):
        return np.concatenate([self.heading[:, None], self.velocity], 1).astype(np.float32)

    def reset(self, *, seed=None, options=None):
        self.heading = np.zeros(self.num_envs)
        super().reset(seed=seed)
        self.heading = self.rng.uniform(-math.pi, math.pi, self.num_envs)
        self.com[:, :2] = self.rng.uniform(-5, 5, (self.num_envs, 2))
        return self._observe(), {}

    def step(self, actions):
        world = turned(np.tile([1.0, 0.5], (self.num_envs, 1)), self.heading)
        return super().step(world)


def paths_of(env, horizon=20):
    config = snn.SNNConfig(iterations=1, batch_size=env.num_envs * horizon, horizon=horizon, num_skills=3)
    policy = SkillPolicy(3, 3, 2, [8, 8], torch.Generator().manual_seed(0))
    return collect(policy, env, config, 0, 0), policy


def test_the_virtual_reset_lays_all_paths_over_each_other():
    env = TurnedRoamer(8, 0)
    paths, _ = paths_of(env)
    objective = GridBonus(PRESETS["hippo_authors"], "snake", env.observation_names)
    position, counted = objective.positions(paths)
    # float32 headings; the clipped velocity makes the paths differ only where |v| > 1
    inside = (np.abs(turned(np.tile([1.0, 0.5], (8, 1)), env.heading)) <= 1).all(1)
    assert inside.sum() >= 2
    expected = 0.1 * np.arange(1, 21)[:, None] * [1.0, 0.5]
    np.testing.assert_allclose(position[:, inside], np.repeat(expected[:, None], inside.sum(), 1), atol=1e-5)
    assert not counted[:10].any()
    assert counted[10:].all()
    plain, everything = GridBonus(PRESETS["snn4hrl"], "snake", env.observation_names).positions(paths)
    assert np.abs(plain[:, inside] - expected[:, None]).max() > 1
    assert everything.all()
    # The other sign of the rotation, the authors' own, does not.
    wrong = turned(paths.next_position[..., :2].numpy() - paths.position[0, :, :2].numpy(), env.heading)
    assert np.abs(wrong[:, inside] - expected[:, None]).max() > 0.1


def test_the_reward_is_the_sum_of_its_terms_and_the_opening_steps_earn_survival_only():
    env = RoamEnv(6, 0, death_rate=0.1)
    paths, policy = paths_of(env)
    bonus = Bonus(10.0, 2.0, 5, {"roamer": 3.0}, 0.5, 4, True)
    reward, metrics = GridBonus(bonus, "roamer", env.observation_names).reward(paths, policy)
    T, N = reward.shape
    start, position = paths.start.numpy(), paths.next_position[..., :2].numpy()
    reach = math.ceil(np.abs(position).max())  # every path starts in the origin, heading 0
    cell, skill = np.ceil((position + reach) * 5), paths.skill.numpy()
    visits = collections.Counter()
    for t in range(T):
        for n in range(N):
            if t - start[t, n] >= 4:
                visits[tuple(cell[t, n]), skill[t, n]] += 1
                visits[tuple(cell[t, n])] += 1
    for t in range(T):
        for n in range(N):
            expected = 30.0
            if t - start[t, n] >= 4:
                c = tuple(cell[t, n])
                distance = 5 * np.linalg.norm(position[t, n] - position[start[t, n] + 4, n])
                expected += 10 * (2 * math.log(visits[c, skill[t, n]] / visits[c]) + 0.5 * distance)
            assert float(reward[t, n]) == pytest.approx(expected, rel=1e-9)
    assert metrics["cells_visited"] == sum(len(key) == 2 and not isinstance(key[0], tuple) for key in visits)
    assert bool(paths.steps.done[:-1].any())


def test_robots_that_cannot_die_are_not_paid_for_surviving():
    assert GridBonus(PRESETS["hippo_authors"], "snake", ()).survival == 0
    assert GridBonus(PRESETS["hippo_authors"], "ant", ()).survival == 5
