"""How much the Block tasks allow: random policies and the blind gaits of gaits.json, on fresh episodes.

    python -m experiments.artefacts.calibration                 # the table of docs/environments/calibration.md, minutes
    python -m experiments.artefacts.calibration --figure fig3   # the finished runs of a figure, with walls and without

Nothing is trained here.
"""

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.artefacts.gait_search import TASKS, actions, committed, row
from experiments.command_line import Parser, bad_input, run_command
from experiments.crossings import CEILING, Crossings, Walls, totals
from experiments.evaluate import evaluate, interval
from experiments.plan import Entry, make_plan
from hippo.core import seeding
from hippo.core.checkpoint import CheckpointError
from hippo.core.settings import ConfigError
from hippo.envs import make
from hippo.envs.blocks import TUMBLED

Policy = Callable[[int, np.ndarray], np.ndarray]  # step, observations (N, D) -> actions (N, A)
HEADER = f"| task | policy | walls per episode | 95 % interval | with \\|pitch\\| > {TUMBLED:g} rad | torso at, m |"
BLANKED = " of the blind gait's | walls blanked | 95 % interval |"


def uniform(envs: Any, rng: np.random.Generator) -> Policy:
    """Every action equally likely."""
    return lambda step, obs: rng.uniform(-1, 1, envs.action_space.shape)


def noise(envs: Any, rng: np.random.Generator) -> Policy:
    """Standard Gaussian noise, clipped: a policy before its first update."""
    return lambda step, obs: rng.standard_normal(envs.action_space.shape)


def blind_gait(task: str) -> Callable[[Any, np.random.Generator], Policy]:
    """The gait that was found for `task`."""
    parameters = row(committed(task))[None]
    return lambda envs, rng: (
        lambda step, obs: np.repeat(actions(parameters, step / envs.metadata["render_fps"]), envs.num_envs, 0)
    )


def measure(
    task: str,
    policy: Callable[[Any, np.random.Generator], Policy],
    episodes: int,
    seed: int,
    horizon: int | None = None,
    walls_as: np.ndarray | None = None,
    **options: Any,
) -> tuple[list[dict[str, Any]], np.ndarray]:
    """A row of crossings.COLUMNS for each of so many episodes, and the mean of what was observed of walls, (8,).

    Args:
        walls_as: what the policy observes of walls in place of what they are.
    """
    crossed = Crossings(make(task, episodes, seeding.integer(seed, "calibration"), horizon=horizon, **options))
    envs = Walls(crossed, walls_as)
    act = policy(envs, seeding.numpy_generator(seed, "calibration"))
    obs, _ = envs.reset()
    for step in range(envs.horizon):
        obs, *_ = envs.step(act(step, obs))
    return crossed.rows(), envs.mean()


def line(task: str, name: str, rows: Sequence[dict[str, Any]]) -> str:
    """One row of the table."""
    paid, tumbled, height = totals(rows)
    crossed = f"{tumbled:.0%} | {height:.2f}" if paid else "- | -"
    return f"| `{task}` | {name} | {mean_and_interval(rows)} | {crossed} |"


def mean_and_interval(rows: Sequence[dict[str, Any]]) -> str:
    """Two cells: walls per episode and the interval of their mean."""
    walls = np.array([r["crossings"] for r in rows], float)
    low, high = interval(walls)
    return f"{walls.mean():.2f} | {low:.2f} to {high:.2f}"


def finished(figure: str, scale: str, protocol: str, runs_dir: Path) -> list[Entry]:
    """The finished runs of a figure on the Block tasks; ConfigError where there are none."""
    plan = make_plan(figure, scale, [], True, runs_dir, protocol)
    found = [entry for entry in plan.entries if entry.run.env in TASKS and entry.state == "finished"]
    if not found:
        raise ConfigError("--figure", figure, f"has no finished run on a Block task at {plan.edition} in {runs_dir}")
    return found


def trained_line(task: str, name: str, rows: Sequence[dict[str, Any]], blanked: Sequence[dict[str, Any]]) -> str:
    """One row about a trained policy: as the others, its share of the blind gait's walls, and with walls blanked."""
    share = np.mean([r["crossings"] for r in rows]) / CEILING[task]
    return f"{line(task, name, rows)} {share:.0%} | {mean_and_interval(blanked)} |"


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure from the command line."""
    parser = Parser(prog="experiments.artefacts.calibration", description=__doc__.splitlines()[0])
    parser.add_argument("--task", choices=TASKS, help="this one only")
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--tumble", action="store_true", help="with env.terminate_on_tumble=true")
    parser.add_argument("--figure", help="instead: the policies of this figure's finished runs")
    parser.add_argument("--scale", default="laptop")
    parser.add_argument("--protocol", default="modern")
    parser.add_argument("--runs-dir", type=Path, default=Path("runs"))
    options = parser.parse_args(arguments)
    for key, least in (("episodes", 1), ("seed", 0)):
        if getattr(options, key) < least:
            return bad_input(ConfigError(f"--{key}", getattr(options, key), f"must be at least {least}"))
    if options.figure is not None:
        return show_trained(options)
    print(HEADER, "|---|---|---|---|---|---|", sep="\n")
    changes: dict[str, Any] = {"terminate_on_tumble": True} if options.tumble else {}
    for task in [options.task] if options.task else TASKS:
        policies = {"uniform actions": uniform, "Gaussian noise": noise, "blind gait": blind_gait(task)}
        for name, policy in policies.items():
            rows, _ = measure(task, policy, options.episodes, options.seed, **changes)
            print(line(task, name, rows), flush=True)
    return 0


def show_trained(options: argparse.Namespace) -> int:
    """`--figure`."""
    try:
        if options.tumble:
            raise ConfigError("--tumble", True, "is of random policies and gaits, not of --figure")
        entries = finished(options.figure, options.scale, options.protocol, options.runs_dir)
        print(HEADER + BLANKED, "|---|---|---|---|---|---|---|---|---|", sep="\n")
        for entry in (e for e in entries if options.task in (None, e.run.env)):
            run, of = entry.run, (options.episodes, options.seed)
            rows, blanked = (evaluate(run, *of, blank_walls=blank) for blank in (False, True))
            print(trained_line(run.env, f"{entry.variant_label}, seed {run.seed}", rows, blanked), flush=True)
    except (ConfigError, CheckpointError) as error:
        return bad_input(error)
    return 0


if __name__ == "__main__":
    run_command(main)
