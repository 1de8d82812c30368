"""Small comparisons beside the paper's figures, on seeds of their own: what a setting is worth, which value to take.

    python -m experiments.study run tuning --workers 2    train what is missing; the same command continues
    python -m experiments.study show tuning               the table, its page and its picture, from committed rows

A study is a file of conf/study: its `variants`, each times all combinations of `over`, in its environments with its
seeds. Rows of finished runs are kept in paper_figures/data/studies/<name>.csv, which `run` adds to; `show` writes
docs/studies/<name>.md and the picture beside it from nothing else. With `peer: true` Stable-Baselines3's PPO stands
beside its variants, with the seeds that experiments.artefacts.peer_curves has trained.
"""

import argparse
import itertools
import os
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import yaml

from analysis import stats
from analysis.runs import COLUMNS, Results, read_committed, read_progress, scores
from experiments import peer_rows, sweep
from experiments.choices import COMMITTED, CONF, ROOT, check_choice, choices
from experiments.command_line import EXIT_FAILED, EXIT_REQUEUE, Parser, bad_input, clock, run_command
from experiments.commit import as_csv
from experiments.config import Run, compose_run
from experiments.plan import Entry, env_label
from experiments.status import DONE, check_locks, read_status, write_atomically
from hippo.core.settings import ConfigError
from paper_figures import curves, style

ROWS, PAGES = COMMITTED / "studies", ROOT / "docs" / "studies"
REPORT_SECONDS = 30.0  # between two progress lines
WITHIN = 1.01  # of a study's budget, to which the peer's iterations do not add up exactly


@dataclass
class StudyEntry(Entry):
    """One run of a study."""

    group: str  # the variant of which `over` makes several


@dataclass(frozen=True)
class Study:
    """conf/study/<name>.yaml and its runs, whole comparisons first."""

    name: str
    description: dict[str, Any]
    entries: list[StudyEntry]

    def peer(self) -> pd.DataFrame:
        """The rows of Stable-Baselines3's PPO that belong to the study, up to its budget, as its own are."""
        rows = peer_rows.read(peer_rows.ROWS)
        budgets = {entry.run.env: entry.run.env_steps for entry in self.entries if self.description.get("peer")}
        rows = rows[rows["env_steps"] <= WITHIN * rows["env"].map(budgets).fillna(0)]
        run_ids = "stable_baselines3_seed_" + rows["seed"].astype(str)
        labels = {"figure": self.name, "scale": self.entries[0].run.scale, "variant": peer_rows.LABEL}
        return rows.assign(**labels, run_id=run_ids, metric="return_mean", value=rows["return_mean"])[COLUMNS]

    def results(self, frame: pd.DataFrame) -> Results:
        """Rows of the study as those of a figure, so that they can be drawn as one."""
        runs = [entry.as_planned() for entry in self.entries]
        beside = frame[frame["variant"] == peer_rows.LABEL]
        for (env, seed), rows in beside.groupby(["env", "seed"]):
            budget = {"iterations": len(rows), "batch_size": round(rows["env_steps"].max() / len(rows))}
            of_peer = {"run_id": rows["run_id"].iloc[0], "env": env, "seed": seed, "env_label": env_label(str(env))}
            labels = dict.fromkeys(("variant", "variant_label"), peer_rows.LABEL)
            runs.append({**runs[0], **of_peer, **labels, **budget})
        first, there = self.entries[0].run, set(frame["run_id"])
        edition = {"scale": first.scale, "protocol": first.protocol}
        plan = {"figure": self.name, "title": self.description["title"], "runs": runs, **edition}
        return Results(plan, frame, [run for run in runs if run["run_id"] not in there])


def load(name: str, runs_dir: Path) -> Study:
    """A study by its name; ConfigError for one that does not exist."""
    check_choice("study", name, choices("study"))
    return build(name, yaml.safe_load((CONF / "study" / f"{name}.yaml").read_text()), runs_dir)


def build(name: str, described: dict[str, Any], runs_dir: Path) -> Study:
    """The study that a file of conf/study describes."""
    over = described.get("over", {})
    entries = []
    for seed in described["seeds"]:
        for env, of_env in described["environments"].items():
            for group, settings in described["variants"].items():
                for values in itertools.product(*over.values()):
                    varied = [f"{key}={value}" for key, value in zip(over, values, strict=True)]
                    chosen = [f"env={env}", f"seed={seed}", *described["settings"], *of_env, *settings, *varied]
                    label = ", ".join([group, *(text.removeprefix("algo.") for text in varied)])
                    run = compose_run(chosen, runs_dir)
                    entries.append(StudyEntry(run, env_label(env), label, label, "committed", group))
    return Study(name, described, entries)


def train(study: Study, workers: int, rows: Path) -> int:
    """Train what has no committed rows and add those of the runs that finish; returns the exit code."""
    path = rows / f"{study.name}.csv"
    committed = read_committed(path, study.entries[0].run.scale)
    missing = [e.run for e in study.entries if e.run.run_id not in set(committed["run_id"])]
    todo = [run for run in missing if read_status(run.folder)["state"] != "finished"]
    began, last = time.monotonic(), time.monotonic()

    def report(running: Sequence[Run], ended: int) -> None:
        nonlocal last
        if time.monotonic() - last >= REPORT_SECONDS:
            last = time.monotonic()
            share = ended + sum((read_status(r.folder).get("iteration", -1) + 1) / r.config.iterations for r in running)
            eta = clock((last - began) / share * (len(todo) - share)) if share else "unknown"
            print(f"[{ended}/{len(todo)}] {len(running)} running, ETA {eta}", flush=True)

    print(f"{study.name}: {len(study.entries)} runs, {len(todo)} to train", flush=True)
    states: dict[str, str] = {}
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # both stop it, and every run stays resumable
    try:
        states = sweep.train_all(todo, workers, report, in_order=True) if todo else {}
    except KeyboardInterrupt:
        print("stopped; the same command continues where it left off", file=sys.stderr)
    finally:
        parts = [committed] if len(committed) else []
        new = [entry for entry in study.entries if entry.run in missing]
        parts += [rows_of(study, e) for e in new if read_status(e.run.folder)["state"] == "finished"]
        kept = pd.concat(parts, ignore_index=True)[COLUMNS] if parts else committed
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, as_csv(kept))
        print(f"{kept['run_id'].nunique()} of {len(study.entries)} runs in {path}")
    if not states and todo:
        return EXIT_REQUEUE
    return EXIT_FAILED if set(states.values()) - set(DONE) else 0


def rows_of(study: Study, entry: Entry) -> pd.DataFrame:
    """The rows of a finished run that the study keeps."""
    run = entry.run
    rows = read_progress(run.folder / "progress.csv", study.description["metrics"])
    labels = {"figure": study.name, "scale": run.scale, "env": run.env, "variant": entry.variant}
    return rows.assign(**labels, seed=run.seed, run_id=run.run_id)[COLUMNS]


def table(study: Study, frame: pd.DataFrame) -> list[str]:
    """Final return and area of every variant, mean ± standard deviation over seeds, as Markdown lines.

    The score is the area relative to the mean over all variants in that environment, mean over environments; of those
    that `over` makes of one variant the highest is bold, once all of their runs are there.
    """
    environments = list(study.description["environments"])
    labels = dict.fromkeys((e.group, e.variant) for e in study.entries)
    if study.description.get("peer"):
        labels[peer_rows.LABEL, peer_rows.LABEL] = None
    finals, areas, counts = {}, {}, {}
    for (_, label), env in itertools.product(labels, environments):
        seeds, _, columns = scores(frame, env, label)
        per_seed = [columns[seed].dropna().to_numpy() for seed in seeds]
        counts[label, env] = len(seeds)
        finals[label, env] = np.array([stats.final_performance(curve) for curve in per_seed])
        areas[label, env] = np.array([curve.mean() for curve in per_seed])
    mean_area = {
        env: np.mean([areas[label, env].mean() for _, label in labels if counts[label, env]]) for env in environments
    }
    score = {
        label: float(np.mean([areas[label, env].mean() / mean_area[env] for env in environments]))
        for _, label in labels
        if all(counts[label, env] for env in environments)
    }
    groups = {group: [label for g, label in labels if g == group] for group, _ in labels}
    whole = {
        label
        for _, label in labels
        if all(counts[label, env] >= len(study.description["seeds"]) for env in environments)
    }
    best = {max(of, key=score.__getitem__) for of in groups.values() if len(of) > 1 and whole.issuperset(of)}
    heads = [f"{env_label(env)}: seeds | final | area" for env in environments]
    lines = [f"| variant | {' | '.join(heads)} | score |", "|---|" + "---|" * (3 * len(environments) + 1)]
    for _, label in labels:
        cells = []
        for env in environments:
            seeds_there = counts[label, env]
            words = [stats.with_deviation(x[label, env]) if seeds_there else "" for x in (finals, areas)]
            cells += [str(seeds_there), *words]
        name = f"**{label}**" if label in best else label
        lines.append(f"| {name} | {' | '.join(cells)} | {f'{score[label]:.2f}' if label in score else ''} |")
    return lines


def page(study: Study, frame: pd.DataFrame, picture: str) -> str:
    """The study's page."""
    described, there = study.description, len({entry.run.run_id for entry in study.entries} & set(frame["run_id"]))
    return "\n".join(
        [
            f"# {described['title']}",
            "",
            f"Written by `python -m experiments.study show {study.name}`; `... run {study.name}` trains it.",
            "",
            described["text"].strip(),
            *(["", f"**Not whole yet**: {there} of {len(study.entries)} runs."] if there < len(study.entries) else []),
            "",
            *table(study, frame),
            "",
            f"![{described['title']}]({picture})",
            "",
        ]
    )


def show(study: Study, rows: Path, pages: Path) -> int:
    """Print the table; write the page and the picture."""
    own = read_committed(rows / f"{study.name}.csv", study.entries[0].run.scale)
    frame = pd.concat([own, *([peer] if len(peer := study.peer()) else [])], ignore_index=True)
    if own.empty:
        print(f"{study.name}: no rows yet; `python -m experiments.study run {study.name}` makes them", file=sys.stderr)
        return EXIT_FAILED
    pages.mkdir(parents=True, exist_ok=True)
    style.use()
    results = study.results(frame)
    figure = curves.picture(results, 0.1, None, len(study.description["environments"]), style.WIDTH)
    style.save(figure, [pages / f"{study.name}.png"], study.description["title"], results.provenance())
    plt.close(figure)
    write_atomically(pages / f"{study.name}.md", page(study, frame, f"{study.name}.png"))
    print("\n".join(table(study, frame)))
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Train or show a study."""
    parser = Parser(prog="experiments.study", description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("action", choices=("run", "show"))
    parser.add_argument("study", help="a file of conf/study")
    parser.add_argument("--workers", type=int, default=len(os.sched_getaffinity(0)), help="processes, one thread each")
    parser.add_argument("--runs-dir", type=Path, default=Path("runs"))
    parser.add_argument("--rows", type=Path, default=ROWS, help="folder of the committed rows")
    parser.add_argument("--pages", type=Path, default=PAGES, help="folder of the pages")
    options = parser.parse_args(arguments)
    try:
        if options.workers < 1:
            raise ConfigError("workers", options.workers, "must be at least 1")
        study = load(options.study, options.runs_dir)
    except ConfigError as error:
        return bad_input(error)
    if options.action == "show":
        return show(study, options.rows, options.pages)
    options.runs_dir.mkdir(parents=True, exist_ok=True)
    check_locks(options.runs_dir)
    return train(study, options.workers, options.rows)


if __name__ == "__main__":
    run_command(main)
