"""How much the Block tasks allow: random policies and the blind gaits of experiments/gaits.json, on fresh episodes.

    python -m experiments.calibration        # the table of docs/environments/calibration.md, a few minutes

Nothing here sees the robot or the walls, and nothing is trained.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from experiments.command_line import Parser, bad_input, run_command
from experiments.crossings import Crossings, totals
from experiments.evaluate import interval
from experiments.gait_search import TASKS, actions, committed, row
from hippo.core import seeding
from hippo.core.settings import ConfigError
from hippo.envs import make
from hippo.envs.blocks import TUMBLED

Policy = Callable[[int], np.ndarray]  # step -> actions (N, A)


def uniform(envs: Any, rng: np.random.Generator) -> Policy:
    """Every action equally likely."""
    return lambda step: rng.uniform(-1, 1, envs.action_space.shape)


def noise(envs: Any, rng: np.random.Generator) -> Policy:
    """Standard Gaussian noise, clipped: a policy before its first update."""
    return lambda step: rng.standard_normal(envs.action_space.shape)


def blind_gait(task: str) -> Callable[[Any, np.random.Generator], Policy]:
    """The gait that was found for `task`."""
    parameters = row(committed(task))[None]
    return lambda envs, rng: (
        lambda step: np.repeat(actions(parameters, step / envs.metadata["render_fps"]), envs.num_envs, 0)
    )


def measure(
    task: str,
    policy: Callable[[Any, np.random.Generator], Policy],
    episodes: int,
    seed: int,
    horizon: int | None = None,
    **options: Any,
) -> list[dict[str, Any]]:
    """A row of crossings.COLUMNS for each of so many episodes."""
    envs = Crossings(make(task, episodes, seeding.integer(seed, "calibration"), horizon=horizon, **options))
    act = policy(envs, seeding.numpy_generator(seed, "calibration"))
    envs.reset()
    for step in range(envs.horizon):
        envs.step(act(step))
    return envs.rows()


def line(task: str, name: str, rows: Sequence[dict[str, Any]]) -> str:
    """One row of the table."""
    walls = np.array([r["crossings"] for r in rows], float)
    low, high = interval(walls)
    paid, tumbled, height = totals(rows)
    crossed = f"{tumbled:.0%} | {height:.2f}" if paid else "- | -"
    return f"| `{task}` | {name} | {walls.mean():.2f} | {low:.2f} to {high:.2f} | {crossed} |"


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure from the command line."""
    parser = Parser(prog="experiments.calibration", description=__doc__.splitlines()[0])
    parser.add_argument("--task", choices=TASKS, help="this one only")
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--tumble", action="store_true", help="with env.terminate_on_tumble=true")
    options = parser.parse_args(arguments)
    for key, least in (("episodes", 1), ("seed", 0)):
        if getattr(options, key) < least:
            return bad_input(ConfigError(f"--{key}", getattr(options, key), f"must be at least {least}"))
    print(f"| task | policy | walls per episode | 95 % interval | with \\|pitch\\| > {TUMBLED:g} rad | torso at, m |")
    print("|---|---|---|---|---|---|")
    changes = {"terminate_on_tumble": True} if options.tumble else {}
    for task in [options.task] if options.task else TASKS:
        policies = {"uniform actions": uniform, "Gaussian noise": noise, "blind gait": blind_gait(task)}
        for name, policy in policies.items():
            print(line(task, name, measure(task, policy, options.episodes, options.seed, **changes)), flush=True)
    return 0


if __name__ == "__main__":
    run_command(main)
