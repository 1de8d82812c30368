"""HIRO from given skills: their roll-outs as decisions of a manager, and a lower level cloned from them."""

from pathlib import Path
from typing import Any

import numpy as np
import torch

from baselines.hiro_config import HiroConfig
from baselines.hiro_levels import Agents
from hippo.core import seeding
from hippo.core.goals import Memory
from hippo.core.optimizers import Adam
from hippo.core.replay import Replay
from hippo.core.rollout import LastInfo, Steps
from hippo.core.skills import load_skills, policy_of

CLONING_LEARNING_RATE = 1e-3


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
