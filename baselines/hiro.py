"""HIRO: goals for a goal-conditioned lower level, both learnt off-policy (Nachum, Gu, Lee and Levine 2018).

Every c steps the manager sets a goal g, a wanted change of the entries S of the observation; in between

    g' = S(s) + g - S(s'),        r_low = - |S(s) + g - S(s')|

keep the wanted S fixed and pay for approaching it. Both levels are TD3 agents. Because the lower level changes, an old
goal no longer explains what was then done; a sampled decision is learnt from under the candidate goal g~ that makes
the actions of its c steps most likely to the present lower level (off-policy correction):

    argmax over g~ of  - sum_i | a_{t+i} - mu_low(s_{t+i}, S(s_t) + g~ - S(s_{t+i})) |^2

Source: tensorflow/models, research/efficient-hrl at 052361de. docs/algorithms/hiro.md lists what differs.
"""

import dataclasses
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from hippo.core import seeding
from hippo.core.checkpoint import Checkpoint
from hippo.core.goals import BODY_GOALS, GOAL_SPACES, POSITION, Goals, Memory, candidate_goals
from hippo.core.log import RunLog, check_finite
from hippo.core.optimizers import Adam
from hippo.core.replay import Replay
from hippo.core.rollout import LastInfo, Steps
from hippo.core.settings import MOST_STEPS, WIDEST, ConfigError, check, setting
from hippo.core.skills import load_skills, policy_of
from hippo.core.td3 import TD3
from hippo.core.view import ABSOLUTE

__all__ = ["Acting", "HiroConfig", "restored", "train"]

REVISION = 2  # bumped by every change that alters the metrics of tests/golden

MakeEnvs = Callable[[int, str], Any]  # (num_envs, purpose) -> a vector environment that knows its robot_size

CLONING_LEARNING_RATE = 1e-3
EXPLORATION, TARGET_NOISE, TARGET_NOISE_CLIP = 1.0, 0.2, 0.5  # published, in the units of `noise_units`


@dataclass
class HiroConfig:
    """The settings of HIRO."""

    iterations: int = setting(dataclasses.MISSING, "training iterations", ours="HIRO's own 10 M steps", low=1)
    batch_size: int = setting(
        dataclasses.MISSING,
        "environment steps per iteration",
        ours="one horizon of a few environments",
        low=1,
        high=MOST_STEPS,
    )
    horizon: int = setting(
        dataclasses.MISSING, "episode length H in steps", paper="Block 1000, Ant 5000, Snake 8000 (App. A)", low=1
    )
    period: int = setting(10, "c, steps between two goals", code="10 (ant_maze.gin:27)", low=1)
    goal_space: str = setting(
        "body",
        "what goals are about: the robot's pose (body), its place (xy), or both, x and y hidden from the lower level; "
        "of gym:<id> the entries of the observation, such as 0:2 or achieved_goal",
        paper="without access to ground-truth (x, y); with, in appendix D",
        code="both (hiro_orig.gin) and xy (hiro_xy.gin)",
    )
    position_range: float = setting(
        10.0,
        "half range of goals in x and y, m; of all goals of gym:<id>, in the unit of the entry",
        code="10 (hiro_xy.gin:6); the arena's is 6",
        above=0.0,
    )
    hidden_sizes: list[int] = setting(
        [300, 300], "two hidden layers (ReLU) of all networks", code="300, 300 (base_uvf.gin:34)", low=1, high=WIDEST
    )
    actor_learning_rate: float = setting(1e-4, "Adam step size of the actors", code="1e-4", above=0.0)
    critic_learning_rate: float = setting(1e-3, "Adam step size of the critics", code="1e-3", above=0.0)
    gamma: float = setting(
        0.99, "discount, per step and per decision", code="0.99 at both levels (train_uvf.gin:24)", above=0.0, high=1.0
    )
    tau: float = setting(
        0.005, "how far the targets move at a time", code="0.005 (base_uvf.gin:68)", above=0.0, high=1.0
    )
    delay: int = setting(2, "critic updates per update of actor and targets", code="2 (train_uvf.gin:27)", low=1)
    minibatch_size: int = setting(100, "transitions per update", code="100 (train_uvf.gin:22)", low=1)
    replay_size: int = setting(
        200_000, "rows of each level's replay buffer", code="200,000 (train_uvf.gin:3)", low=1, high=MOST_STEPS
    )
    warmup_steps: int = setting(
        2500, "environment steps before the first update", code="5 episodes of 500 (train_uvf.gin:21)", low=0
    )
    updates_per_step: float = setting(
        1.0, "updates of the lower level per environment step", code="1 (train_uvf.gin:28)", above=0.0
    )
    manager_update_every: int = setting(
        10, "updates of the lower level per update of the manager", code="10 (train_uvf.gin:30)", low=1
    )
    noise_units: str = setting(
        "range",
        "unit of the noise (1.0 exploration, 0.2 and 0.5 targets): 1/30 of an action's and 1/10 of a goal's half "
        "range, as published for torques of 30 and goals of 10 m (range), or 1 (absolute)",
        code="absolute (base_uvf.gin:64), with torques up to 30",
        choices=("range", "absolute"),
    )
    manager_reward_scale: float = setting(
        0.1, "factor on the rewards that the manager learns from", code="0.1 (train.py:192)", above=0.0
    )
    off_policy_correction: bool = setting(True, "relabel sampled decisions", code="yes (train.py:247)")
    ignore_terminals: bool = setting(
        False,
        "bootstrap where an episode ended for good, too",
        code="yes (train.py:520)",
        ours="no: the robots here can fall",
    )
    skills: str = setting(
        "",
        "skills file whose roll-outs the lower level is cloned from and both buffers start with; empty: from scratch",
        paper="fine-tunes the same given skills (Fig. 6), no recipe",
    )
    cloning_steps: int = setting(
        20_000, "environment steps of the roll-outs of given skills, at least", ours="no recipe", low=1
    )
    cloning_updates: int = setting(5000, "minibatches of behaviour cloning", ours="25 passes over the roll-outs", low=1)

    def __post_init__(self) -> None:
        check(self)
        if self.batch_size < self.horizon:
            raise ConfigError("batch_size", self.batch_size, f"must be at least one horizon, {self.horizon} steps")
        if self.period > self.horizon:
            raise ConfigError("period", self.period, f"must be at most the horizon, {self.horizon} steps")
        if self.replay_size < self.minibatch_size:
            valid = f"must be at least the minibatch, {self.minibatch_size} transitions"
            raise ConfigError("replay_size", self.replay_size, valid)
        if len(self.hidden_sizes) != 2:
            raise ConfigError("hidden_sizes", self.hidden_sizes, "must be two layers")

    @property
    def num_envs(self) -> int:
        """Environments side by side, each for one horizon; ceil(batch / horizon)."""
        return -(-self.batch_size // self.horizon)

    def check_environment(self, robot: str, options: dict[str, Any], layout: Any = None) -> None:
        """Refuse goals about entries that the environment's observation, of gym:<id> its `layout`, does not have."""
        if layout is not None:
            layout.find("goal_space", self.goal_space)
            return
        if self.goal_space not in GOAL_SPACES:
            raise ConfigError("goal_space", self.goal_space, f"must be one of {', '.join(GOAL_SPACES)}")
        if self.goal_space != "body" and not options.get("position", False):
            raise ConfigError("goal_space", self.goal_space, "needs env.position=true (Gather): no x, y are observed")
        if self.goal_space != "xy" and robot not in BODY_GOALS:
            raise ConfigError(
                "goal_space", self.goal_space, f"knows the pose of {', '.join(BODY_GOALS)}, not of {robot}"
            )


class Agents(nn.Module):
    """The two levels: what they see, how they act, how they learn."""

    def __init__(
        self,
        config: HiroConfig,
        goals: Goals,
        obs_size: int,
        action_size: int,
        generator: torch.Generator,
        unseen: Sequence[int] = (),
    ) -> None:
        super().__init__()
        self.config, self.goals = config, goals
        self.unseen = torch.tensor(unseen, dtype=torch.long)  # entries that neither level may know
        # With x and y in the goal only, the lower level cannot tell where it is, but where it should go (hiro_orig).
        self.hidden = goals.index[:2] if config.goal_space == "both" else self.unseen
        action_range = torch.ones(action_size)
        in_range = config.noise_units == "range"
        common: dict[str, Any] = {
            "hidden_sizes": config.hidden_sizes,
            "generator": generator,
            "actor_learning_rate": config.actor_learning_rate,
            "critic_learning_rate": config.critic_learning_rate,
            "gamma": config.gamma,
            "tau": config.tau,
            "delay": config.delay,
            "target_noise": TARGET_NOISE,
            "target_noise_clip": TARGET_NOISE_CLIP,
        }
        unit = action_range / 30 if in_range else action_range
        self.low = TD3(obs_size + len(goals.index), action_range, unit, **common)
        unit = goals.half_range / 10 if in_range else torch.ones_like(goals.half_range)
        self.manager = TD3(obs_size, goals.half_range, unit, **common)

    def low_input(self, obs: Tensor, goal: Tensor) -> Tensor:
        """What the lower level sees: (..., D), (..., k) -> (..., D + k)."""
        if len(self.hidden):
            obs = obs.index_fill(-1, self.hidden, 0.0)
        return torch.cat([obs, goal], -1)

    def manager_input(self, obs: Tensor) -> Tensor:
        """What the manager sees: (..., D) -> (..., D)."""
        return obs.index_fill(-1, self.unseen, 0.0) if len(self.unseen) else obs

    @torch.no_grad()
    def act(self, obs: Tensor, goal: Tensor, noise: Tensor | None) -> Tensor:
        """Actions (N, A) in [-1, 1]; standard normal `noise` (N, A), None for none."""
        action = self.low.actor(self.low_input(obs, goal))
        if noise is not None:
            action += EXPLORATION * self.low.unit * noise
        return action.clamp_(-1, 1)

    @torch.no_grad()
    def new_goal(self, obs: Tensor, noise: Tensor | None) -> Tensor:
        """Goals (N, k) within their box; standard normal `noise` (N, k), None for none."""
        goal = self.manager.actor(self.manager_input(obs))
        if noise is not None:
            goal = goal + EXPLORATION * self.manager.unit * noise
        return self.goals.clip(goal)

    def learn_low(self, replay: Replay, generator: torch.Generator) -> Tensor:
        """One TD3 update of the lower level; its (loss, value)."""
        rows = replay.sample(self.config.minibatch_size, generator)
        x, next_x = (self.low_input(rows[f"{n}obs"], rows[f"{n}goal"]) for n in ("", "next_"))
        return self.low.update(x, rows["action"], rows["reward"], next_x, rows["continues"], generator)

    def learn_manager(self, replay: Replay, generator: torch.Generator) -> Tensor:
        """One TD3 update of the manager; its (loss, value, share of relabelled decisions)."""
        rows = replay.sample(self.config.minibatch_size, generator)
        goal, relabelled = rows["goal"], torch.zeros(())
        if self.config.off_policy_correction:
            goal = self.relabel(rows, generator)
            relabelled = (goal != rows["goal"]).any(-1).to(goal.dtype).mean()
        first, last = (self.manager_input(rows["obs"][:, i]) for i in (0, -1))
        learnt = self.manager.update(first, goal, rows["reward"], last, rows["continues"], generator)
        return torch.cat([learnt, relabelled.unsqueeze(0)])

    @torch.no_grad()
    def relabel(self, rows: dict[str, Tensor], generator: torch.Generator) -> Tensor:
        """The candidate goals (B, k) under which the present lower level best explains what was done.

        Args:
            rows: obs (B, c + 1, D), the last being where the decision led; action (B, c, A); length (B,), the steps of
                a decision that the end of an episode cut short; goal (B, k).
        """
        obs, action = rows["obs"], rows["action"]
        candidates = candidate_goals(self.goals, obs[:, 0], obs[:, -1], rows["goal"], generator)
        B, c = action.shape[:2]
        during = torch.arange(c) < rows["length"].unsqueeze(1)
        seen, start = obs[:, :-1], self.goals.of_state(obs[:, :1])
        moved = start - self.goals.of_state(seen)  # (B, c, k)
        scores = [
            -((action - mu).square().sum(-1) * during).sum(1)
            for mu in self.low.actor.of_shifted(self.low_input(seen, moved), candidates)
        ]
        best = torch.stack(scores, 1).argmax(1)
        return candidates[torch.arange(B), best]

    def optimizers(self) -> dict[str, torch.optim.Optimizer]:
        """The four Adams by name."""
        return self.low.optimizers("low") | self.manager.optimizers("manager")


@dataclass
class Walk:
    """Environments in the middle of an episode each, and the goals that are in force there."""

    agents: Agents
    steps: Steps
    tapped: LastInfo
    generator: torch.Generator | None  # of the exploration, None for none
    obs: Tensor
    goal: Tensor
    age: Tensor  # (N,) steps since the goal was set

    @classmethod
    def begin(cls, agents: Agents, envs: Any, seed: int, iteration: int, explores: bool = True) -> "Walk":
        """Fresh episodes; all randomness is named by (seed, iteration)."""
        tapped = LastInfo(envs)
        steps = Steps(tapped, agents.config.horizon, bootstrap_horizon=True)
        generator = seeding.torch_generator(seed, "exploration", iteration) if explores else None
        obs = torch.from_numpy(steps.reset(seeding.integer(seed, "episodes", iteration)).copy())
        no_goal = torch.zeros(len(obs), len(agents.goals.index))
        walk = cls(agents, steps, tapped, generator, obs, no_goal, torch.zeros(len(obs), dtype=torch.long))
        walk.goal = agents.new_goal(obs, walk.noise(no_goal))
        return walk

    def noise(self, like: Tensor) -> Tensor | None:
        """Standard normal noise of the shape of `like`."""
        return None if self.generator is None else torch.randn(like.shape, generator=self.generator)

    def act(self) -> Tensor:
        """The lower level's actions (N, A)."""
        size = self.steps.action.shape[1:]
        return self.agents.act(self.obs, self.goal, self.noise(torch.empty(size)))

    def step(self, t: int, action: Tensor) -> tuple[dict[str, Tensor], Tensor, Tensor]:
        """Take actions (N, A); returns a row per environment for the lower level's buffer, is_over (N,), the distance.

        The row's next goal is the manager's new one where a decision ended; the distance is |S(s) + g - S(s')| (N,).
        """
        goals, obs, goal = self.agents.goals, self.obs, self.goal
        seen, ended = self.steps.step(t, action.numpy())
        done = torch.from_numpy(ended)
        after = torch.from_numpy(seen.copy())
        next_obs = after.clone()
        if ended.any():
            next_obs[done] = torch.from_numpy(self.tapped.info["final_obs"][ended])
        remaining = goals.transition(obs, goal, next_obs)
        self.age += 1
        is_over = done | (self.age == self.agents.config.period)
        next_goal, self.goal = remaining, remaining
        if is_over.any():
            fresh = self.agents.new_goal(after, self.noise(goal))
            self.goal = torch.where(is_over.unsqueeze(1), fresh, remaining)
            # What follows the last step of an episode is worth what it would be, had the goal gone on.
            next_goal = torch.where((is_over & ~done).unsqueeze(1), fresh, remaining)
            self.age[is_over] = 0
        self.obs = after
        reward = goals.reward(obs, goal, next_obs)
        row = {
            "obs": obs,
            "goal": goal,
            "action": action,
            "reward": reward,
            "next_obs": next_obs,
            "next_goal": next_goal,
            "continues": 1.0 - self.steps.terminated[t].to(obs.dtype),
        }
        return row, is_over, -reward


def make_agents(config: HiroConfig, envs: Any, seed: int) -> Agents:
    """Freshly drawn networks for these environments."""
    if config.goal_space in GOAL_SPACES:
        goals = Goals.of(config.goal_space, config.position_range, envs.robot_name, envs.observation_names)
    else:
        goals = Goals.about(envs.layout.find("goal_space", config.goal_space), config.position_range)
    sizes = envs.single_observation_space.shape[0], envs.single_action_space.shape[0]
    unseen: list[int] = []
    if config.goal_space == "body" and POSITION[0] not in envs.observation_names:  # "without access to (x, y)"
        unseen = [i for i, name in enumerate(envs.observation_names) if name in ABSOLUTE]
    return Agents(config, goals, *sizes, seeding.torch_generator(seed, "initialisation"), unseen)


@torch.no_grad()
def skill_rollouts(config: HiroConfig, agents: Agents, memory: Memory, envs: Any, seed: int) -> None:
    """Fill `memory` with roll-outs of the given skills, each goal being the change that its period achieved.

    Where that leaves the box, the goal is the nearest one in it, and it is carried along and paid for as such.

    Raises:
        SkillsError: the given skills cannot be read or are another robot's.
    """
    path = Path(config.skills)
    policy, _ = policy_of(path)
    load_skills(path, policy, envs.robot_name, envs.observation_variant)  # whichever view they have
    T, N, goals = config.horizon, envs.num_envs, agents.goals
    tapped = LastInfo(envs)
    steps = Steps(tapped, T, bootstrap_horizon=True)
    rng = seeding.numpy_generator(seed, "roll-outs of given skills")
    act = policy.actor()
    obs = steps.reset(seeding.integer(seed, "episodes of given skills"))
    next_obs, is_over = torch.empty_like(steps.obs[1:]), torch.zeros(T, N, dtype=torch.bool)
    skill, age = rng.integers(policy.num_skills, size=N), np.zeros(N, np.int64)
    for t in range(T):
        noise = rng.standard_normal(steps.action.shape[1:], steps.action.numpy().dtype)
        obs, done = steps.step(t, np.clip(act(policy.see_array(obs), skill, noise), -1, 1))
        next_obs[t] = torch.from_numpy(np.where(done[:, None], tapped.info.get("final_obs", obs), obs))
        age += 1
        ends = done | (age == config.period) | (t == T - 1)
        is_over[t] = torch.from_numpy(ends)
        skill, age = np.where(ends, rng.integers(policy.num_skills, size=N), skill), np.where(ends, 0, age)
    reached = goals.of_state(next_obs)
    for t in reversed(range(T - 1)):
        reached[t] = torch.where(is_over[t].unsqueeze(1), reached[t], reached[t + 1])
    wanted = goals.of_state(steps.obs[:-1]) + goals.clip(reached - goals.of_state(steps.obs[:-1]))
    for t in range(1, T):  # stays what it was where the period began
        wanted[t] = torch.where(is_over[t - 1].unsqueeze(1), wanted[t], wanted[t - 1])
    goal = wanted - goals.of_state(steps.obs[:-1])
    next_goal = wanted - goals.of_state(next_obs)  # what remains where a period ended, unless another one follows
    follows = is_over[:-1] & ~steps.done[:-1]
    next_goal[:-1] = torch.where(follows.unsqueeze(-1), goal[1:], next_goal[:-1])
    for t in range(T):
        row = {
            "obs": steps.obs[t],
            "goal": goal[t],
            "action": steps.action[t],
            "reward": goals.reward(steps.obs[t], goal[t], next_obs[t]),
            "next_obs": next_obs[t],
            "next_goal": next_goal[t],
            "continues": 1.0 - steps.terminated[t].to(steps.obs.dtype),
        }
        memory.add(row, steps.reward[t], is_over[t])


def clone(config: HiroConfig, agents: Agents, replay: Replay, seed: int) -> None:
    """Behaviour cloning: fit the lower level to the actions in `replay`, given its states and goals."""
    generator, actor = seeding.torch_generator(seed, "cloning"), agents.low.actor
    optimizer = Adam(actor.parameters(), lr=CLONING_LEARNING_RATE, fused=True)
    for _ in range(config.cloning_updates):
        rows = replay.sample(config.minibatch_size, generator)
        loss = (actor(agents.low_input(rows["obs"], rows["goal"])) - rows["action"]).square().mean()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
    agents.low.target_actor.load_state_dict(actor.state_dict())


def restored(config: HiroConfig, envs: Any, checkpoint: Checkpoint) -> Agents:
    """The agents of a checkpoint."""
    agents = make_agents(config, envs, 0)
    checkpoint.restore(agents=agents)
    return agents


class Acting:
    """Both levels at work, with their exploration unless `greedy` (`hippo.core.acting.Acting`)."""

    def __init__(
        self, agents: Agents, config: HiroConfig, num_envs: int, seed: int, iteration: int, greedy: bool = False
    ) -> None:
        self.agents, self.period = agents, config.period
        self._generator = None if greedy else seeding.torch_generator(seed, "exploration", iteration)
        self._age = torch.full((num_envs,), config.period)  # steps since the goal was set
        self._done = torch.ones(num_envs, dtype=torch.bool)
        self._obs: Tensor | None = None
        self.goal = torch.zeros(num_envs, len(agents.goals.index))  # (N, k) in force

    @property
    def steps_left(self) -> np.ndarray:
        """(N,) for how many more steps a goal is in force."""
        return (self.period - self._age).numpy()

    def _noise(self, size: Sequence[int]) -> Tensor | None:
        return None if self._generator is None else torch.randn(tuple(size), generator=self._generator)

    def act(self, obs: np.ndarray) -> np.ndarray:
        """Actions (N, A) towards what remains of the goals, new ones where a period or an episode is over."""
        agents, seen = self.agents, torch.from_numpy(obs.copy())
        if self._obs is not None:
            self.goal = agents.goals.transition(self._obs, self.goal, seen)
        is_over = self._done | (self._age == self.period)
        if is_over.any():
            fresh = agents.new_goal(seen, self._noise(self.goal.shape))
            self.goal = torch.where(is_over.unsqueeze(1), fresh, self.goal)
            self._age[is_over] = 0
        self._obs = seen
        return agents.act(seen, self.goal, self._noise((len(seen), len(agents.low.unit)))).numpy()

    def end(self, done: np.ndarray) -> None:
        """One step has passed, and with it the episodes where `done` (N,)."""
        self._done = torch.from_numpy(done.copy())
        self._age += 1


class Learner:
    """Updates of both levels, at their ratio to environment steps."""

    def __init__(self, config: HiroConfig, agents: Agents, memory: Memory, generator: torch.Generator) -> None:
        self.config, self.agents, self.memory, self.generator = config, agents, memory, generator
        self.low, self.manager = torch.zeros(2), torch.zeros(3)  # summed over the updates of an iteration
        self.low_updates = self.manager_updates = 0
        self.seconds = 0.0

    def catch_up(self, env_steps: int) -> None:
        """Do the updates that are due after `env_steps` environment steps in all."""
        start, config = time.perf_counter(), self.config
        due = int(max(env_steps - config.warmup_steps, 0) * config.updates_per_step)
        for update in range(int(self.agents.low.updates), due):
            self.low += self.agents.learn_low(self.memory.low, self.generator)
            self.low_updates += 1
            if (update + 1) % config.manager_update_every == 0 and len(self.memory.manager):
                self.manager += self.agents.learn_manager(self.memory.manager, self.generator)
                self.manager_updates += 1
        self.seconds += time.perf_counter() - start

    def metrics(self) -> dict[str, float]:
        """Means over the updates of the iteration; 0 where there were none."""
        low, manager = self.low / max(self.low_updates, 1), self.manager / max(self.manager_updates, 1)
        return {
            "low_loss": float(low[0]),
            "low_value": float(low[1]),
            "manager_loss": float(manager[0]),
            "manager_value": float(manager[1]),
            "relabelled": float(manager[2]),
            "updates": self.low_updates,
        }


def train(config: HiroConfig, make_envs: MakeEnvs, log: RunLog, seed: int, checkpoint: Checkpoint) -> None:
    """Train from the newest checkpoint, or from scratch, to `config.iterations`.

    Raises:
        Diverged: an observation, a reward or a parameter is no longer finite.
        SkillsError: the given skills cannot be read or do not fit.
    """
    envs = make_envs(config.num_envs, "training")
    agents = make_agents(config, envs, seed)
    sizes = envs.single_observation_space.shape[0], envs.single_action_space.shape[0], len(agents.goals.index)
    settings = config.manager_reward_scale, config.ignore_terminals
    memory = Memory(config.replay_size, envs.num_envs, (config.period, *sizes), *settings)
    parts: dict[str, Any] = {"agents": agents} | agents.optimizers() | memory.parts
    first = checkpoint.restore(**parts)
    log.resume(first)
    if config.skills and first == 0:
        demonstrators = make_envs(-(-config.cloning_steps // config.horizon), "given skills")
        demonstrated = Memory(config.replay_size, demonstrators.num_envs, (config.period, *sizes), *settings)
        skill_rollouts(config, agents, demonstrated, demonstrators, seed)
        for name, part in memory.parts.items():
            part.load_state_dict(demonstrated.parts[name].state_dict())
        clone(config, agents, memory.low, seed)
        demonstrators.close()

    for iteration in range(first, config.iterations):
        start = time.perf_counter()
        walk = Walk.begin(agents, envs, seed, iteration)
        memory.abandon()
        learner = Learner(config, agents, memory, seeding.torch_generator(seed, "updates", iteration))
        env_steps = iteration * walk.steps.num_steps
        goal_size, distances = [], []
        for t in range(config.horizon):
            begins, size = walk.age == 0, walk.goal.norm(dim=1)
            row, is_over, distance = walk.step(t, walk.act())
            goal_size.append(size[begins])
            distances.append(distance[is_over])
            memory.add(row, walk.steps.reward[t], is_over)
            env_steps += envs.num_envs
            learner.catch_up(env_steps)
        check_finite(iteration, parameters=nn.utils.parameters_to_vector(agents.parameters()))
        walk.steps.check(iteration)
        if iteration == config.iterations - 1:  # nothing will be learnt from them any more
            memory.low.clear()
            memory.manager.clear()
        end = time.perf_counter()
        metrics = {
            "iteration": iteration,
            "env_steps": env_steps,
            **walk.steps.statistics(),
            **learner.metrics(),
            "goal_size": float(torch.cat(goal_size).mean()),
            "goal_distance": float(torch.cat(distances).mean()),
        }
        log.row(metrics, walk.steps.timing(start, end - learner.seconds, end))
        checkpoint.record(iteration, **parts)
    checkpoint.previous.unlink(missing_ok=True)  # it alone still holds the buffers, up to half a gigabyte
    envs.close()
