"""A manager that commits to a skill for p steps: the policy, the commitment and Algorithm 1, HiPPO Rollout.

HiPPO, HierVPG and MLSH train this same hierarchy and differ in what they do with a batch of it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numba
import numpy as np
import torch
from torch import Tensor, nn

from hippo.core import seeding
from hippo.core.acting import OfHorizons
from hippo.core.checkpoint import Checkpoint
from hippo.core.hierarchy_config import HierarchyConfig
from hippo.core.networks import normalize_columns
from hippo.core.normalize import ObservationFilter, actor_of
from hippo.core.policies import POLICY_HEAD, Manager, SkillPolicy, sample_categorical
from hippo.core.rollout import Steps
from hippo.core.view import Ego


def with_time(obs: Tensor, time_left: Tensor) -> Tensor:
    """Append the time left as last entry: (..., D), (...) -> (..., D + 1)."""
    return torch.cat([obs, time_left.unsqueeze(-1).to(obs.dtype)], -1)


class HierarchicalPolicy(nn.Module):
    """Manager and skills, and what each of them sees of an observation and the time left.

    Only with a random period do the two see the time left (authors' code: fixed-p networks do not). Observations are
    those that `collect` records: where the policy has a filter, they have passed it.

    Args:
        names: of an observation's entries, which `skill_observation=ego` goes by.
    """

    def __init__(
        self,
        config: HierarchyConfig,
        obs_size: int,
        robot_size: int,
        action_size: int,
        generator: torch.Generator,
        names: Sequence[str] = (),
    ) -> None:
        super().__init__()
        self.num_skills = config.num_skills
        self.filter = ObservationFilter(obs_size) if config.normalize_observations else None
        ego = Ego(names[:robot_size]) if config.skill_observation == "ego" else None
        self.skill_view = {"robot": robot_size, "full": obs_size}[config.skill_observation] if ego is None else ego.size
        self.sees_time = config.period_min < config.period_max
        extra = int(self.sees_time)
        self.manager = Manager(obs_size + extra, config.num_skills, config.manager_hidden_sizes, generator)
        self.skills = SkillPolicy(
            self.skill_view + extra,
            config.num_skills,
            action_size,
            config.skill_hidden_sizes,
            generator,
            config.skill_integration,
            config.log_std_per_skill,
        )
        self.skills.ego = ego
        if config.initialisation == "normc":
            normalize_columns(self.manager.logits.layers, POLICY_HEAD, generator)
            normalize_columns([self.skills.first, *self.skills.rest.layers], POLICY_HEAD, generator)

    def manager_input(self, obs: Tensor, time_left: Tensor) -> Tensor:
        """(..., D), (...) -> (..., D [+ 1])."""
        return with_time(obs, time_left) if self.sees_time else obs

    def skill_input(self, obs: Tensor, time_left: Tensor) -> Tensor:
        """(..., D), (...) -> (..., robot [+ 1])."""
        view = obs[..., : self.skill_view] if self.skills.ego is None else self.skills.ego(obs)
        return with_time(view, time_left) if self.sees_time else view


class Commitment:
    """Which skill every environment is committed to, and for how many more steps (Algorithm 1, lines 4 to 10)."""

    def __init__(self, policy: HierarchicalPolicy, num_envs: int, period_max: int) -> None:
        self.sees_time = policy.sees_time
        self.logits = policy.manager.actor()
        self.skill = np.zeros(num_envs, np.int64)  # (N,)
        self.steps_left = np.zeros(num_envs, np.int64)  # (N,)
        self.time_left = torch.zeros(num_envs).numpy()  # (N,) steps left over the longest period, in (0, 1]
        fraction = np.arange(period_max + 1) / period_max
        self._fraction = fraction.astype(self.time_left.dtype)  # steps left -> time left

    def renew(self, obs: np.ndarray, period: np.ndarray, uniform: np.ndarray | None) -> np.ndarray:
        """Where a commitment has run out take the new `period` (N,), then let the manager choose.

        The period is drawn before the manager acts, so that the manager knows how long its choice will last. Without
        `uniform` (N,) the manager takes its most likely skill.

        Returns:
            (N,) bool, where a decision was made.
        """
        is_decision = np.empty(len(obs), bool)
        _renew_periods(self.steps_left, period, self._fraction, self.time_left, is_decision)
        where = np.flatnonzero(is_decision)
        if len(where):
            logits = self.logits(look(obs, self.time_left, where, obs.shape[1], self.sees_time))
            self.skill[where] = logits.argmax(-1) if uniform is None else sample_categorical(logits, uniform[where])
        return is_decision

    def advance(self, done: np.ndarray) -> None:
        """One environment step has passed; an episode's end cuts the commitment."""
        _advance(self.steps_left, done)


@numba.njit(cache=True, error_model="numpy")
def _renew_periods(
    steps_left: np.ndarray, period: np.ndarray, fraction: np.ndarray, time_left: np.ndarray, is_decision: np.ndarray
) -> None:
    """Start the new period where no steps are left, and write where that is and fraction[steps_left]; all (N,)."""
    for i in range(len(steps_left)):
        is_decision[i] = steps_left[i] == 0
        if is_decision[i]:
            steps_left[i] = period[i]
        time_left[i] = fraction[steps_left[i]]


@numba.njit(cache=True, error_model="numpy")
def _advance(steps_left: np.ndarray, done: np.ndarray) -> None:
    for i in range(len(steps_left)):
        steps_left[i] = 0 if done[i] else steps_left[i] - 1


def look(obs: np.ndarray, time_left: np.ndarray, where: np.ndarray, view: int, sees_time: bool) -> np.ndarray:
    """What a level sees in the rows `where` (K,): the first `view` entries of obs (N, D) and perhaps the time left."""
    seen = np.empty((len(where), view + sees_time), obs.dtype)
    _look(obs, time_left, where, view, seen)
    return seen


@numba.njit(cache=True, error_model="numpy")
def _look(obs: np.ndarray, time_left: np.ndarray, where: np.ndarray, view: int, seen: np.ndarray) -> None:
    """Write `look` to seen (K, view [+ 1])."""
    for k in range(len(where)):
        for d in range(view):
            seen[k, d] = obs[where[k], d]
        if seen.shape[1] > view:
            seen[k, view] = time_left[where[k]]


@dataclass
class Batch:
    """One iteration's experience of the hierarchy."""

    steps: Steps  # observations, actions, rewards and ends
    skill: Tensor  # (T + 1, N) the skill in force
    time_left: Tensor  # (T + 1, N) steps left in the commitment, the coming one included, over period_max
    is_decision: Tensor  # (T + 1, N) the manager chose here
    used: Tensor  # (T, N) is learnt from; all true unless truncate_to_period


class Acting(OfHorizons):
    """Algorithm 1 without its learning: the hierarchy at work (`hippo.core.acting.Acting`).

    Periods, the manager's uniforms and the skills' Gaussian noise have a stream each, so what one level draws never
    shifts what the other draws. With `greedy` both levels take their most likely choice.
    """

    def __init__(
        self,
        policy: HierarchicalPolicy,
        config: HierarchyConfig,
        num_envs: int,
        seed: int,
        iteration: int,
        greedy: bool = False,
    ) -> None:
        self.policy, self.config, self.greedy = policy, config, greedy
        self.commitment = Commitment(policy, num_envs, config.period_max)
        self._skills, self._view, self._everywhere = policy.skills.actor(), actor_of(policy.filter), np.arange(num_envs)
        super().__init__(config.horizon, seed, iteration)

    def _draw(self, seed: int, iteration: int) -> None:
        """T + 1 rows of what is decided before a step, T of what is added to actions."""
        (T, N), config = (self.config.horizon, len(self._everywhere)), self.config
        generator = seeding.torch_generator(seed, "period", iteration)
        self._period = torch.randint(config.period_min, config.period_max + 1, (T + 1, N), generator=generator).numpy()
        self._uniform = torch.rand(T + 1, N, generator=seeding.torch_generator(seed, "manager", iteration)).numpy()
        shape = (T, N, self.policy.skills.log_std_parameter.shape[-1])
        self._noise = torch.randn(shape, generator=seeding.torch_generator(seed, "skills", iteration)).numpy()
        self._noise *= not self.greedy

    @property
    def skill(self) -> np.ndarray:
        """(N,) the skill in force."""
        return self.commitment.skill

    @property
    def steps_left(self) -> np.ndarray:
        """(N,) for how many more steps."""
        return self.commitment.steps_left

    def decide(self, obs: np.ndarray) -> np.ndarray:
        """See `obs` (N, D), and choose a skill where a commitment has run out; returns where, (N,) bool."""
        self._seen = self._view(obs)
        return self.commitment.renew(self._seen, self._period[self._t], None if self.greedy else self._uniform[self._t])

    def action(self) -> np.ndarray:
        """What the skills in force do (N, A) about what was last seen."""
        policy, time_left, ego = self.policy, self.commitment.time_left, self.policy.skills.ego
        whole = self._seen if ego is None else ego.of_array(self._seen)
        seen = look(whole, time_left, self._everywhere, policy.skill_view, policy.sees_time)
        return self._skills(seen, self.skill, self._noise[self._t])

    def act(self, obs: np.ndarray) -> np.ndarray:
        """Decide and act."""
        self._next_horizon_if_over()
        self.decide(obs)
        return self.action()

    def end(self, done: np.ndarray) -> None:
        """One step has passed; an episode's end cuts the commitment."""
        self.commitment.advance(done)
        self._t += 1


@torch.no_grad()
def collect(
    policy: HierarchicalPolicy,
    envs: gym.vector.VectorEnv,
    config: HierarchyConfig,
    seed: int,
    iteration: int,
    greedy: bool = False,
) -> Batch:
    """Algorithm 1 in every environment, for one horizon from a fresh episode.

    With `greedy` both levels take their most likely choice. All randomness is named by (seed, iteration).
    """
    T, N = config.horizon, envs.num_envs
    steps = Steps(envs, T, config.bootstrap_horizon)
    skill = np.empty((T + 1, N), np.int64)
    time_left = torch.empty(T + 1, N).numpy()
    is_decision = np.empty((T + 1, N), bool)

    acting = Acting(policy, config, N, seed, iteration, greedy)
    obs = steps.reset(seeding.integer(seed, "episodes", iteration))
    for t in range(T + 1):
        is_decision[t] = acting.decide(obs)
        skill[t], time_left[t] = acting.skill, acting.commitment.time_left
        if t < T:
            obs, done = steps.step(t, acting.action())
            acting.end(done)
    steps.see_through(policy.filter)

    decisions, used = torch.from_numpy(is_decision), torch.ones_like(steps.done)
    if config.truncate_to_period:
        used = in_whole_periods(decisions[:T], config.period_max)
    return Batch(steps, torch.from_numpy(skill), torch.from_numpy(time_left), decisions, used)


def new_policy(config: HierarchyConfig, envs: Any, generator: torch.Generator) -> HierarchicalPolicy:
    """Freshly drawn networks for these environments."""
    obs_size, action_size = envs.single_observation_space.shape[0], envs.single_action_space.shape[0]
    return HierarchicalPolicy(config, obs_size, envs.robot_size, action_size, generator, envs.observation_names)


def restored(config: HierarchyConfig, envs: Any, checkpoint: Checkpoint) -> HierarchicalPolicy:
    """The policy of a checkpoint."""
    policy = new_policy(config, envs, seeding.torch_generator(0, "overwritten by the checkpoint"))
    checkpoint.restore(policy=policy)
    return policy


def in_whole_periods(is_decision: Tensor, period: int) -> Tensor:
    """Which steps lie in a segment of full length: (T, N) decisions -> (T, N) bool."""
    segment = is_decision.long().cumsum(0) - 1
    length = torch.zeros_like(segment).scatter_add_(0, segment, torch.ones_like(segment))
    return length.gather(0, segment) == period
