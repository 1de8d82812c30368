"""What every learner must do: learn "action = observation" in seconds, repeat itself, and resume exactly."""

import dataclasses

import numpy as np
import pytest
import torch

from baselines import hier_vpg, hiro, mlsh, option_critic, ppo
from hippo import hippo
from hippo.core import seeding
from hippo.core.checkpoint import Checkpoint, load
from hippo.core.hierarchy import HierarchicalPolicy, collect
from hippo.core.levels import levels
from hippo.core.log import Diverged
from hippo.core.optimizers import Adam
from hippo.core.policies import GaussianPolicy
from hippo.core.ppo import maximize
from tests.hippo.toy import TargetEnv, progress, run

BUDGET = {"iterations": 25, "batch_size": 2000, "horizon": 20}
# The settings of experiments/conf/protocol/modern.yaml, but for minibatches of a size for small batches.
MODERN = {
    "initialisation": "normc",
    "normalize_observations": True,
    "scale_rewards": True,
    "minibatch_size": 50,
    "value_loss_weight": 0.5,
    "max_gradient_norm": 0.5,
    "learning_rate": 3e-3,
    "clip_range": 0.2,
    "gae_lambda": 0.95,
    "bootstrap_horizon": True,
}
LEARNERS = {
    "hippo random p": (hippo.train, hippo.HippoConfig, {"num_skills": 3, "period_min": 2, "period_max": 6}),
    "hippo p = 5": (hippo.train, hippo.HippoConfig, {"num_skills": 3, "period_min": 5, "period_max": 5}),
    "hippo p = 1, single baseline": (
        hippo.train,
        hippo.HippoConfig,
        {"num_skills": 3, "period_min": 1, "period_max": 1, "skill_baseline": "single"},
    ),
    "hier_vpg": (hier_vpg.train, hier_vpg.HierVPGConfig, {"num_skills": 3, "period_min": 5, "period_max": 5}),
    "mlsh": (
        mlsh.train,
        mlsh.MLSHConfig,
        {
            "num_skills": 3,
            "period_min": 5,
            "period_max": 5,
            "warmup_iterations": 1,
            "joint_iterations": 8,
            "skill_learning_rate": 3e-3,
            "manager_minibatch_size": 16,
            "skill_minibatches": 3,
        },
    ),
    "option_critic": (
        option_critic.train,
        option_critic.OptionCriticConfig,
        {
            "num_skills": 3,
            "steps_per_update": 1000,
            "minibatch_size": 100,
            "critic_minibatch_size": 100,
            "learning_rate": 2e-3,
            "deliberation_cost": 0.1,
        },
    ),
    "option_critic with PPOC's losses": (
        option_critic.train,
        option_critic.OptionCriticConfig,
        {"num_skills": 3, "minibatch_size": 200, "learning_rate": 3e-3, "ppoc_faithful": True},
    ),
    "hiro": (
        hiro.train,
        hiro.HiroConfig,
        {
            "goal_space": "xy",
            "period": 5,
            "hidden_sizes": [32, 32],
            "minibatch_size": 32,
            "warmup_steps": 100,
            "updates_per_step": 0.2,
            "manager_update_every": 4,
            "replay_size": 500,
        },
    ),
    "ppo": (ppo.train, ppo.PPOConfig, {"hidden_sizes": [32, 32]}),
    "hippo, modern": (hippo.train, hippo.HippoConfig, MODERN | {"num_skills": 3, "period_min": 2, "period_max": 6}),
    "ppo, modern": (ppo.train, ppo.PPOConfig, MODERN | {"hidden_sizes": [32, 32]}),
    "ppo with action repeat": (ppo.train, ppo.PPOConfig, {"hidden_sizes": [32, 32], "action_repeat": 4}),
}
learners = pytest.mark.parametrize("name", LEARNERS)


def modern(name):
    """The entry of a learner under the modern protocol, as far as it has the settings."""
    train, config, settings = LEARNERS[name]
    has = {field.name for field in dataclasses.fields(config)}
    own = {"learning_rate": 0.01} if name == "hier_vpg" else {}
    return train, config, settings | {key: value for key, value in MODERN.items() if key in has} | own


# Compared by their golden numbers alone; what else must hold of a learner holds of it under either protocol.
MODERN_TOO = {f"{name}, modern": modern(name) for name in ("hier_vpg", "mlsh", "option_critic")}


def learner(name, **budget):
    train, config, settings = (LEARNERS | MODERN_TOO)[name]
    return train, config(**(BUDGET | budget), **settings)


# HIRO's lower level is not paid by the environment: what it can learn is in test_hiro.py.
@pytest.mark.parametrize("name", [name for name in LEARNERS if name != "hiro"])
def test_every_learner_finds_the_action_that_equals_the_observation(name, tmp_path):
    # HierVPG takes one step per iteration, not ten; minibatches of fifty take four hundred.
    train, config = learner(name, iterations=200 if name == "hier_vpg" else 10 if "modern" in name else 25)
    run(train, config, tmp_path)
    returns = progress(tmp_path)["return_mean"]
    # A fresh policy (unit noise) gets about 20 (1 - 2 - 2/3) = -33 per episode of 20 steps; the best is 20.
    assert returns[0] < -20
    # An action held for 4 steps cannot follow an observation that is drawn anew at every step: its best is about 20/4.
    assert returns[-1] > (-15 if name == "ppo with action repeat" else 0)


@learners
def test_the_same_seed_gives_the_same_bytes_and_another_seed_does_not(name, tmp_path):
    train, config = learner(name, iterations=3, batch_size=200)
    for folder, seed in (("a", 0), ("b", 0), ("c", 1)):
        run(train, config, tmp_path / folder, seed, death_rate=0.02)
    a, b, c = ((tmp_path / folder / "progress.csv").read_bytes() for folder in "abc")
    assert a == b
    assert a != c
    assert (tmp_path / "a/checkpoint.pt").read_bytes() == (tmp_path / "b/checkpoint.pt").read_bytes()


@learners
@pytest.mark.parametrize("moment", ["before the checkpoint", "after the checkpoint"])
def test_an_interrupted_run_ends_at_the_same_bytes(name, moment, tmp_path, monkeypatch):
    train, config = learner(name, iterations=4, batch_size=200)
    run(train, config, tmp_path / "whole", death_rate=0.02)
    record = Checkpoint.record

    def interrupted(self, iteration, **parts):
        if iteration == 2 and moment == "before the checkpoint":
            raise KeyboardInterrupt
        record(self, iteration, **parts)
        if iteration == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(Checkpoint, "record", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run(train, config, tmp_path / "cut", death_rate=0.02)
    monkeypatch.setattr(Checkpoint, "record", record)
    run(train, config, tmp_path / "cut", death_rate=0.02)
    for file in ("progress.csv", "checkpoint.pt"):
        assert (tmp_path / "cut" / file).read_bytes() == (tmp_path / "whole" / file).read_bytes()


@pytest.mark.parametrize("frozen", ["manager", "skill"])
def test_a_frozen_level_is_bit_identical_after_training_and_the_other_moves(frozen, tmp_path):
    settings = {f"train_{'skills' if frozen == 'skill' else frozen}": False}
    config = hippo.HippoConfig(iterations=3, batch_size=200, horizon=20, **settings)
    run(hippo.train, config, tmp_path)
    generator = seeding.torch_generator(0, "initialisation")
    before = HierarchicalPolicy(config, 2, 2, 2, generator).state_dict()
    after = load(tmp_path / "checkpoint.pt")["policy"]
    frozen_prefix = "manager" if frozen == "manager" else "skills"
    for name in after:
        same = bool((after[name] == before[name]).all())
        assert same is name.startswith(frozen_prefix), name


def test_action_repeat_holds_an_action_and_its_return_is_that_of_the_environment(tmp_path):
    config = ppo.PPOConfig(iterations=1, batch_size=200, horizon=20, action_repeat=4)
    run(ppo.train, config, tmp_path)
    assert progress(tmp_path)["env_steps"][0] == 200
    assert progress(tmp_path)["length_mean"][0] == 20


def test_with_action_repeat_no_action_is_held_beyond_an_episode():
    config = ppo.PPOConfig(iterations=1, batch_size=800, horizon=100, action_repeat=5)
    policy = GaussianPolicy(2, 2, [8], torch.Generator().manual_seed(0))
    steps, is_decision = ppo.collect(policy, TargetEnv(8, 0, horizon=100, death_rate=0.1), config, 0, 0)
    after_end = torch.zeros_like(is_decision)
    after_end[1:] = steps.done[:-1]
    assert bool(is_decision[after_end].all())
    held = ~is_decision[1:]
    assert torch.equal(steps.action[1:][held], steps.action[:-1][held])
    gaps = [np.diff(is_decision[:, n].nonzero().squeeze(-1)).max() for n in range(8)]
    assert max(gaps) == 5


def test_with_one_skill_and_the_same_batch_hippos_skill_objective_is_flat_ppos():
    config = hippo.HippoConfig(
        iterations=1, batch_size=200, horizon=20, num_skills=1, period_min=5, period_max=5, skill_hidden_sizes=[16, 16]
    )
    policy = HierarchicalPolicy(config, 2, 2, 2, torch.Generator().manual_seed(0))
    flat = GaussianPolicy(2, 2, [16, 16], torch.Generator().manual_seed(1))
    weight, bias = policy.skills.first.effective()
    with torch.no_grad():
        flat.mean[0].weight.copy_(weight[0])
        flat.mean[0].bias.copy_(bias[0])
        for mine, theirs in zip((flat.mean[2], flat.mean[4]), policy.skills.rest[::2], strict=True):
            mine.weight.copy_(theirs.weight)
            mine.bias.copy_(theirs.bias)
    batch = collect(policy, TargetEnv(10, 0), config, 0, 0)
    advantage = torch.randn(20, 10, dtype=torch.float64)
    (skill,) = levels(policy, batch, advantage, advantage, ["skill"])
    obs, action = batch.steps.obs[:-1].flatten(0, 1), batch.steps.action.flatten(0, 1)
    level = ppo.Level("policy", lambda c: flat.log_prob(obs[c], action[c]), advantage.flatten().float())
    torch.testing.assert_close(skill.log_prob(slice(None)).sum(), level.log_prob(slice(None)).sum())
    results = []
    for lv, parameters in ((skill, policy.skills.parameters()), (level, flat.parameters())):
        losses = maximize([lv], torch.optim.SGD(parameters, lr=1e-3), 1, 0.1, 200)
        results.append(losses["surrogate"])
    assert results[0] == pytest.approx(results[1], abs=1e-6)
    # The gradient of what both networks share must agree, too.
    torch.testing.assert_close(policy.skills.log_std_parameter.grad[0], flat.log_std_parameter.grad)
    torch.testing.assert_close(policy.skills.rest[0].weight.grad, flat.mean[2].weight.grad, rtol=1e-4, atol=1e-6)


def test_hier_vpgs_step_is_the_first_step_of_hippo():
    config = hippo.HippoConfig(iterations=1, batch_size=200, horizon=20, period_min=2, period_max=5)
    gradients = []
    for step in ("vpg", "hippo"):
        policy = HierarchicalPolicy(config, 2, 2, 2, torch.Generator().manual_seed(0))
        batch = collect(policy, TargetEnv(10, 0), config, 0, 0)
        both = levels(policy, batch, batch.steps.reward, batch.steps.reward)
        optimizer = torch.optim.SGD(policy.parameters(), lr=0.0)
        if step == "vpg":
            hier_vpg.policy_gradient_step(both, optimizer, 200)
        else:
            maximize(both, optimizer, 1, config.clip_range, 200)
        gradients.append(torch.cat([p.grad.flatten() for p in policy.parameters()]))
    torch.testing.assert_close(gradients[0], gradients[1])
    assert gradients[0].abs().sum() > 0


@learners
def test_a_nan_in_the_parameters_stops_the_run_within_the_iteration_and_reaches_no_checkpoint(
    name, tmp_path, monkeypatch
):
    train, config = learner(name, iterations=3, batch_size=200)
    step = Adam.step

    def poisoned(self, *arguments):
        step(self, *arguments)
        if (tmp_path / "checkpoint.pt").exists():  # in the second iteration
            with torch.no_grad():
                self.param_groups[0]["params"][0].view(-1)[0] = float("nan")

    monkeypatch.setattr(Adam, "step", poisoned)
    with pytest.raises(Diverged, match="iteration 1: parameters has"):
        run(train, config, tmp_path)
    assert (tmp_path / "progress.csv").read_text().count("\n") == 2
    assert load(tmp_path / "checkpoint.pt")["iteration"] == 0
