"""Evaluate a trained policy, also under changed dynamics, without learning: its mean return, or a row per episode.

    python -m experiments.evaluate runs/<run_id> --perturbation mass --episodes 25 --out mass.csv

The same seed gives the same episodes (object positions, wall heights, initial poses, action noise) in the original
and in every changed environment, so that what differs is the dynamics. Training's random streams are never touched.
"""

import contextlib
import csv
import dataclasses
import io
import itertools
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy import special

from experiments import crossings
from experiments.command_line import Parser, bad_input, check_writable, run_command
from experiments.config import Run
from experiments.crossings import Crossings, Walls, has_walls
from experiments.manifest import changed_identity, stated
from experiments.status import read_status, write_atomically
from hippo.core import seeding
from hippo.core.acting import rollout
from hippo.core.checkpoint import Checkpoint, CheckpointError
from hippo.core.episodes import opening_episodes
from hippo.core.settings import ConfigError
from hippo.envs import make
from hippo.envs.arguments import Refused
from hippo.envs.registration import Options
from hippo.learners import learner_of

COLUMNS = (
    "run_id",
    "algo",
    "env",
    "perturbation",
    "strength",
    "greedy",
    "seed",
    "episode",
    "return",
    "length",
    "diverged",
)
BLANKED = "walls_blanked"  # column of such evaluations only


def load_run(folder: Path) -> Run:
    """The run that lives in `folder`, which is read whatever it is called; where its name or content differ, stderr
    says so.

    Raises:
        ConfigError: it is no run folder.
    """
    if not (folder / "config.yaml").exists():
        raise ConfigError("run", folder, "is no run folder: it has no config.yaml")
    try:
        run = Run.from_yaml((folder / "config.yaml").read_text(), folder.parent)
    except (OSError, ValueError) as error:
        raise ConfigError("run", folder / "config.yaml", f"cannot be read: {error}") from None
    manifest = stated(folder)
    here = dataclasses.replace(run, place=folder)
    with contextlib.suppress(OSError):  # the skills that it started from are not here, nor needed
        if manifest and manifest["run_id"] != run.run_id:
            differing = changed_identity(manifest["identity"], run)
            _note(f"{folder} is run {manifest['run_id']}, under this code it would be {run.run_id}: {differing}")
    if manifest and folder.resolve().name != manifest["run_id"]:
        _note(f"{folder} is a copy of run {manifest['run_id']}; what is read is {folder}")
    return here


def _note(text: str) -> None:
    print(f"note: {text}", file=sys.stderr, flush=True)


def trained(run: Run) -> Checkpoint:
    """The checkpoint of a run, which must be of the run that its folder states."""
    return Checkpoint(run.folder, name_of(run))


def name_of(run: Run) -> str:
    """The id under which a run was trained."""
    return stated(run.folder).get("run_id") or run.run_id


def load_finished_run(folder: Path) -> Run:
    """The run that lives in `folder`.

    Raises:
        ConfigError: it is no run folder, or its run is not finished.
    """
    run = load_run(folder)
    if (state := read_status(folder)["state"]) != "finished":
        raise ConfigError("run", folder, f"is {state}; only finished runs are taken")
    return run


def environments(run: Run, num_envs: int, seed: int, render_mode: str | None = None, **changes: Any) -> Any:
    """The environments of `run`, for its evaluation; `render_mode` of a gym:<id>, `changes` as in `evaluate`.

    Raises:
        ConfigError: there is nothing trained, or no such option.
    """
    if not (run.folder / "checkpoint.pt").exists():
        raise ConfigError("run", run.folder, "has no checkpoint; train it first")
    how = {"horizon": run.config.horizon, "render_mode": render_mode} | changed_options(run, changes)
    try:
        return make(run.env, num_envs, seeding.integer(seed, "evaluation"), **how)
    except Refused as error:
        raise ConfigError(error.key, error.value, error.valid) from error


def changed_options(run: Run, changes: dict[str, Any]) -> dict[str, Any]:
    """The options of `run`'s environment with those of `changes` that are not None."""
    return run.options | {name: value for name, value in changes.items() if value is not None}


def evaluate(
    run: Run, episodes: int, seed: int, greedy: bool = False, blank_walls: bool = False, **changes: Any
) -> list[dict[str, Any]]:
    """One row of COLUMNS, on Block tasks of crossings.COLUMNS too, per episode of the policy in `run`'s folder.

    Args:
        episodes: how many, all simulated side by side. seed: of the evaluation, apart from the run's.
        blank_walls: what the policy observes of walls is replaced by its mean over the same evaluation with them.
        changes: options of the environment that differ from the run's, e.g. perturbation="mass".

    Raises:
        ConfigError: there is nothing trained, no such option, or no wall to blank.
    """
    envs: Any = environments(run, episodes, seed, **changes)
    options, to_cross = changed_options(run, changes), has_walls(envs)
    if blank_walls and not to_cross:
        raise ConfigError("--blank-walls", run.env, "has no walls; the Block tasks have")
    if to_cross:
        envs = Crossings(envs)
    if blank_walls:
        seen = Walls(environments(run, episodes, seed, **changes))
        _roll_out(run, seen, seed, greedy)
        envs = Walls(envs, seen.mean())
    steps = _roll_out(run, envs, seed, greedy)
    returns, lengths = opening_episodes(steps.reward.numpy(), steps.done.numpy())
    common = {
        "run_id": name_of(run),
        "algo": run.algo,
        "env": run.env,
        "perturbation": options.get("perturbation", Options.perturbation) or "none",
        "strength": options.get("strength", Options.strength),
        "greedy": greedy,
        "seed": seed,
        "diverged": steps.diverged,
    }
    if blank_walls:
        common[BLANKED] = True
    walls = envs.rows() if to_cross else [{}] * episodes
    return [
        common | {"episode": i, "return": float(r), "length": int(n)} | crossed
        for i, (r, n, crossed) in enumerate(zip(returns, lengths, walls, strict=True))
    ]


def _roll_out(run: Run, envs: Any, seed: int, greedy: bool) -> Any:
    """The first episodes of the policy in `run`'s folder."""
    streams = seeding.integer(seed, "evaluation of a policy")
    return rollout(learner_of(run.algo), run.restored_config, envs, streams, trained(run), greedy)


def evaluate_all(
    run: Run, episodes: int, perturbations: Sequence[str], strengths: Sequence[str]
) -> list[dict[str, Any]]:
    """Rows of `evaluate` in the original environment, then under every perturbation and strength (Table 1)."""
    rows = evaluate(run, episodes, run.seed)
    for strength, perturbation in itertools.product(strengths, perturbations):
        print(f"{run.run_id}: {perturbation}, {strength}", flush=True)
        rows += evaluate(run, episodes, run.seed, perturbation=perturbation, strength=strength)
    return rows


def as_csv(rows: Sequence[dict[str, Any]]) -> str:
    """Rows of `evaluate` as csv text."""
    text = io.StringIO()
    columns = [*COLUMNS, *(name for name in (*crossings.COLUMNS, BLANKED) if any(name in row for row in rows))]
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def summary(rows: Sequence[dict[str, Any]]) -> str:
    """What a person reads: a line per environment, with the mean return and its 95 % interval over episodes."""
    columns = f"{'environment':18} {'perturbation':12} {'strength':8} {'episodes':>8}"
    lines = [f"{columns}  {'mean return':>11}  {'95 % interval':>19}  {'mean length':>11}"]
    for key, group in itertools.groupby(rows, lambda row: (row["env"], row["perturbation"], row["strength"])):
        env, perturbation, strength = key
        episodes = list(group)
        returns = np.array([row["return"] for row in episodes])
        low, high = interval(returns)
        between = f"{low:.3f} to {high:.3f}" if len(returns) > 1 else "none of one"
        cells = f"{env:18} {perturbation:12} {'' if perturbation == 'none' else strength:8} {len(returns):8}"
        length = np.mean([row["length"] for row in episodes])
        lines.append(f"{cells}  {returns.mean():11.3f}  {between:>19}  {length:11.1f}")
        if "crossings" in episodes[0]:
            lines.append(crossings.summary(episodes))
    return "\n".join(lines)


def interval(returns: np.ndarray) -> tuple[float, float]:
    """Student's 95 % interval of the mean of (n,) returns; of equal ones, and of a single one, a point."""
    mean, error = returns.mean(), returns.std(ddof=1) / len(returns) ** 0.5 if len(returns) > 1 else 0.0
    half = error * special.stdtrit(len(returns) - 1, 0.975) if error else 0.0
    return mean - half, mean + half


FLAGS = {"perturbation": "--perturbation", "strength": "--strength", "num_envs": "--episodes"}


def in_flags(error: ConfigError) -> ConfigError:
    """`error` with the environment's options as the flags to type: `strength=all` as `--strength all`."""
    if error.key not in FLAGS:
        return error
    valid = re.sub(rf"\b({'|'.join(FLAGS)})=", lambda match: f"{FLAGS[match[1]]} ", error.valid)
    return ConfigError(FLAGS[error.key], error.value, valid)


def main(arguments: Sequence[str] | None = None) -> int:
    """Evaluate from the command line."""
    parser = Parser(prog="experiments.evaluate", description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path, help="a run folder")
    parser.add_argument("--perturbation", help="mass, damping, inertia or friction")
    parser.add_argument("--strength", help="original (default) or all")
    parser.add_argument("--episodes", type=int, default=25, help="the paper's 25 (Table 1)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--greedy", action="store_true", help="most likely choices instead of samples")
    parser.add_argument(
        "--blank-walls", action="store_true", help="Block tasks: what is observed of walls is replaced by its mean"
    )
    parser.add_argument("--csv", action="store_true", help="print a row per episode instead of the summary")
    parser.add_argument("--out", type=Path, help="csv to write, a row per episode")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    try:
        if options.out is not None:
            check_writable("--out", options.out)
        run = load_run(options.run)
        changes = {"perturbation": options.perturbation, "strength": options.strength}
        rows = evaluate(run, options.episodes, options.seed, options.greedy, options.blank_walls, **changes)
    except ConfigError as error:
        return bad_input(in_flags(error))
    except CheckpointError as error:
        return bad_input(error)
    if options.out is not None:
        write_atomically(options.out, as_csv(rows))
    blanked = "\nwith what is observed of walls replaced by its mean" if options.blank_walls else ""
    print(as_csv(rows).rstrip("\n") if options.csv else summary(rows) + blanked)
    return 0


if __name__ == "__main__":
    run_command(main)
