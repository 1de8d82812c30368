"""HIRO: goals, off-policy correction, TD3, memory, cloning, each against numbers worked by hand or a plain loop."""

import itertools

import numpy as np
import pytest
import torch
from torch import nn

from baselines import hiro, hiro_levels
from baselines.hiro import Agents, HiroConfig, Walk
from hippo.core.acting import rollout
from hippo.core.checkpoint import Checkpoint
from hippo.core.goals import BODY_GOALS, Goals, Memory, candidate_goals
from hippo.core.log import RunLog
from hippo.core.replay import Replay
from hippo.core.settings import ConfigError
from hippo.core.skills import SkillsError
from hippo.core.td3 import TD3
from hippo.envs import make
from tests.hippo.toy import PointMass, TargetEnv, given_skills, progress, run

XY = Goals(torch.tensor([0, 1]), torch.tensor([10.0, 10.0]))
LINE = Goals(torch.tensor([0]), torch.tensor([10.0]))
SMALL = {"hidden_sizes": [16, 16], "minibatch_size": 20, "warmup_steps": 40, "goal_space": "xy", "period": 5}


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def small(**settings):
    return HiroConfig(**({"iterations": 2, "batch_size": 80, "horizon": 20} | SMALL | settings))


def agents_of(config, goals=XY, obs_size=2, action_size=2):
    return Agents(config, goals, obs_size, action_size, generator())


class Linear(nn.Module):
    """mu(x) = weight x, in place of an actor."""

    def __init__(self, weight):
        super().__init__()
        self.weight = torch.tensor(weight)

    def forward(self, x):
        return x @ self.weight.T

    def of_shifted(self, x, shifts):
        for i in range(shifts.shape[1]):
            yield self(torch.cat([x[..., : -shifts.shape[-1]], x[..., -shifts.shape[-1] :] + shifts[:, i : i + 1]], -1))


class Function(nn.Module):
    """A function in place of a network."""

    def __init__(self, function):
        super().__init__()
        self.function = function

    def forward(self, *arguments):
        return self.function(*arguments)


def td3(inputs=1, actions=1, **settings):
    common = {
        "actor_learning_rate": 1e-3,
        "critic_learning_rate": 1e-3,
        "gamma": 0.99,
        "tau": 0.005,
        "delay": 2,
        "target_noise": 0.2,
        "target_noise_clip": 0.5,
    }
    ones = torch.ones(actions)
    return TD3(inputs, ones, ones / 30, [16, 16], generator(), **(common | settings))


# Goals


def test_h2_a_goals_transition_and_reward_worked_by_hand():
    s, g, after = torch.tensor([[0.0, 0.0]]), torch.tensor([[3.0, 4.0]]), torch.tensor([[1.0, 1.0]])
    assert XY.transition(s, g, after).tolist() == [[2.0, 3.0]]
    assert XY.reward(s, g, after).item() == pytest.approx(-3.6055513)


def test_h1_within_a_period_the_wanted_state_stays_and_changes_only_where_a_new_goal_is_set():
    config = small(horizon=20, period=5)
    walk = Walk.begin(agents_of(config), PointMass(3, 0, horizon=20), 0, 0)
    wanted = [XY.of_state(walk.obs) + walk.goal]
    for t in range(19):
        walk.step(t, walk.act())
        wanted.append(XY.of_state(walk.obs) + walk.goal)
    changed = [not torch.allclose(a, b, atol=1e-5) for a, b in itertools.pairwise(wanted)]
    assert [t + 1 for t, c in enumerate(changed) if c] == [5, 10, 15]


def test_h3_the_transition_over_many_steps_is_the_iterated_one():
    states = torch.randn(6, 4, 2, dtype=torch.float64, generator=generator())
    goal = torch.randn(4, 2, dtype=torch.float64, generator=generator(1))
    iterated = goal
    for s, after in itertools.pairwise(states):
        iterated = XY.transition(s, iterated, after)
    torch.testing.assert_close(iterated, XY.transition(states[0], goal, states[-1]))


@pytest.mark.parametrize("robot", BODY_GOALS)
def test_every_robots_goals_are_entries_of_its_observation_with_the_published_number_for_the_ant(robot):
    env = {"ant": "ant_gather", "snake": "snake_gather", "hopper": "block_hopper", "half_cheetah": "block_half_cheetah"}
    envs = make(env[robot], 1, 0)
    goals = Goals.of("body", 10.0, robot, envs.observation_names)
    names = [envs.observation_names[i] for i in goals.index]
    assert names == list(BODY_GOALS[robot])
    assert not {"x", "y", "position_x", "position_y", "com_x", "com_y"} & set(names)
    if robot == "ant":  # hiro_orig.gin without its first two
        assert goals.half_range.tolist() == pytest.approx([0.5, 1, 1, 1, 1] + [0.5, 0.3] * 4)
    envs.close()


def test_with_position_the_ants_goals_are_the_torsos_place_or_place_and_pose():
    envs = make("ant_gather", 1, 0, position=True)
    place = Goals.of("xy", 10.0, "ant", envs.observation_names)
    assert [envs.observation_names[i] for i in place.index] == ["position_x", "position_y"]
    both = Goals.of("both", 10.0, "ant", envs.observation_names)
    published = [10, 10, 0.5, 1, 1, 1, 1, 0.5, 0.3, 0.5, 0.3, 0.5, 0.3, 0.5, 0.3]  # hiro_orig.gin:8-10
    assert both.half_range.tolist() == pytest.approx(published)
    envs.close()


def test_h10_with_both_the_lower_level_is_blind_to_its_place_but_not_to_the_goals_and_the_manager_sees_it():
    goals = Goals(torch.tensor([2, 3, 0]), torch.tensor([10.0, 10.0, 1.0]))  # place last in the observation
    agents = Agents(small(goal_space="both"), goals, 4, 2, generator())
    for p in agents.parameters():
        nn.init.normal_(p, generator=generator(2))
    obs, goal = torch.randn(1, 4, generator=generator(3)), torch.randn(1, 3, generator=generator(4))
    moved, asked = obs.clone(), goal.clone()
    moved[0, 2:] += 1.0
    asked[0, :2] += 1.0
    action = torch.zeros(1, 2)
    assert torch.equal(agents.act(obs, goal, None), agents.act(moved, goal, None))
    values = [agents.low.critics(agents.low_input(o, goal), action) for o in (obs, moved)]
    assert torch.equal(*values)
    assert not torch.equal(agents.act(obs, goal, None), agents.act(obs, asked, None))
    assert not torch.equal(agents.new_goal(obs, None), agents.new_goal(moved, None))


# Off-policy correction


def corrected(weight, rows, candidates, monkeypatch, goals=LINE):
    """The goals that `relabel` chooses among `candidates` (B, M, k) for a lower level that acts linearly."""
    agents = Agents(small(period=rows["action"].shape[1]), goals, 1, 1, generator())
    agents.low.actor = Linear(weight)
    monkeypatch.setattr(hiro_levels, "candidate_goals", lambda *_: candidates)
    return agents.relabel(rows, generator())


def hand_rows():
    """The facts' golden case: mu(s, g) = 0.1 g, c = 2, s = (0, 0.5), then 1, and the stored goal 2."""
    return {
        "obs": torch.tensor([[[0.0], [0.5], [1.0]]]),
        "action": torch.tensor([[[0.2], [0.15]]]),
        "length": torch.tensor([2.0]),
        "goal": torch.tensor([[2.0]]),
    }


def test_h4_the_golden_case_of_the_correction(monkeypatch):
    rows = hand_rows()
    chosen = corrected([[0.0, 0.1]], rows, torch.tensor([[[1.0], [2.0], [3.0]]]), monkeypatch)
    assert chosen.tolist() == [[2.0]]
    # score(1) = score(3) = -0.02: an action that fits 1 exactly makes 1 win.
    rows["action"] = torch.tensor([[[0.1], [0.05]]])
    assert corrected([[0.0, 0.1]], rows, torch.tensor([[[3.0], [2.0], [1.0]]]), monkeypatch).tolist() == [[1.0]]


def test_h4_a_changed_lower_level_makes_the_goal_win_that_a_plain_loop_finds(monkeypatch):
    B, c, M = 7, 4, 10
    rows = {
        "obs": torch.randn(B, c + 1, 1, generator=generator(1)),
        "action": torch.randn(B, c, 1, generator=generator(2)),
        "length": torch.tensor([4.0, 4, 3, 1, 4, 2, 4]),
        "goal": torch.zeros(B, 1),
    }
    candidates = torch.randn(B, M, 1, generator=generator(3))
    weight = [[0.3, 0.7]]
    chosen = corrected(weight, rows, candidates, monkeypatch)
    for b in range(B):
        scores = []
        for g in candidates[b, :, 0].tolist():
            score = 0.0
            for i in range(int(rows["length"][b])):
                s = rows["obs"][b, :, 0].tolist()
                mu = 0.3 * s[i] + 0.7 * (s[0] + g - s[i])
                score -= (rows["action"][b, i, 0].item() - mu) ** 2
            scores.append(score)
        assert chosen[b].item() == candidates[b, int(np.argmax(scores))].item()


def test_h4_the_stored_goal_is_kept_where_the_lower_level_has_not_changed():
    config = small(horizon=20, batch_size=400)
    agents = agents_of(config)
    memory = Memory(1000, 20, (5, 2, 2, 2))
    walk = Walk.begin(agents, PointMass(20, 0, horizon=20), 0, 0)
    walk.generator = None  # no noise: the actions are the lower level's own
    for t in range(20):
        row, is_over, _ = walk.step(t, walk.act())
        memory.add(row, walk.steps.reward[t], is_over)
    rows = memory.manager.sample(50, generator())
    assert torch.equal(agents.relabel(rows, generator()), rows["goal"])


def test_h5_there_are_ten_candidates_all_in_the_box_spread_by_half_of_its_half_range():
    goals = Goals(torch.tensor([0, 1]), torch.tensor([4.0, 1.0]))
    B = 20_000
    first, last = torch.zeros(B, 2), torch.tensor([[0.2, 9.0]]).expand(B, 2)
    stored = torch.full((B, 2), -0.7)
    candidates = candidate_goals(goals, first, last, stored, generator())
    assert candidates.shape == (B, 10, 2)
    assert torch.equal(candidates[:, 0], stored)
    assert not torch.equal(candidates[0, 2:], candidates[1, 2:]), "every decision of a batch has draws of its own"
    assert candidates[0, 1].tolist() == pytest.approx([0.2, 1.0])  # the change achieved, clipped to the box
    assert bool((candidates.abs() <= goals.half_range).all())
    wide = Goals(torch.tensor([0]), torch.tensor([100.0]))
    drawn = candidate_goals(wide, first, torch.ones(B, 2), stored[:, :1], generator())[:, 2:]
    inside = drawn[drawn.abs() < 100]
    assert inside.numel() > 0.94 * drawn.numel()  # within 2 standard deviations of 50
    assert drawn.median().item() == pytest.approx(1.0, abs=1.0)
    assert drawn.quantile(0.8413).item() - drawn.median().item() == pytest.approx(50, rel=0.02)


def test_h6_the_choice_does_not_depend_on_the_units_of_actions(monkeypatch):
    rows, candidates = hand_rows(), torch.tensor([[[1.0], [2.4], [3.0]]])
    chosen = corrected([[0.0, 0.1]], rows, candidates, monkeypatch)
    rows["action"] = rows["action"] * 30
    assert torch.equal(corrected([[0.0, 3.0]], rows, candidates, monkeypatch), chosen)


# Memory


def filled(config, envs, steps, memory):
    walk = Walk.begin(agents_of(config), envs, 0, 0)
    rows = []
    for t in range(steps):
        row, is_over, _ = walk.step(t, walk.act())
        rows.append(row)
        memory.add(row, walk.steps.reward[t], is_over)
    return walk, rows


def test_h7_a_decision_earns_a_tenth_of_the_sum_of_its_rewards_and_an_episode_has_t_over_c_of_them():
    memory = Memory(1000, 1, (10, 2, 2, 2), reward_scale=0.1)
    row = {name: torch.zeros(1, 2) for name in ("obs", "goal", "action", "next_obs", "next_goal")}
    row |= {"reward": torch.zeros(1), "continues": torch.ones(1)}
    for t in range(500):
        memory.add(dict(row), torch.ones(1), torch.tensor([t % 10 == 9]))
    assert memory.manager.added == 50
    assert memory.manager.columns["reward"][:50].tolist() == pytest.approx([1.0] * 50)


def test_a_goal_is_stored_with_the_state_where_it_held_and_the_next_goal_is_the_managers_new_one_at_a_boundary():
    config = small(horizon=20)
    memory = Memory(1000, 2, (5, 2, 2, 2))
    _, rows = filled(config, PointMass(2, 0, horizon=20), 20, memory)
    for t, (row, after) in enumerate(itertools.pairwise(rows)):
        assert torch.equal(row["next_goal"], after["goal"])  # what was acted on next, off by none
        expected = XY.transition(row["obs"], row["goal"], row["next_obs"])
        assert torch.allclose(row["next_goal"], expected) is ((t + 1) % 5 != 0)
    low = memory.low.columns
    torch.testing.assert_close(low["reward"][:40], XY.reward(low["obs"][:40], low["goal"][:40], low["next_obs"][:40]))


def test_a_decisions_row_holds_its_states_actions_and_what_followed_also_where_an_episode_cut_it_short():
    config = small(horizon=18, batch_size=18, period=5)
    memory = Memory(1000, 3, (5, 2, 2, 2))
    envs = TargetEnv(3, 0, horizon=18, death_rate=0.15)
    walk, rows = filled(config, envs, 18, memory)
    lengths, age, expected = [], np.zeros(3, int), []
    for t in range(18):
        age += 1
        for n in range(3):
            done = bool(walk.steps.done[t, n])
            if done or age[n] == 5:
                expected.append((t, n, int(age[n]), bool(walk.steps.terminated[t, n])))
                age[n] = 0
    assert memory.manager.added == len(expected)
    assert any(length < 5 and ended for _, _, length, ended in expected)
    for k, (t, n, length, ended) in enumerate(expected):
        row = {name: column[k] for name, column in memory.manager.columns.items()}
        begin = t - length + 1
        assert row["length"] == length
        assert row["continues"] == (not ended)
        assert torch.equal(row["goal"], rows[begin]["goal"][n])
        assert torch.equal(row["obs"][-1], rows[t]["next_obs"][n])
        for i in range(length):
            assert torch.equal(row["obs"][i], rows[begin + i]["obs"][n])
            assert torch.equal(row["action"][i], rows[begin + i]["action"][n])
        assert not row["action"][length:].any(), "nothing stale is left of the decision before"
        reward = sum(walk.steps.reward[begin + i, n].item() for i in range(length))
        assert row["reward"].item() == pytest.approx(reward, abs=1e-5)
        lengths.append(length)


def test_h11_a_death_ends_the_bootstrap_a_time_limit_does_not_and_ignore_terminals_ends_none():
    config = small(horizon=18, batch_size=18)
    for ignores in (False, True):
        memory = Memory(1000, 30, (5, 2, 2, 2), ignore_terminals=ignores)
        walk, rows = filled(config, TargetEnv(30, 0, horizon=18, death_rate=0.05), 18, memory)
        died = walk.steps.terminated.flatten()
        assert bool(died.any())
        assert bool((walk.steps.done.flatten() & ~died).any())
        continues = memory.low.columns["continues"][: 30 * 18]
        assert torch.equal(continues == 0, died & torch.tensor(not ignores))
        for t, n in walk.steps.done.nonzero().tolist():
            final = rows[t]["next_obs"][n]
            assert not torch.equal(final, walk.steps.obs[t + 1, n]), "what followed is not the next episode's start"


def test_the_replay_keeps_the_newest_rows_and_a_checkpoint_holds_only_what_is_there():
    replay = Replay(5, x=())
    replay.add(x=torch.arange(3.0))
    assert replay.state_dict()["columns"]["x"].tolist() == [0, 1, 2]
    replay.add(x=torch.arange(3.0, 7.0))
    assert sorted(replay.columns["x"].tolist()) == [2, 3, 4, 5, 6]
    again = Replay(5, x=())
    again.load_state_dict(replay.state_dict())
    again.add(x=torch.tensor([7.0]))
    replay.add(x=torch.tensor([7.0]))
    assert again.columns["x"].tolist() == replay.columns["x"].tolist()
    seen = {int(v) for v in replay.sample(200, generator())["x"]}
    assert seen == {3, 4, 5, 6, 7}


# TD3


def test_h9_targets_move_by_tau_every_second_update_and_the_actor_with_them():
    agent = td3()
    for p in agent.target_critics.parameters():
        nn.init.zeros_(p)
    x, y = torch.randn(8, 1, generator=generator(1)), torch.randn(8, generator=generator(2))
    actor = [p.clone() for p in agent.actor.parameters()]
    arguments = (x, torch.zeros(8, 1), y, x, torch.ones(8), generator(3))
    agent.update(*arguments)
    assert all(not p.any() for p in agent.target_critics.parameters())
    assert all(torch.equal(p, q) for p, q in zip(actor, agent.actor.parameters(), strict=True))
    agent.update(*arguments)
    for target, online in zip(agent.target_critics.parameters(), agent.critics.parameters(), strict=True):
        torch.testing.assert_close(target, 0.005 * online)
    assert any(not torch.equal(p, q) for p, q in zip(actor, agent.actor.parameters(), strict=True))


def test_h9_the_target_is_the_smaller_critic_with_clipped_noise_that_may_leave_the_box():
    agent = td3()
    seen = []

    def critics(x, action):
        seen.append(action)
        return torch.stack([action[:, 0] + 1, action[:, 0] - 1])

    agent.target_critics = Function(critics)
    agent.target_actor = Function(lambda x: torch.ones(len(x), 1))
    reward, continues = torch.full((4000,), 2.0), torch.ones(4000)
    continues[0] = 0.0
    y = agent.target(reward, torch.zeros(4000, 1), continues, generator())
    (action,) = seen
    torch.testing.assert_close(y[1:], 2 + 0.99 * (action[1:, 0] - 1))
    assert y[0] == 2.0
    noise = action[:, 0] - 1
    assert noise.max() > 0  # beyond the box, as published
    assert noise.abs().max().item() == pytest.approx(0.5 / 30)
    assert noise.std().item() == pytest.approx(0.2 / 30, rel=0.05)


def test_the_critics_are_two_networks_that_see_the_action_twice():
    agent = td3(inputs=3, actions=2)
    x, action = torch.randn(5, 3, generator=generator(1)), torch.randn(5, 2, generator=generator(2))
    values = agent.critics(x, action)
    for j in range(2):
        (w1, w2, w3), (b1, b2, b3) = ([p[j] for p in group] for group in (agent.critics.weights, agent.critics.biases))
        hidden = (torch.cat([x, action], 1) @ w1 + b1).relu()
        hidden = (torch.cat([hidden, action], 1) @ w2 + b2).relu()
        torch.testing.assert_close(values[j], (hidden @ w3 + b3).squeeze(-1))
    torch.testing.assert_close(agent.critics(x, action, 1)[0], values[0])
    assert not torch.allclose(values[0], values[1])


def test_initial_weights_are_within_the_published_bounds():
    agent = td3(inputs=9, actions=2)
    first, second, last = agent.actor.layers
    for layer, bound in ((first, 1 / 3), (second, 1 / 4), (last, 0.003)):
        for p in (layer.weight, layer.bias):
            assert p.abs().max().item() <= bound
        assert layer.weight.abs().max().item() > 0.8 * bound


def test_h8_a_constant_reward_is_worth_its_sum():
    agent = td3(gamma=0.9, tau=0.05, critic_learning_rate=3e-3)
    x = torch.zeros(32, 1)
    noise = generator(1)
    for _ in range(1500):
        action = 2 * torch.rand(32, 1, generator=noise) - 1  # whatever the actor comes to do is known
        agent.update(x, action, torch.full((32,), -0.5), x, torch.ones(32), noise)
    assert agent.critics(x, torch.zeros(32, 1)).mean().item() == pytest.approx(-0.5 / (1 - 0.9), rel=0.05)


def test_exploration_is_a_thirtieth_of_the_torque_and_a_tenth_of_the_goal_box_or_absolute():
    obs, goal = torch.zeros(20_000, 2), torch.zeros(20_000, 2)
    for units, of_action, of_goal in (("range", 1 / 30, 1.0), ("absolute", 1.0, 1.0)):
        agents = agents_of(small(noise_units=units))
        noise = torch.randn(20_000, 2, generator=generator())
        assert agents.low.unit.tolist() == pytest.approx([of_action] * 2)
        assert agents.manager.unit.tolist() == pytest.approx([of_goal] * 2)
        action, wanted = agents.act(obs, goal, noise), agents.new_goal(obs, noise)
        assert action.abs().max() <= 1
        assert wanted.abs().max() <= 10
        assert wanted.std().item() == pytest.approx(of_goal, rel=0.02)
    assert agents_of(small(), Goals(torch.tensor([0, 1]), torch.tensor([0.5, 4.0]))).manager.unit.tolist() == (
        pytest.approx([0.05, 0.4])
    )


# Training


def train_point(folder, config, seed=0):
    def make_envs(num_envs, purpose):
        return PointMass(num_envs, seed, horizon=config.horizon)

    hiro.train(config, make_envs, RunLog(folder), seed, Checkpoint(folder))


def test_updates_keep_their_ratio_to_steps_across_iterations_and_the_last_checkpoint_has_no_buffers(tmp_path):
    config = small(iterations=3, updates_per_step=0.5)
    train_point(tmp_path, config)
    columns = progress(tmp_path)
    assert columns["updates"].tolist() == [20, 40, 40]
    assert columns["env_steps"].tolist() == [80, 160, 240]
    state = Checkpoint(tmp_path).load()
    assert state["agents"]["low.updates"] == 100
    assert state["agents"]["manager.updates"] == 10
    assert len(state["low_replay"]["columns"]["obs"]) == 0


def test_a_rollout_of_a_trained_run_repeats_itself_and_greedy_leaves_the_noise_out(tmp_path):
    config = small()
    train_point(tmp_path, config)
    noisy = [rollout(hiro, config, PointMass(4, 0, 20), 3, Checkpoint(tmp_path)).action for _ in range(2)]
    assert torch.equal(*noisy)
    greedy = rollout(hiro, config, PointMass(4, 0, 20), 3, Checkpoint(tmp_path), greedy=True)
    assert not torch.equal(noisy[0], greedy.action)
    assert greedy.done[-1].all()


def test_given_skills_fill_both_buffers_with_the_change_that_a_period_achieved(tmp_path):
    given_skills(tmp_path / "skills.pt")
    config = small(skills=str(tmp_path / "skills.pt"), horizon=18, batch_size=18)
    envs = TargetEnv(3, 0, horizon=18, death_rate=0.05)
    agents = hiro.make_agents(config, envs, 0)
    memory = Memory(1000, 3, (5, 2, 2, 2))
    hiro.skill_rollouts(config, agents, memory, envs, 0)
    assert memory.low.added == 54
    low = {name: column[:54].view(18, 3, *column.shape[1:]) for name, column in memory.low.columns.items()}
    rows = {name: column[: memory.manager.added] for name, column in memory.manager.columns.items()}
    # The goal of a decision is where it led, and it is reached at its end.
    torch.testing.assert_close(rows["goal"], rows["obs"][:, -1, :2] - rows["obs"][:, 0, :2])
    reached = low["obs"][..., :2] + low["goal"]
    changes = 0
    for n in range(3):
        for t in range(17):
            same = torch.allclose(reached[t, n], reached[t + 1, n])
            ended = torch.allclose(reached[t, n], low["next_obs"][t, n, :2])
            assert same or ended
            changes += not same
    assert changes >= 3 * 3
    assert rows["length"].sum() == 54


def test_cloning_makes_the_lower_level_act_as_the_demonstrations():
    config = small(cloning_updates=1500, minibatch_size=64)
    agents = agents_of(config)
    replay = Replay(500, obs=(2,), goal=(2,), action=(2,))
    obs, goal = torch.randn(500, 2, generator=generator(1)), torch.randn(500, 2, generator=generator(2))
    action = (0.5 * obs - 0.3 * goal).clamp(-0.9, 0.9)
    replay.add(obs=obs, goal=goal, action=action)
    before = (agents.act(obs, goal, None) - action).square().mean().item()
    hiro.clone(config, agents, replay, 0)
    assert (agents.act(obs, goal, None) - action).square().mean().item() < 0.05 * before
    same = zip(agents.low.actor.parameters(), agents.low.target_actor.parameters(), strict=True)
    assert all(torch.equal(p, q) for p, q in same)


def test_training_from_given_skills_resumes_to_the_same_bytes(tmp_path, monkeypatch):
    given_skills(tmp_path / "skills.pt")
    settings = {"skills": str(tmp_path / "skills.pt"), "cloning_steps": 40, "cloning_updates": 20}
    run(hiro.train, small(**settings), tmp_path / "whole")
    record = Checkpoint.record

    def interrupted(self, iteration, **parts):
        record(self, iteration, **parts)
        raise KeyboardInterrupt

    monkeypatch.setattr(Checkpoint, "record", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run(hiro.train, small(**settings), tmp_path / "cut")
    monkeypatch.setattr(Checkpoint, "record", record)
    run(hiro.train, small(**settings), tmp_path / "cut")
    for file in ("progress.csv", "checkpoint.pt"):
        assert (tmp_path / "cut" / file).read_bytes() == (tmp_path / "whole" / file).read_bytes()


def test_skills_of_another_robot_are_refused(tmp_path):
    given_skills(tmp_path / "skills.pt")
    config = small(skills=str(tmp_path / "skills.pt"))
    with pytest.raises(SkillsError, match="robot is toy, the policy's point"):
        train_point(tmp_path / "run", config)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"period": 21}, "period=21: must be at most the horizon, 20 steps"),
        ({"replay_size": 10}, "replay_size=10: must be at least the minibatch, 20 transitions"),
        ({"batch_size": 10}, "batch_size=10: must be at least one horizon, 20 steps"),
        ({"hidden_sizes": [16]}, r"hidden_sizes=\[16\]: must be two layers"),
        ({"tau": 0.0}, "tau=0.0: must be greater than 0"),
    ],
)
def test_bad_settings_are_refused_by_name(settings, message):
    with pytest.raises(ConfigError, match=message):
        small(**settings)


def test_goals_beyond_the_observation_are_refused_by_name():
    with pytest.raises(ConfigError, match=r"goal_space=xy: needs env\.position=true"):
        small().check_environment("ant", {})
    with pytest.raises(ConfigError, match=r"goal_space=body: knows the pose of ant, .*, not of point"):
        small(goal_space="body").check_environment("point", {})
    small().check_environment("ant", {"position": True})


# Learning, minutes: make test-slow


@pytest.mark.slow
def test_the_lower_level_alone_reaches_goals_that_are_drawn_at_random():
    config = small(
        horizon=40,
        batch_size=400,
        hidden_sizes=[64, 64],
        minibatch_size=100,
        position_range=1.0,
        noise_units="absolute",
    )
    envs = PointMass(10, 0, horizon=40)
    goals = Goals.of("xy", 1.0, "point", list(envs.observation_names))
    agents = Agents(config, goals, 2, 2, generator())
    rng, memory = generator(5), Memory(100_000, 10, (5, 2, 2, 2))

    def reached(explores, iteration, learns):
        agents.new_goal = lambda obs, noise: 2 * torch.rand(len(obs), 2, generator=rng) - 1
        walk = Walk.begin(agents, envs, 0, iteration, explores)
        memory.abandon()
        ends = []
        for t in range(40):
            wanted_is_inside = ((walk.obs + walk.goal).abs() <= torch.tensor([2.0, 1.0])).all(1)
            row, is_over, distance = walk.step(t, walk.act())
            memory.add(row, walk.steps.reward[t], is_over)
            ends.append((distance < 0.25)[is_over & wanted_is_inside])
            if learns:
                for _ in range(10):
                    agents.learn_low(memory.low, rng)
        return torch.cat(ends)

    for iteration in range(40):
        reached(True, iteration, True)
    success = torch.cat([reached(False, 1000 + i, False) for i in range(10)]).float().mean().item()
    print(f"goals within 0.25 m at the end of a period of 5 steps: {success:.1%}")
    assert success >= 0.9


@pytest.mark.slow
def test_hiro_gets_through_a_short_corridor_flat_td3_is_printed_beside_it(tmp_path):
    def success(steps):
        """Share of episodes that end within half a metre of the corridor's end."""
        return (steps.obs[:-1][-1] - torch.tensor([1.8, 0.0])).norm(dim=1).lt(0.5).float().mean().item()

    config = small(
        iterations=50,
        horizon=40,
        batch_size=400,
        hidden_sizes=[64, 64],
        minibatch_size=100,
        position_range=1.25,
        noise_units="absolute",
        warmup_steps=800,
        manager_reward_scale=1.0,
    )
    train_point(tmp_path / "hiro", config)
    steps = rollout(hiro, config, PointMass(100, 1, 40), 1, Checkpoint(tmp_path / "hiro"), greedy=True)
    hierarchical = success(steps)

    flat, envs, rng = td3(2, 2, gamma=0.99), PointMass(10, 0, 40), generator(7)
    replay = Replay(100_000, x=(2,), action=(2,), reward=(), next_x=(2,), continues=())
    for _ in range(50):
        obs = torch.from_numpy(envs.reset()[0])
        for _step in range(40):
            with torch.no_grad():
                action = (flat.actor(obs) + 0.1 * torch.randn(10, 2, generator=rng)).clamp(-1, 1)
            after, reward, _, _, info = envs.step(action.numpy())
            following = torch.from_numpy(info.get("final_obs", after))
            replay.add(
                x=obs, action=action, reward=torch.from_numpy(reward), next_x=following, continues=torch.ones(10)
            )
            obs = torch.from_numpy(after)
            for _ in range(10):
                rows = replay.sample(100, rng)
                flat.update(*(rows[name] for name in ("x", "action", "reward", "next_x", "continues")), rng)
    envs = PointMass(100, 1, 40)
    obs = torch.from_numpy(envs.reset()[0])
    for _ in range(39):
        with torch.no_grad():
            obs = torch.from_numpy(envs.step(flat.actor(obs).numpy())[0])
    flat_success = (obs - torch.tensor([1.8, 0.0])).norm(dim=1).lt(0.5).float().mean().item()
    print(f"success in the corridor: HIRO {hierarchical:.0%}, flat TD3 {flat_success:.0%}")
    assert hierarchical >= 0.8
