"""How much of given skills is left in HIRO's lower level, which is cloned from them: distances, side by side.

    python -m experiments.artefacts.cloning [ROBOT ...] [--paths 60] [--seed 0]

Of each robot's committed skills, the robot alone: the skills as they are, with their noise; by their means; and the
clone, which has no noise and is given, period by period, what a path of the skill with noise achieved. Prints the
table of docs/algorithms/hiro.md; about a minute per robot on one core.
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from baselines import hiro
from baselines.hiro import Agents, HiroConfig
from experiments.artefacts.gallery import PHYSICS, STEPS, from_start
from experiments.choices import COMMITTED, check_choice
from experiments.command_line import Parser, bad_input, run_command
from experiments.schema import PRETRAINING
from hippo.core import seeding
from hippo.core.goals import Goals, Memory
from hippo.core.policies import SkillPolicy
from hippo.core.pretraining import Paths, PretrainingConfig, collect
from hippo.core.settings import ConfigError
from hippo.core.skills import SkillsError, policy_of
from hippo.envs import make

SILENT = -1e3  # a log standard deviation, far below its floor


@dataclass
class Distances:
    """Metres from the start at the end of a path, mean over the paths of each skill (Z,), and what was cloned."""

    sampled: np.ndarray
    means: np.ndarray
    clone: np.ndarray
    beyond: float  # share of the sampled actions' entries outside +-1, where they are clipped


def walked(policy: SkillPolicy, robot: str, steps: int, skill: np.ndarray, seed: int) -> Paths:
    """A path of each of the skills (N,), whole."""
    config = PretrainingConfig(iterations=1, batch_size=len(skill) * steps, horizon=steps)
    envs = make(robot, len(skill), 0, horizon=steps, physics=PHYSICS)
    paths = collect(policy, envs, config, seed, 0, skill)
    envs.close()
    return paths


def changes(goals: Goals, paths: Paths, period: int) -> Tensor:
    """What every period of a path achieved, within the goals' box: (ceil(T / period), N, k)."""
    steps = len(paths.next_obs)
    begin = torch.arange(0, steps, period)
    end = torch.clamp(begin + period, max=steps) - 1
    return goals.clip(goals.of_state(paths.next_obs[end]) - goals.of_state(paths.steps.obs[begin]))


@torch.no_grad()
def chased(agents: Agents, envs: Any, wanted: Tensor, steps: int, seed: int) -> np.ndarray:
    """Metres (N,) that the lower level gets from the start within `steps` if asked for `wanted` (K, N, k) in turn.

    A path that ends early stays where it ended.
    """
    obs, period = torch.from_numpy(envs.reset(seed=seed)[0].copy()), agents.config.period
    start, place, over = envs.com[:, :2].copy(), envs.com[:, :2].copy(), np.zeros(envs.num_envs, bool)
    for t in range(steps):
        if t % period == 0:
            goal = wanted[t // period]
        seen, _, terminated, truncated, info = envs.step(agents.act(obs, goal, None).numpy())
        after = torch.from_numpy(seen.copy())
        goal, obs = agents.goals.transition(obs, goal, after), after
        place[~over] = info["com"][~over, :2]
        over |= terminated | truncated
    return np.linalg.norm(place - start, axis=1)


def cloned(path: Path, robot: str, steps: int, seed: int) -> Agents:
    """HIRO's agents with a lower level cloned from a skills file, as HIRO does it before its first iteration."""
    config = HiroConfig(iterations=1, batch_size=steps, horizon=steps, skills=str(path))
    envs = make(robot, -(-config.cloning_steps // steps), 0, horizon=steps, physics=PHYSICS)
    agents = hiro.make_agents(config, envs, seed)
    sizes = envs.single_observation_space.shape[0], envs.single_action_space.shape[0], len(agents.goals.index)
    memory = Memory(config.replay_size, envs.num_envs, (config.period, *sizes))
    hiro.skill_rollouts(config, agents, memory, envs, seed)
    hiro.clone(config, agents, memory.low, seed)
    envs.close()
    return agents


def measure(path: Path, robot: str, steps: int, paths: int, seed: int) -> Distances:
    """Distances of a skills file's skills and of their clone, over `paths` paths in all."""
    policy, _ = policy_of(path)
    silent = copy.deepcopy(policy)
    silent.log_std_parameter.data.fill_(SILENT)
    skill = np.arange(paths) % policy.num_skills
    with_noise, by_means = (walked(p, robot, steps, skill, seed) for p in (policy, silent))
    agents = cloned(path, robot, steps, seed)
    envs = make(robot, paths, 0, horizon=steps, physics=PHYSICS)
    wanted = changes(agents.goals, with_noise, agents.config.period)
    of_clone = chased(agents, envs, wanted, steps, seeding.integer(seed, "episodes", 0))  # the starts of `collect`
    envs.close()
    reached = [np.linalg.norm(from_start(p)[-1], axis=1) for p in (with_noise, by_means)]
    sampled, means, clone = (
        np.array([x[skill == z].mean() for z in range(policy.num_skills)]) for x in (*reached, of_clone)
    )
    return Distances(sampled, means, clone, float((with_noise.steps.action.abs() > 1).double().mean()))


def line(robot: str, of: Distances) -> str:
    """A robot's row: means over skills, then each skill's."""
    each = [f"{x.mean():.2f} ({' '.join(f'{d:.2f}' for d in x)})" for x in (of.sampled, of.means, of.clone)]
    return f"| {robot} | {' | '.join(each)} | {of.beyond:.0%} |"


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print."""
    parser = Parser(prog="experiments.artefacts.cloning", description=__doc__.splitlines()[0])
    parser.add_argument("robots", nargs="*", metavar="ROBOT", help=f"of {', '.join(PRETRAINING)}; all of them if none")
    parser.add_argument("--paths", type=int, default=60, help="of all skills together")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    try:
        robots = [check_choice("robot", robot, list(PRETRAINING)) for robot in options.robots] or list(PRETRAINING)
        if options.paths < 6:
            raise ConfigError("paths", options.paths, "must be at least 6, one per skill")
        print("| robot | skills, sampled | skills, by their means | clone | action entries beyond +-1 |", flush=True)
        print("|---|---|---|---|---|", flush=True)
        for robot in robots:
            path = COMMITTED / "skills" / f"{robot}.pt"
            found = measure(path, robot, STEPS[PRETRAINING[robot]], options.paths, options.seed)
            print(line(robot, found), flush=True)
    except (ConfigError, SkillsError) as error:
        return bad_input(error)
    return 0


if __name__ == "__main__":
    torch.set_num_threads(1)
    run_command(main)
