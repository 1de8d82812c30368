"""HIRO: goals for a goal-conditioned lower level, both learnt off-policy (Nachum, Gu, Lee and Levine 2018).

Every c steps the manager sets a goal g, a wanted change of the entries S of the observation; in between

    g' = S(s) + g - S(s'),        r_low = - |S(s) + g - S(s')|

keep the wanted S fixed and pay for approaching it. Both levels are TD3 agents. Because the lower level changes, an old
goal no longer explains what was then done; a sampled decision is learnt from under the candidate goal g~ that makes
the actions of its c steps most likely to the present lower level (off-policy correction):

    argmax over g~ of  - sum_i | a_{t+i} - mu_low(s_{t+i}, S(s_t) + g~ - S(s_{t+i})) |^2

Source: tensorflow/models, research/efficient-hrl at 052361de. docs/algorithms/hiro.md lists what differs.
The paper has no box; its sections, line by line:

    3.1 the manager sets g every c steps           hiro_levels.py            Agents.new_goal, Walk.step
        else g' = h(s, g, s')                      hippo/core/goals.py       Goals.transition
        the lower level acts on (s, g)             hiro_levels.py            Agents.act
    3.2 intrinsic reward r(s, g, a, s')            hippo/core/goals.py       Goals.reward
        transitions of both levels are stored      hippo/core/goals.py       Memory.add
        both levels are trained                    here                      Learner.catch_up
          by TD3                                   hippo/core/td3.py         TD3.update
    3.3 candidates: g, s' - s, 8 around it         hippo/core/goals.py       candidate_goals
        the most likely one relabels (equation 5)  hiro_levels.py            Agents.relabel
    from given skills (ours)                       hiro_cloning.py           skill_rollouts, clone
"""

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from baselines.hiro_cloning import clone, skill_rollouts
from baselines.hiro_config import HiroConfig
from baselines.hiro_levels import Agents, Walk, make_agents
from hippo.core import seeding
from hippo.core.checkpoint import Checkpoint
from hippo.core.goals import Memory
from hippo.core.log import RunLog, check_finite
from hippo.core.training import MakeEnvs, Training

__all__ = ["Acting", "HiroConfig", "restored", "train"]

REVISION = 2  # bumped by every change that alters the metrics of tests/golden


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
    training = Training(log, checkpoint, parts)
    first = training.begin()
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
            **learner.metrics(),
            "goal_size": float(torch.cat(goal_size).mean()),
            "goal_distance": float(torch.cat(distances).mean()),
        }
        training.record(iteration, walk.steps, (start, end - learner.seconds, end), metrics)
    checkpoint.previous.unlink(missing_ok=True)  # it alone still holds the buffers, up to half a gigabyte
    envs.close()
