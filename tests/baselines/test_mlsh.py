"""MLSH: its golden number, its schedule, and that without the schedule it is HiPPO."""

import copy
import itertools
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from baselines import mlsh
from hippo import envs as robot_envs
from hippo import hippo
from hippo.core import seeding
from hippo.core.acting import rollout
from hippo.core.advantages import Baselines, advantages
from hippo.core.checkpoint import Checkpoint, load
from hippo.core.gae import gae, segment_gae
from hippo.core.hierarchy import HierarchicalPolicy, collect
from hippo.core.levels import levels
from hippo.core.log import RunLog
from hippo.core.minibatch import maximize_in_minibatches, minibatches
from hippo.core.policies import Manager
from hippo.core.ppo import Level, maximize
from hippo.core.settings import ConfigError
from hippo.core.skills import SkillsError
from tests.hippo.toy import TargetEnv, given_skills, progress, run

MATCHED = {
    "manager_learning_rate": 3e-3,
    "skill_learning_rate": 3e-3,
    "manager_minibatch_size": 0,
    "skill_minibatches": 1,
    "clip_range": 0.1,
    "gamma": 0.999,
    "gae_lambda": 1.0,
    "manager_advantage": "step",
    "exploration": 0.0,
}


def config_of(**settings):
    small = {"iterations": 1, "batch_size": 200, "horizon": 20, "num_skills": 3, "period_min": 5, "period_max": 5}
    return mlsh.MLSHConfig(**(small | settings))


def policy_of(config, seed=0):
    return mlsh.MLSHPolicy(config, 2, 2, 2, torch.Generator().manual_seed(seed))


class Values:
    """Baselines that predict a given table."""

    def __init__(self, table):
        self.table = torch.tensor(table, dtype=torch.float64).unsqueeze(-1)

    def predict(self, kind, obs, time_left, skill):
        return self.table[: len(obs)] if len(obs) == len(self.table) else torch.zeros(len(obs), dtype=torch.float64)


def test_the_masters_advantages_are_the_published_codes_on_the_fact_sheets_example():
    # Two decisions of two steps: delta_1 = 2 - 0.25 = 1.75; delta_0 = (1 + 1) + 0.99 * 0.25 - 0.5 = 1.7475;
    # A_0 = 1.7475 + 0.99 * 0.98 * 1.75 = 3.44535.
    reward = torch.tensor([1.0, 1.0, 0.0, 2.0], dtype=torch.float64).unsqueeze(-1)
    end = torch.tensor([False, False, False, True]).unsqueeze(-1)
    decision = torch.tensor([True, False, True, False, True]).unsqueeze(-1)
    nothing = torch.empty(0, dtype=torch.long)
    steps = SimpleNamespace(
        obs=torch.zeros(5, 1, 2),
        reward=reward,
        scaled_reward=reward,
        terminated=end,
        done=end,
        final=lambda: (torch.zeros(0, 2), nothing, nothing),
    )
    batch = SimpleNamespace(
        steps=steps, time_left=torch.zeros(5, 1), skill=torch.zeros(5, 1, dtype=torch.long), is_decision=decision
    )
    values = Values([0.5, 9.0, 0.25, 9.0, 9.0])  # what is not at a decision must not matter
    config = config_of(period_min=2, period_max=2)
    advantage, returns = mlsh.macro_advantages(batch, values, config)
    torch.testing.assert_close(advantage[decision[:-1]], torch.tensor([3.44535, 1.75], dtype=torch.float64))
    torch.testing.assert_close(returns[decision[:-1]], torch.tensor([3.94535, 2.0], dtype=torch.float64))

    # The near misses: rewards discounted inside a commitment; GAE over steps.
    arguments = (reward, values.table[:-1], values.table[1:], end, end)
    inside = segment_gae(*arguments, decision[:-1], 0.99, 0.98)
    assert inside[0, 0] != pytest.approx(3.44535, abs=1e-3)
    assert gae(*arguments, 0.99, 0.98)[0, 0] != pytest.approx(3.44535, abs=1e-3)


def after(iterations, tmp_path, **settings):
    """The checkpoint after so many iterations of a run with W = 2, T = 3."""
    settings = {"warmup_iterations": 2, "joint_iterations": 3, "manager_minibatch_size": 16} | settings
    run(mlsh.train, config_of(iterations=iterations, **settings), tmp_path / str(iterations))
    return load(tmp_path / str(iterations) / "checkpoint.pt")


def same(a, b, prefix=""):
    return all(bool((a[name] == b[name]).all()) for name in a if name.startswith(prefix))


def test_skills_move_in_joint_iterations_only_and_the_master_in_all(tmp_path):
    states = [after(k, tmp_path)["policy"] for k in range(1, 9)]
    moved = [not same(before, now, "skills") for before, now in itertools.pairwise(states)]
    # states[k] is after iteration k; joint are iterations 2, 3, 4 and 7. The published code's first is one earlier.
    assert moved == [False, True, True, True, False, False, True]
    generator = seeding.torch_generator(0, "initialisation")
    assert same(states[0], mlsh.MLSHPolicy(config_of(), 2, 2, 2, generator).state_dict(), "skills")
    assert not any(same(a, b, "manager") for a, b in itertools.pairwise(states))
    assert progress(tmp_path / "8")["joint"].tolist() == [0, 0, 1, 1, 1, 0, 0, 1]
    assert progress(tmp_path / "8")["cycle"].tolist() == [0, 0, 0, 0, 0, 1, 1, 1]


def test_a_new_cycle_has_a_new_master_with_fresh_moments_and_values():
    config = config_of()
    policy, baselines = policy_of(config), Baselines(config, 2, torch.Generator().manual_seed(0))
    optimizer = torch.optim.Adam(policy.manager.parameters(), lr=0.1)
    policy.manager.log_probs(torch.ones(4, 2))[:, 0].sum().backward()
    optimizer.step()
    baselines.single.fit(torch.randn(50, 2), torch.randn(50), 5)
    skills = copy.deepcopy(policy.skills.state_dict())
    masters = []
    for cycle in (1, 2):
        mlsh.start_cycle(config, policy, baselines, optimizer, seeding.torch_generator(0, "master", cycle))
        fresh = Manager(2, 3, config.manager_hidden_sizes, seeding.torch_generator(0, "master", cycle))
        assert same(policy.manager.state_dict(), fresh.state_dict())
        masters.append(copy.deepcopy(policy.manager.state_dict()))
    assert not same(*masters, "logits.0.weight")  # the published code starts every cycle with the same weights
    assert not optimizer.state  # the published code keeps Adam's moments
    assert not baselines.single.is_fitted
    assert same(policy.skills.state_dict(), skills)


def test_the_masters_adam_counts_from_the_start_of_its_cycle_and_the_skills_from_that_of_the_run(tmp_path):
    # 10 environments x 4 decisions: 40 // 16 = 2 minibatches x 10 passes; skills: 15 minibatches x 10 passes.
    steps = {k: after(k, tmp_path)["manager_optimizer"]["state"][0]["step"].item() for k in (1, 5, 6)}
    assert steps == {1: 20, 5: 100, 6: 20}
    assert load(tmp_path / "6/checkpoint.pt")["skill_optimizer"]["state"][0]["step"].item() == 3 * 150


class Recorder(TargetEnv):
    """Notes with which layout every seeded reset happens."""

    def reset(self, *, seed=None, options=None):
        if options:
            self.layout = options["layout_seed"]
        if seed is not None:
            self.notes.append(self.layout)
        return super().reset(seed=seed, options=options)


def layouts(config, folder):
    envs = Recorder(config.num_envs, 0, horizon=config.horizon)
    envs.notes = []
    mlsh.train(config, lambda *_: envs, RunLog(folder), 0, Checkpoint(folder))
    return envs.notes


def test_the_configuration_is_asked_for_once_per_cycle_also_by_a_resumed_run(tmp_path):
    cycle = {"warmup_iterations": 1, "joint_iterations": 2}
    notes = layouts(config_of(iterations=7, **cycle), tmp_path / "whole")
    assert len(notes) == 7
    assert [notes.index(n) for n in notes] == [0, 0, 0, 3, 3, 3, 6]
    resumed = [layouts(config_of(iterations=n, **cycle), tmp_path / "cut") for n in (2, 5, 7)]
    assert [*itertools.chain(*resumed)] == notes


def test_walls_stay_where_they_are_for_a_whole_cycle_and_poses_do_not(tmp_path):
    config = config_of(iterations=4, batch_size=60, horizon=30, warmup_iterations=1, joint_iterations=1)
    envs = robot_envs.make("block_hopper", 2, 0, horizon=30)
    seen, reset = [], envs.reset

    def noting(**arguments):
        obs, info = reset(**arguments)
        if "seed" in arguments:
            task = np.concatenate([np.ravel(x) for _, x in sorted(envs.get_state()["task"].items())])
            seen.append((task.tobytes(), obs[:, : envs.robot_size].tobytes()))
        return obs, info

    envs.reset = noting
    mlsh.train(config, lambda *_: envs, RunLog(tmp_path), 0, Checkpoint(tmp_path))
    walls, poses = zip(*seen, strict=True)
    assert walls[0] == walls[1] != walls[2] == walls[3]
    assert len(set(poses)) == 4


def test_a_skill_learns_from_its_own_steps_only():
    config = config_of(**MATCHED)
    policy = policy_of(config)
    with torch.no_grad():
        policy.manager.logits[-1].bias[2] = -1e9  # skill 2 is never chosen
    batch = collect(policy, TargetEnv(10, 0), config, 0, 0)
    (level,) = levels(policy, batch, batch.steps.reward, batch.steps.reward, ["skill"])
    level.log_prob(slice(None)).sum().backward()
    weight = policy.skills.first.weight.grad  # columns: x (2), z (3), x z (6, x major)
    own = {z: weight[:, [2 + z, 5 + z, 8 + z]].abs().sum().item() for z in range(3)}
    assert own[0] > 0
    assert own[1] > 0
    assert own[2] == 0
    counts = torch.bincount(batch.skill[:-1].flatten(), minlength=3)
    assert counts.sum() == 200
    assert counts[2] == 0


@pytest.mark.parametrize("trained", [["manager", "skill"], ["manager"]])
def test_joint_from_the_first_iteration_and_without_resets_it_makes_hippos_update_with_a_fixed_period(trained):
    # With ["manager"], an endless warm-up, it is HiPPO with frozen skills.
    config = config_of(**MATCHED, warmup_iterations=0, joint_iterations=1000)
    shared = {"iterations": 1, "batch_size": 200, "horizon": 20, "num_skills": 3, "period_min": 5, "period_max": 5}
    theirs = hippo.HippoConfig(**shared, train_skills="skill" in trained)
    mine, reference = policy_of(config), HierarchicalPolicy(theirs, 2, 2, 2, torch.Generator().manual_seed(1))
    reference.load_state_dict(mine.state_dict())
    before = copy.deepcopy(mine.state_dict())
    my_baselines, their_baselines = (Baselines(c, 2, torch.Generator().manual_seed(2)) for c in (config, theirs))
    joint = torch.optim.Adam(reference.parameters(), lr=theirs.learning_rate)
    optimizers = {
        "manager": torch.optim.Adam(mine.manager.parameters(), lr=config.manager_learning_rate, fused=True),
        "skill": torch.optim.Adam(mine.skills.parameters(), lr=config.skill_learning_rate, fused=True),
    }
    for iteration in range(2):
        batch = collect(reference, TargetEnv(10, 0, death_rate=0.02), theirs, 0, iteration)
        again = collect(mine, TargetEnv(10, 0, death_rate=0.02), config, 0, iteration)
        torch.testing.assert_close(again.steps.action, batch.steps.action)
        estimate = advantages(batch, their_baselines, theirs)
        objective = levels(reference, batch, estimate.manager, estimate.skills, trained)
        maximize(objective, joint, theirs.updates, theirs.clip_range, 200)
        their_baselines.fit(batch, estimate.returns)
        estimate = mlsh.estimate_and_fit(batch, my_baselines, config)
        objective = levels(mine, batch, estimate.manager, estimate.skills, trained)
        mlsh.optimize(config, objective, optimizers, 200, 0, iteration)
    for name, parameter in reference.state_dict().items():
        torch.testing.assert_close(mine.state_dict()[name], parameter, rtol=1e-4, atol=1e-6)
    assert not same(mine.state_dict(), before, "manager")
    assert same(mine.state_dict(), before, "skills") is ("skill" not in trained)


def test_a_tenth_of_the_masters_choices_is_uniform_while_training_and_its_learning_does_not_see_that():
    config = config_of(exploration=0.1, batch_size=20000, horizon=20, period_min=1, period_max=1)
    policy = policy_of(config)
    with torch.no_grad():
        policy.manager.logits[-1].weight.zero_()
        policy.manager.logits[-1].bias.copy_(torch.tensor([0.6, 0.3, 0.1]).log())
    pi = torch.tensor([0.6, 0.3, 0.1])
    batch = collect(policy, TargetEnv(1000, 0), config, 0, 0)
    frequency = torch.bincount(batch.skill[:-1].flatten(), minlength=3) / 20000
    error = 4 * (0.25 / 20000) ** 0.5
    torch.testing.assert_close(frequency, 0.9 * pi + 0.1 / 3, atol=error, rtol=0)
    assert (frequency - pi).abs().max() > error  # what choosing by pi alone would give
    torch.testing.assert_close(policy.manager.log_probs(torch.zeros(1, 2)).exp()[0], pi)


def test_no_step_follows_an_episodes_end_without_a_decision():
    config = config_of(batch_size=2000, horizon=200, period_min=10, period_max=10)
    batch = collect(policy_of(config), TargetEnv(10, 0, horizon=200, death_rate=0.1), config, 0, 0)
    assert bool(batch.is_decision[1:][batch.steps.done].all())
    length = np.diff(batch.is_decision[:, 0].nonzero().squeeze(-1).numpy())
    assert length.max() == 10
    assert length.min() < 10  # ends cut commitments


def test_minibatches_are_even_and_use_every_row_once_per_pass_in_ascending_order():
    parts = list(minibatches(103, 10, 3, torch.Generator().manual_seed(0)))
    assert len(parts) == 30
    assert {len(p) for p in parts} == {10, 11}  # no small rest that would weigh as much as the others
    for first in (0, 10, 20):
        assert torch.cat(parts[first : first + 10]).sort().values.tolist() == list(range(103))
    assert all(bool((p.diff() > 0).all()) for p in parts)
    assert not torch.equal(parts[0], parts[10])


def test_a_minibatch_step_follows_the_mean_surrogate_of_its_rows():
    # One parameter, log pi = theta x: at ratio one the surrogate's gradient is the mean of x A over the minibatch.
    theta = torch.zeros(1, dtype=torch.float64, requires_grad=True)
    x, advantage = torch.randn(12, dtype=torch.float64), torch.randn(12, dtype=torch.float64)
    level = Level("manager", lambda c: theta * x[c], advantage)
    optimizer = torch.optim.SGD([theta], lr=1e-3)
    maximize_in_minibatches(level, optimizer, 1, 3, 0.2, 12, torch.Generator().manual_seed(0))
    expected = 0.0
    for rows in minibatches(12, 3, 1, torch.Generator().manual_seed(0)):
        ratio = (expected * x[rows]).exp()
        expected += 1e-3 * float((ratio * x[rows] * advantage[rows]).mean())
    assert float(theta.detach()) == pytest.approx(expected, rel=1e-9)


def test_a_trained_hierarchy_is_evaluated_without_exploration_and_in_random_configurations(tmp_path):
    config = config_of(iterations=2, exploration=1.0)
    run(mlsh.train, config, tmp_path)
    envs = Recorder(10, 3)
    envs.notes, envs.layout = [], None
    greedy = [rollout(mlsh, config, envs, 1, Checkpoint(tmp_path), greedy=True) for _ in range(2)]
    assert torch.equal(greedy[0].action, greedy[1].action)
    assert envs.notes == [None, None]
    trained = policy_of(config)
    trained.load_state_dict(load(tmp_path / "checkpoint.pt")["policy"])
    trained.manager.exploration = 0.0
    batch = collect(trained, TargetEnv(10, 3), config, 1, 0, greedy=True)
    assert torch.equal(batch.steps.action, greedy[0].action)


def test_a_run_starts_from_given_skills_bit_by_bit_and_refuses_others_by_name(tmp_path):
    state = given_skills(tmp_path / "skills.pt")
    run(mlsh.train, config_of(skills=str(tmp_path / "skills.pt")), tmp_path / "warm-up")
    after_warm_up = load(tmp_path / "warm-up/checkpoint.pt")["policy"]
    assert all(torch.equal(after_warm_up[f"skills.{name}"], value) for name, value in state.items())
    with pytest.raises(SkillsError, match="its num_skills is 3, the policy's 4"):
        run(mlsh.train, config_of(skills=str(tmp_path / "skills.pt"), num_skills=4), tmp_path / "wrong")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"period_min": 4}, "period_min=4: MLSH's period is fixed: period_max=5"),
        ({"period_min": 30, "period_max": 30}, "period_max=30: must be at most the horizon, 20 steps"),
        ({"joint_iterations": 0}, "joint_iterations=0: must be at least 1"),
        ({"skill_baseline": "single"}, "skill_baseline=single: manager_advantage=macro needs skill or none"),
        ({"truncate_to_period": True}, "truncate_to_period=True: needs manager_advantage step or smdp"),
        ({"exploration": 1.5}, "exploration=1.5: must be at most 1.0"),
    ],
)
def test_settings_that_cannot_work_are_refused_by_name(settings, message):
    with pytest.raises(ConfigError, match=f"^{message}$"):
        config_of(**settings)
