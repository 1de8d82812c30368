"""HIRO's two levels: what they see, how they act and learn, and a walk of both through environments."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from baselines.hiro_config import HiroConfig
from hippo.core import seeding
from hippo.core.goals import GOAL_SPACES, POSITION, Goals, candidate_goals
from hippo.core.replay import Replay
from hippo.core.rollout import LastInfo, Steps
from hippo.core.td3 import TD3
from hippo.core.view import ABSOLUTE

EXPLORATION, TARGET_NOISE, TARGET_NOISE_CLIP = 1.0, 0.2, 0.5  # published, in the units of `noise_units`


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
