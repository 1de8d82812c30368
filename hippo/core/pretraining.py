"""What the two ways to pre-train skills share: one skill per path, a reward for telling skills apart, the update.

SNN4HRL and DIAYN differ only in that reward. The policy is the lower level of the hierarchy itself, on the robot's own
observation, and the optimiser is HiPPO's clipped surrogate (ours; TRPO and SAC there), so that skills load as they are.
"""

import dataclasses
import time
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor, nn

from hippo.core import seeding
from hippo.core.budget import BudgetConfig
from hippo.core.checkpoint import Checkpoint
from hippo.core.gae import gae
from hippo.core.log import RunLog, check_finite
from hippo.core.normalize import standardize
from hippo.core.optimizers import Adam
from hippo.core.policies import SkillPolicy, gaussian_entropy
from hippo.core.ppo import Level, Rows, maximize
from hippo.core.rollout import LastInfo, Steps
from hippo.core.settings import MOST_SKILLS, MOST_STEPS, WIDEST, setting
from hippo.core.training import Training
from hippo.core.value import ValueFunction, explained_variance
from hippo.core.view import Ego


@dataclass
class PretrainingConfig(BudgetConfig):
    """What both ways to pre-train skills set; names are those of HierarchyConfig."""

    iterations: int = setting(
        dataclasses.MISSING, "training iterations", code="1000 (train_snn_ant.py:151); DIAYN: not in code", low=1
    )
    batch_size: int = setting(
        dataclasses.MISSING,
        "environment steps per iteration",
        code="50 000 (train_snn_ant.py:149)",
        low=1,
        high=MOST_STEPS,
    )
    horizon: int = setting(
        dataclasses.MISSING, "steps of a path", code="SNN: 400 (train_snn_ant.py:44); DIAYN: 1000 (its paper)", low=1
    )
    num_skills: int = setting(
        6, "number of skills", paper="6 (App. A)", code="6 (train_snn_ant.py)", low=1, high=MOST_SKILLS
    )
    skill_hidden_sizes: list[int] = setting(
        [64, 64], "skill network's hidden layers", paper="2 x 64 (App. A)", low=1, high=WIDEST
    )
    skill_integration: str = setting(
        "bilinear",
        "how the skill enters the skill network",
        code="bilinear (train_snn_ant.py)",
        choices=("bilinear", "concatenate"),
    )
    log_std_per_skill: bool = setting(
        False, "one log-std vector per skill instead of a shared one", code="shared (snn_mlp_policy.py)"
    )
    skill_observation: str = setting(
        "robot",
        "what skills see: the robot's own observation, or the same free of place and heading (ego)",
        code="SNN: ego_obs of the authors' robots (train_snn_ant.py); DIAYN: without x",
        ours="robot: the committed skills'",
        choices=("robot", "ego"),
    )
    learning_rate: float = setting(3e-3, "Adam step size", ours="HiPPO's; the originals use TRPO and SAC", above=0.0)
    clip_range: float = setting(0.1, "clipping parameter epsilon", ours="HiPPO's; the originals do not clip", above=0.0)
    updates: int = setting(10, "full-batch gradient steps per iteration", ours="HiPPO's", low=1)
    gamma: float = setting(0.99, "discount per step", code="0.99 (train_snn_ant.py); DIAYN: 0.99", above=0, high=1)
    gae_lambda: float = setting(
        0.95, "GAE lambda", code="1 (train_snn_ant.py)", ours="0.95: less variance, there is a value function", high=1
    )
    bootstrap_horizon: bool = setting(
        True, "whether the end of the horizon bootstraps the value", code="DIAYN: yes, time-outs are not terminal"
    )
    value_hidden_sizes: list[int] = setting(
        [32, 32], "hidden layers of the baseline V(s, z)", ours="HiPPO's", low=1, high=WIDEST
    )
    value_sees_time: bool = setting(
        False, "whether V(s, z) also sees which share of a path has passed", ours="no; a path's return depends on it"
    )
    standardize_per_skill: bool = setting(
        False,
        "standardise advantages over the steps of each skill instead of over all",
        ours="no; with it no skill's bonus drowns in another's",
    )
    value_iterations: int = setting(10, "the most loss evaluations of a fit of the baseline", ours="HiPPO's", low=1)


@dataclass
class Paths:
    """T steps of N environments, in which every path has one skill from its start to its end."""

    steps: Steps
    skill: Tensor  # (T + 1, N)
    next_obs: Tensor  # (T, N, D) what followed each step, before any autoreset
    position: Tensor  # (T + 1, N, 3) m, centre of mass where each step begins
    next_position: Tensor  # (T, N, 3) m, centre of mass after each step, before any autoreset
    start: Tensor  # (T, N) the row where the step's path began


@torch.no_grad()
def collect(
    policy: SkillPolicy,
    envs: Any,
    config: PretrainingConfig,
    seed: int,
    iteration: int,
    skill: np.ndarray | None = None,
) -> Paths:
    """One horizon in every environment from a fresh path; the skill is drawn uniformly where a path starts.

    Args:
        skill: (N,) skills to use throughout instead, for measurements.
    """
    T, N = config.horizon, envs.num_envs
    tapped = LastInfo(envs)
    steps = Steps(tapped, T, config.bootstrap_horizon)
    generator = seeding.torch_generator(seed, "skill of a path", iteration)
    drawn = torch.randint(policy.num_skills, (T + 1, N), generator=generator).numpy()
    if skill is not None:
        drawn[:] = skill
    noise = torch.randn(steps.action.shape, generator=seeding.torch_generator(seed, "skills", iteration)).numpy()
    active, start = np.empty((T + 1, N), np.int64), np.empty((T, N), np.int64)
    next_obs, position = np.empty((T, *steps.obs.shape[1:]), np.float32), np.empty((T + 1, N, 3))
    next_position = np.empty((T, N, 3))

    act = policy.actor()
    obs = steps.reset(seeding.integer(seed, "episodes", iteration))
    active[0], begun, position[0] = drawn[0], np.zeros(N, np.int64), envs.com
    for t in range(T):
        start[t] = begun
        obs, done = steps.step(t, act(policy.see_array(obs), active[t], noise[t]))
        next_obs[t], next_position[t], position[t + 1] = obs, tapped.info["com"], envs.com
        if done.any():
            next_obs[t][done] = tapped.info["final_obs"][done]
        active[t + 1] = np.where(done, drawn[t + 1], active[t])
        begun = np.where(done, t + 1, begun)
    arrays = (active, next_obs, position, next_position, start)
    return Paths(steps, *(torch.from_numpy(array) for array in arrays))


class Objective(Protocol):
    """What a way to pre-train skills rewards."""

    parts: dict[str, Any]  # what its checkpoint holds, by name: objects with a state_dict

    def reward(self, paths: Paths, policy: SkillPolicy) -> tuple[Tensor, dict[str, float]]:
        """Rewards (T, N) float64 and metrics of a batch, before anything is learnt from it."""

    def learn(self, paths: Paths, seed: int, iteration: int) -> None:
        """Learn from the batch what the reward depends on."""


def train_skills(
    config: PretrainingConfig, envs: Any, objective: Objective, log: RunLog, seed: int, checkpoint: Checkpoint
) -> None:
    """Train skills from the newest checkpoint, or from scratch, to `config.iterations`.

    Raises:
        Diverged: an observation, a reward or a parameter is no longer finite.
    """
    generator = seeding.torch_generator(seed, "initialisation")
    policy = new_policy(config, envs, generator)
    inputs = policy.first.inputs + config.value_sees_time
    baseline = ValueFunction(inputs, config.value_hidden_sizes, generator, config.num_skills)
    optimizer = Adam(policy.parameters(), lr=config.learning_rate)
    parts = {"policy": policy, "baseline": baseline, "optimizer": optimizer} | objective.parts
    training = Training(log, checkpoint, parts)

    for iteration in range(training.begin(), config.iterations):
        start = time.perf_counter()
        paths = collect(policy, envs, config, seed, iteration)
        steps = paths.steps
        steps.check(iteration)
        collected = time.perf_counter()
        with torch.no_grad():
            reward, metrics = objective.reward(paths, policy)
            statistics = skill_statistics(policy, paths)
        check_finite(iteration, skill_rewards=reward)
        losses = update(policy, baseline, optimizer, paths, reward, config)
        objective.learn(paths, seed, iteration)
        learnt = [
            p for part in (policy, *objective.parts.values()) if isinstance(part, nn.Module) for p in part.parameters()
        ]
        check_finite(iteration, parameters=nn.utils.parameters_to_vector(learnt))
        end = time.perf_counter()
        row = {
            "skill_reward": float(reward.mean()),
            **metrics,
            **losses,
            **statistics,
        }
        training.record(iteration, steps, (start, collected, end), row)
    envs.close()


def update(
    policy: SkillPolicy,
    baseline: ValueFunction,
    optimizer: torch.optim.Optimizer,
    paths: Paths,
    reward: Tensor,
    config: PretrainingConfig,
) -> dict[str, float]:
    """HiPPO's clipped surrogate on the advantages of `reward` (T, N), then a new fit of V(s, z); returns metrics."""
    steps, skill = paths.steps, paths.skill
    obs = policy.see(steps.obs)
    final_obs, step, env = steps.final()
    valued, final_valued = obs, policy.see(final_obs)
    if config.value_sees_time:
        passed = share_passed(paths)
        valued = torch.cat([obs, passed.unsqueeze(-1).to(obs.dtype)], -1)
        after = passed[step, env] + 1 / len(paths.start)  # what follows a path's last step is still of that path
        final_valued = torch.cat([final_valued, after.unsqueeze(-1).to(obs.dtype)], -1)
    value = baseline.predict(valued, skill)
    final_value = baseline.predict(final_valued, skill[step, env])
    next_value = value[1:].index_put((step, env), final_value)
    advantage = gae(reward, value[:-1], next_value, steps.terminated, steps.done, config.gamma, config.gae_lambda)
    target, order = advantage + value[:-1], skill[:-1].flatten().argsort(stable=True)  # rows sorted by skill
    rows, active = obs[:-1].flatten(0, 1)[order], skill[:-1].flatten()[order]
    action = steps.action.flatten(0, 1)[order]

    def log_prob(c: Rows) -> Tensor:
        return policy.log_prob(rows[c], active[c], action[c])

    standardized = standardize(advantage).flatten()[order]
    if config.standardize_per_skill:
        counts = torch.bincount(active, minlength=policy.num_skills).tolist()
        standardized = torch.cat([standardize(a) for a in advantage.flatten()[order].split(counts) if len(a)])
    level = Level("skill", log_prob, standardized.to(rows.dtype))
    losses = maximize([level], optimizer, config.updates, config.clip_range, steps.num_steps)
    explained = explained_variance(value[:-1].flatten(), target.flatten())
    baseline.fit(valued[:-1].flatten(0, 1)[order], target.flatten()[order], config.value_iterations, active)
    return losses | {"skill_explained_variance": explained}


def share_passed(paths: Paths) -> Tensor:
    """Share of a whole path that has passed where each row begins, (T + 1, N) in [0, 1]; 0 where a path begins."""
    T = len(paths.start)
    passed = torch.arange(T).unsqueeze(1) - paths.start
    last = torch.where(paths.steps.done[-1], 0, passed[-1] + 1)
    return torch.cat([passed, last.unsqueeze(0)]).double() / T


def skill_statistics(policy: SkillPolicy, paths: Paths) -> dict[str, float]:
    """How the skills behaved in a batch: entropy, action noise, distance travelled, use of every skill."""
    skill, log_std = paths.skill[:-1], policy.log_std()
    usage = torch.bincount(skill.flatten(), minlength=policy.num_skills) / skill.numel()
    travelled = (paths.next_position[-1] - paths.position[paths.start[-1], torch.arange(skill.shape[1])])[:, :2]
    return {
        "skill_entropy": float(usage @ gaussian_entropy(log_std)),
        "action_std": float(log_std.exp().mean()),
        "distance_mean": float(travelled.norm(dim=1).mean()),
        **{f"skill_{z}_usage": float(share) for z, share in enumerate(usage)},
    }


def new_policy(config: PretrainingConfig, envs: Any, generator: torch.Generator) -> SkillPolicy:
    """The skill network that a hierarchy with a fixed period has for the robot of `envs`."""
    ego = Ego(envs.observation_names[: envs.robot_size]) if config.skill_observation == "ego" else None
    policy = SkillPolicy(
        envs.robot_size if ego is None else ego.size,
        config.num_skills,
        envs.single_action_space.shape[0],
        config.skill_hidden_sizes,
        generator,
        config.skill_integration,
        config.log_std_per_skill,
    )
    policy.ego = ego
    return policy


def trained_skills(
    algo: str, config: PretrainingConfig, make_envs: Any, checkpoint: Checkpoint
) -> tuple[SkillPolicy, dict[str, Any]]:
    """The policy of a pre-training run's checkpoint and what a skills file says of it, but for the run's id."""
    envs = make_envs(1, "skills")
    policy = new_policy(config, envs, seeding.torch_generator(0, "overwritten by the checkpoint"))
    iterations = checkpoint.restore(policy=policy)
    metadata = {
        "robot": envs.robot_name,
        "observation": envs.observation_variant,
        "env": envs.robot_name,  # the environment of a robot alone has the robot's name
        "algo": algo,
        "env_steps": iterations * config.num_envs * config.horizon,
        "physics": envs.options.physics,
        "view": config.skill_observation,
        "names": list(envs.observation_names[: envs.robot_size]),
    }
    envs.close()
    return policy, metadata
