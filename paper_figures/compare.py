"""Learning curves of any runs beside each other, of one scale, protocol and physics per environment, and a table.

    python -m paper_figures.compare runs/<run_id> runs/<run_id> ...
    python -m experiments.sweep compare NAME              # those of a sweep of one's own

Runs that differ in nothing but the seed are one method, called by its algorithm and the settings that are not the
default; paper_figures/out/compare/<scale>/ has the picture, its numbers and the table.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml

from analysis import stats
from analysis.command_line import bad_input
from analysis.edition import PAPER, Edition
from analysis.runs import COLUMNS, PATTERNS, Results, altered, read_commits, read_progress, scores
from paper_figures import curves
from paper_figures.command_line import HERE, SMOOTH, share

OUT = HERE / "out" / "compare"
TABLE = ("environment", "label", "final", "low", "high", "area", "seeds", "hours")


def planned(folder: Path) -> dict[str, Any]:
    """A run folder as a plan describes its runs, and its `scale` and `protocol`.

    Raises:
        ValueError: it is none of a training run.
    """
    try:
        manifest = json.loads((folder / "manifest.json").read_text())
        identity, config = manifest["identity"], yaml.safe_load(manifest["config"])
        own = identity["settings"] | identity["options"]
        named = all(
            PATTERNS[key].fullmatch(name) for key, name in (("run_id", manifest["run_id"]), ("env", identity["env"]))
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError, yaml.YAMLError) as error:
        raise ValueError(f"{folder}: is no run folder ({type(error).__name__})") from error
    if not named:
        raise ValueError(f"{folder}: its manifest.json names no run")
    if config["kind"] != "train":
        raise ValueError(f"{folder}: is a run of kind {config['kind']}; only training runs are compared")
    label = " ".join([identity["algo"], *(f"{key}={value}" for key, value in own.items())])
    budget = {key: identity[key] for key in ("env", "seed", "iterations", "batch_size")}
    env = identity["env"]
    env_label = env if env.startswith("gym:") else env.replace("_", " ").title()
    labels = {"env_label": env_label, "variant": label, "variant_label": label}
    rest = {"physics": identity["options"].get("physics", "paper"), "kind": "train", "state": "finished"}
    edition = {"scale": config["scale"], "protocol": config.get("protocol", PAPER)}
    settings = config.get("config", {})
    horizon = settings.get("horizon", identity["batch_size"])
    steps = horizon * -(-identity["batch_size"] // horizon)  # of whole horizons
    cycle = settings.get("warmup_iterations", 0) + settings.get("joint_iterations", 0) or 1  # of MLSH
    budget |= {"env_steps": identity["iterations"] * steps, "cycle": cycle}
    return {"run_id": manifest["run_id"]} | edition | budget | labels | rest


def gather(folders: Sequence[Path]) -> Results:
    """The runs in `folders` as the results of one figure.

    Raises:
        ValueError: a folder holds no training run or no row yet; runs of two scales, protocols or kinds of physics.
    """
    runs = {run["run_id"]: run | {"folder": folder} for folder in folders for run in [planned(folder)]}
    for key, of in (("scale", ""), ("protocol", ""), ("physics", "env")):
        groups: dict[str, set[str]] = {}
        for run in runs.values():
            groups.setdefault(run[of] if of else "the runs", set()).add(run[key])
        for name, values in groups.items():
            if len(values) > 1:
                raise ValueError(f"{name}: of more than one {key} ({', '.join(sorted(values))}), never drawn together")
    edition = {key: next(iter(runs.values()))[key] for key in ("scale", "protocol")}
    parts, missing = [], []
    for run in runs.values():
        folder = run.pop("folder")
        rows = read_progress(folder / "progress.csv", ["return_mean"])
        if wrong := altered(folder):
            rows, run["state"] = rows[:0], wrong
        if len(rows) < run["iterations"]:
            missing.append(run)
        parts.append(rows.assign(figure="compare", **{key: run[key] for key in ("scale", *COLUMNS[2:6])}))
    frame = pd.concat([rows for rows in parts if len(rows)] or parts, ignore_index=True)[COLUMNS]
    if frame.empty:
        raise ValueError("runs: none of them has a row yet")
    title = ", ".join(["Runs beside each other", *Edition.planned(edition).marks])
    plan = {"figure": "compare", **edition, "title": title, "runs": list(runs.values())}
    return Results(plan, frame, missing, read_commits(folders[0].parent, sorted(runs)))


def rows(results: Results, folders: dict[str, Path]) -> list[dict[str, Any]]:
    """The table: a row of TABLE per environment and method that has data.

    `final` is the mean over seeds of the last 10 % of iterations, `low` and `high` its 95 % bootstrap interval (NaN for
    one seed), `area` the mean return over the environment steps trained, both of whole cycles where a method starts
    over, `hours` the training time of all seeds together (NaN where it is not known, as of committed rows).

    Args:
        folders: run id -> run folder.
    """
    found = []
    for env, env_label in curves.unique(results, "env").items():
        for variant, label in curves.unique(results, "variant").items():
            seeds, _, table = scores(results.frame, env, variant)
            whole = [curve for seed in seeds if len(curve := table[seed].dropna())]
            if not whole:
                continue
            cycle = results.rows_per_cycle(env, variant, whole[0].index[0])
            final = np.array([stats.final_performance(curve.to_numpy(), cycle) for curve in whole])
            interval = stats.bootstrap_mean(final)
            area = np.mean([area_under(curve[: len(stats.whole_cycles(curve.to_numpy(), cycle))]) for curve in whole])
            ids = [r["run_id"] for r in results.plan["runs"] if (r["env"], r["variant"]) == (env, variant)]
            spent = sum(hours(folders[run_id]) for run_id in ids if run_id in set(results.frame["run_id"]))
            numbers = (interval.point, interval.low, interval.high, area)
            values = (env_label, label, *map(float, numbers), len(whole), spent)
            found.append(dict(zip(TABLE, values, strict=True)))
    return found


def area_under(curve: pd.Series) -> float:
    """Mean of a curve over its index, the environment steps, by trapezoids."""
    steps, values = curve.index.to_numpy(float), curve.to_numpy(float)
    return float(np.trapezoid(values, steps) / (steps[-1] - steps[0])) if len(steps) > 1 else float(values[0])


def hours(folder: Path) -> float:
    """Training time that a run's timing.csv adds up to, NaN where there is none."""
    try:
        return float(pd.read_csv(folder / "timing.csv", usecols=["seconds"])["seconds"].sum()) / 3600
    except (OSError, ValueError, TypeError):
        return float("nan")


def as_text(table: Sequence[dict[str, Any]]) -> str:
    """The table with columns as wide as they need."""
    lines = [TABLE, *(tuple(cell if isinstance(cell, str) else short(cell) for cell in r.values()) for r in table)]
    widths = [max(len(line[i]) for line in lines) for i in range(len(TABLE))]
    cells = [
        [
            f"{cell:<{width}}" if i < 2 else f"{cell:>{width}}"
            for i, (cell, width) in enumerate(zip(line, widths, strict=True))
        ]
        for line in lines
    ]
    return "\n".join("  ".join(line).rstrip() for line in cells)


def short(number: float) -> str:
    """Four digits of a number, nothing for one that is not known."""
    return "" if np.isnan(number) else f"{number:.4g}"


def show(results: Results, folders: dict[str, Path], out: Path, smooth: float = SMOOTH) -> None:
    """Draw the curves, print the table, write both under `out`/<scale>/."""
    for what in results.missing_lines():
        print(f"incomplete: {what}")
    table = rows(results, folders)
    paths = curves.draw(results, out, share=smooth)
    stem = results.stem(out)
    path = stem.with_name(f"{stem.name}.table.csv")
    pd.DataFrame(table, columns=TABLE).to_csv(path, index=False, lineterminator="\n")
    print(as_text(table))
    print("wrote " + " ".join(map(str, [*paths, path])))


def main(arguments: Sequence[str] | None = None) -> int:
    """Draw them; exit code 2 for what cannot be drawn together."""
    parser = argparse.ArgumentParser(prog="paper_figures.compare", description=__doc__.splitlines()[0])
    parser.add_argument("runs", type=Path, nargs="+", help="run folders")
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--smooth", type=share, default=SMOOTH, help="moving mean over this share of the iterations")
    options = parser.parse_args(arguments)
    try:
        results = gather(options.runs)
    except ValueError as error:
        return bad_input(error)
    show(results, {planned(folder)["run_id"]: folder for folder in options.runs}, options.out, options.smooth)
    return 0


if __name__ == "__main__":
    sys.exit(main())
