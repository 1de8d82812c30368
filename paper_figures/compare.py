"""Learning curves of any runs beside each other, of one scale, protocol and physics per environment.

    python -m paper_figures.compare runs/<run_id> runs/<run_id> ...

Runs that differ in nothing but the seed are one method, called by its algorithm and the settings that are not the
default; paper_figures/out/compare/<scale>/ has the picture and its numbers.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import yaml

from analysis.edition import PAPER, Edition
from analysis.runs import COLUMNS, PATTERNS, Results, altered, read_commits, read_progress
from paper_figures import curves
from paper_figures.command_line import BAD_INPUT, HERE, SMOOTH, share


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
    labels = {"env_label": identity["env"].replace("_", " ").title(), "variant": label, "variant_label": label}
    rest = {"physics": identity["options"].get("physics", "paper"), "kind": "train", "state": "finished"}
    edition = {"scale": config["scale"], "protocol": config.get("protocol", PAPER)}
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


def main(arguments: Sequence[str] | None = None) -> int:
    """Draw them; exit code 2 for what cannot be drawn together."""
    parser = argparse.ArgumentParser(prog="paper_figures.compare", description=__doc__.splitlines()[0])
    parser.add_argument("runs", type=Path, nargs="+", help="run folders")
    parser.add_argument("--out", type=Path, default=HERE / "out" / "compare")
    parser.add_argument("--smooth", type=share, default=SMOOTH, help="moving mean over this share of the iterations")
    options = parser.parse_args(arguments)
    try:
        results = gather(options.runs)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return BAD_INPUT
    for what in results.missing_lines():
        print(f"incomplete: {what}")
    print("wrote " + " ".join(map(str, curves.draw(results, options.out, share=options.smooth))))
    return 0


if __name__ == "__main__":
    sys.exit(main())
