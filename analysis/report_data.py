"""What the report says of one scale, gathered from files alone: what was drawn, the runs behind it, claims, files."""

import csv
import dataclasses
import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PIL import Image

from analysis import explain
from analysis.command_line import ROOT
from analysis.edition import OVERRIDDEN, Edition
from analysis.report_runs import RunFacts, read_json, read_runs
from analysis.runs import MissingData, check_edition, check_figure

LEDGER = ROOT / "docs" / "hyperparameters.csv"
OWN_FILES = ("claims", "report")  # Markdown files of a scale's folder that are no tables
STATING = (".pdf", ".svg", ".png", ".tex")  # files that state the runs behind them
THERE = ("finished", "committed")


@dataclass(frozen=True)
class Table:
    """A header and rows of cells; what stands between ** in a cell is bold."""

    header: list[str]
    rows: list[list[str]]

    def numeric(self) -> list[bool]:
        """Per column, whether each cell that is not empty opens with a number, other words only after a space."""
        number = re.compile(r"(\*\*)?[-+]?[\d,]*\.?\d+(e[-+]?\d+)?($|[ *])")
        columns = [[row[i] for row in self.rows if i < len(row) and row[i]] for i in range(len(self.header))]
        return [bool(cells) and all(number.match(cell) for cell in cells) for cells in columns]


@dataclass(frozen=True)
class Artefact:
    """One figure or table that was drawn."""

    name: str
    title: str
    picture: Path | None
    size: tuple[int, int]  # of the picture, in pixels
    narrow: Path | None  # the same with its panels below each other, for a phone
    narrow_size: tuple[int, int]
    caption: list[str]
    table: Table | None
    files: list[str]  # what lies beside the page
    claims: list[str]
    notes: list[str]
    behind: set[str]  # ids of the runs that the files themselves state
    planned: set[str]
    absent: list[str]  # planned runs that are not there, in words


@dataclass(frozen=True)
class Report:
    """Everything on the page."""

    edition: Edition
    artefacts: list[Artefact]
    not_drawn: list[str]
    runs: list[RunFacts]
    origin: Table  # per figure or table: runs committed, trained here, not there
    committed_files: Table
    claims: Table | None
    claims_notes: list[str]
    ledger: Table
    frames: list[Path]

    @property
    def seconds(self) -> float:
        """Core-seconds spent on the runs whose clocks are here."""
        return sum(run.seconds for run in self.runs if run.seconds is not None)

    @property
    def states(self) -> dict[str, int]:
        """Number of runs per state, most first."""
        return dict(Counter(run.state for run in self.runs).most_common())

    @property
    def verdicts(self) -> dict[str, int]:
        """Number of claims per verdict, most first."""
        if self.claims is None:
            return {}
        place = self.claims.header.index("verdict")
        return dict(Counter(row[place] for row in self.claims.rows).most_common())

    @property
    def videos(self) -> list[tuple[RunFacts, Path]]:
        """Every video of a run."""
        return [(run, path) for run in self.runs for path in run.videos]


def natural(name: str) -> tuple[bool, str, int, str]:
    """Sorting key: fig2 before fig10, figures before tables, both before anything else."""
    found = re.fullmatch(r"(fig|table)(\d+)", name)
    return (False, found[1], int(found[2]), "") if found else (True, "", 0, name)


def markdown_table(text: str) -> Table | None:
    r"""The first Markdown table in `text`, None where there is none; \| within a cell is a pipe.

    Raises:
        ValueError: a row has not as many cells as the header.
    """
    lines = [line.strip() for line in text.splitlines() if line.startswith("|")]
    if not lines:
        return None
    cut = [re.split(r"(?<!\\)\|", line.removeprefix("|").removesuffix("|")) for line in lines]
    header, _, *rows = [[cell.strip().replace(r"\|", "|") for cell in row] for row in cut]
    if any(len(row) != len(header) for row in rows):
        raise ValueError(f"a table of {len(header)} columns ({', '.join(header)}) has a row of another length")
    return Table(header, rows)


def read_plans(plans_dir: Path, edition: Edition) -> dict[str, dict[str, Any]]:
    """Plans of one edition, by figure.

    Raises:
        ValueError: one lacks what a plan has, or is of another edition.
    """
    plans = {}
    for path in sorted((plans_dir / edition.folder).glob("*.json"), key=lambda path: natural(path.stem)):
        plan = read_json(path)
        missing = {"figure", "scale", "title", "runs"} - set(plan)
        if missing:
            raise ValueError(f"{path}: is no plan, it lacks {', '.join(sorted(missing))}")
        check_edition(path, plan, edition)
        check_figure(path, plan)
        plans[path.stem] = plan
    return plans


def absent(plan: dict[str, Any], states: dict[str, str]) -> list[str]:
    """Planned runs that are not there: a line per environment, seeds and state, with the methods."""
    seeds: dict[tuple[str, str, str], list[str]] = {}
    methods: dict[str, set[str]] = {}  # planned in an environment
    for run in plan["runs"]:
        env, label = str(run.get("env_label", "")), str(run.get("variant_label", ""))
        methods.setdefault(env, set()).add(label)
        if (state := states[str(run["run_id"])]) not in THERE:
            seeds.setdefault((env, label, state), []).append(str(run.get("seed", "")))
    alike: dict[tuple[str, str], list[str]] = {}
    for (env, label, state), which in seeds.items():
        alike.setdefault((env, f"seed {', '.join(which)}: {state}"), []).append(label)
    return [
        f"{env}, {'every method' if len(labels) == len(methods[env]) > 1 else '; '.join(labels)}, {what}"
        for (env, what), labels in alike.items()
    ]


def read_artefact(name: str, folder: Path, plan: dict[str, Any] | None, states: dict[str, str]) -> Artefact:
    """What lies in `folder` of one figure or table.

    Raises:
        ValueError: its picture is none, or its table has rows of different lengths.
    """
    picture, narrow, caption, table = (
        folder / f"{name}{suffix}" for suffix in (".png", ".narrow.png", ".caption.txt", ".md")
    )
    files = sorted(path for path in folder.glob(f"{name}.*") if path.suffix in (*STATING, ".csv", ".md"))
    title, lines, cells = name, [], None
    if table.exists():
        text = table.read_text()
        try:
            cells = markdown_table(text)
        except ValueError as error:
            raise ValueError(f"{table}: {error}") from error
        lines = [line for line in text.splitlines() if line and not line.startswith("|")]
        title = lines[0].split(". ")[0] if lines else name
    size, named = read_picture(picture)
    title = named.removeprefix(f"{name}: ") or title
    if caption.exists():
        lines = [line for line in caption.read_text().splitlines() if line]
    plan = plan or {"title": title, "runs": []}
    behind: set[str] = set()
    for path in files:
        if path.suffix in STATING:
            try:
                behind |= set(explain.run_ids(path))
            except ValueError:  # a figure that nothing was trained for states no runs, which is not an error here
                continue
    return Artefact(
        name=name,
        title=str(plan["title"]),
        picture=picture if picture.exists() else None,
        size=size,
        narrow=narrow if narrow.exists() else None,
        narrow_size=read_picture(narrow)[0],
        caption=lines,
        table=cells,
        files=[path.name for path in files],
        claims=[str(claim) for claim in plan.get("claims", [])],
        notes=[str(note) for note in plan.get("notes", [])],
        behind=behind,
        planned={str(run["run_id"]) for run in plan["runs"]},
        absent=absent(plan, states),
    )


def read_picture(path: Path) -> tuple[tuple[int, int], str]:
    """Size in pixels and title, both empty without the file.

    Raises:
        ValueError: it is no picture.
    """
    if not path.exists():
        return (0, 0), ""
    try:
        with Image.open(path) as image:
            return image.size, str(image.info.get("Title", ""))
    except OSError as error:
        raise ValueError(f"{path}: is no picture ({error}); draw it again") from error


def drawn_names(folder: Path) -> list[str]:
    """Figures and tables in a scale's folder, in the paper's order."""
    names = {path.name.partition(".")[0] for path in (*folder.glob("*.png"), *folder.glob("*.md"))} - set(OWN_FILES)
    return sorted(names, key=natural)


def not_drawn(
    edition: Edition, drawn: Iterable[str], plans: dict[str, dict[str, Any]], states: dict[str, str]
) -> list[str]:
    """A line per figure and table of the suite, or of a plan, that is not on the page, and what to type for it."""
    scripts = (ROOT / "paper_figures").glob("*.py")
    suite = {path.stem for path in scripts if re.fullmatch(r"(fig|table)\d+", path.stem)}
    lines = []
    for name in sorted((suite | set(plans)) - set(drawn), key=natural):
        if name in plans and not plans[name]["runs"]:
            elsewhere = [dataclasses.replace(edition, scale=scale) for scale in plans[name].get("scales", [])]
            others = " or ".join(f"make {name} {each.variables}" for each in elsewhere)
            lines.append(f"{name}: not trained at {edition}" + (f"; {others}" if others else ""))
        elif name in plans and not any(drawable(run, states) for run in plans[name]["runs"]):
            lines.append(f"{name}: nothing to draw yet; make {name} {edition.variables} trains it")
        else:
            lines.append(f"{name}: not drawn; make draw-{name} {edition.variables}")
    return lines


def drawable(run: dict[str, Any], states: dict[str, str]) -> bool:
    """Whether a planned run can be drawn: its figure's own rows are committed, or its folder is finished."""
    return run.get("state") == "committed" or states[str(run["run_id"])] == "finished"


def origin(plans: dict[str, dict[str, Any]], states: dict[str, str]) -> Table:
    """Per figure or table, how many of its runs are committed, trained here, or not there."""
    rows = []
    for name, plan in plans.items():
        found = [states[run_id] for run_id in {str(run["run_id"]) for run in plan["runs"]}]
        counts = [len(found), found.count("committed"), found.count("finished"), sum(s not in THERE for s in found)]
        rows.append([name, *map(str, counts)])
    return Table(["artefact", "runs", "committed results", "trained here", "not there"], rows)


def committed_files(edition: Edition, data: Path) -> Table:
    """What of paper_figures/data stands behind this edition: results, skills and frames."""
    groups = (("results", data / edition.folder), ("skills", data / "skills"), ("frames", data / "frames"))
    rows = []
    for what, folder in groups:
        if files := sorted(path for path in folder.glob("*") if path.is_file()):
            size = sum(path.stat().st_size for path in files)
            names = ", ".join(path.name for path in files)
            rows.append([what, f"{folder.name}/", str(len(files)), f"{size / 1000:,.0f} kB", names])
    return Table(["what", "folder", "files", "size", "names"], rows)


def read_table_csv(path: Path) -> Table:
    """A csv as a table."""
    with path.open(newline="") as file:
        header, *rows = csv.reader(file)
    return Table(header, rows)


def folders(runs_dir: Path, out: Path) -> list[str]:
    """Folders of the editions without overrides, such as laptop or modern/laptop: what was planned or drawn."""
    plans = {path.parent.relative_to(runs_dir / "plans") for path in (runs_dir / "plans").rglob("*.json")}
    drawn = {path.relative_to(out) for path in out.glob("*") if drawn_names(path)}
    return sorted(str(folder) for folder in plans | drawn if folder.name != OVERRIDDEN)


def gather(edition: Edition, runs_dir: Path, data: Path, out: Path) -> Report:
    """Everything there is of one edition.

    Raises:
        MissingData: nothing was drawn and nothing planned.
        ValueError: a file is damaged; the message names it.
    """
    folder = out / edition.folder
    plans, names = read_plans(runs_dir / "plans", edition), drawn_names(folder)
    if not plans and not names:
        known = ", ".join(folders(runs_dir, out)) or "none"
        raise MissingData(
            f"{edition}: nothing was drawn or planned (there is something in: {known}); "
            f"run `make draw-all {edition.variables}`"
        )
    runs = read_runs(plans, runs_dir)
    states = {run.run_id: run.state for run in runs}
    claims = folder / "claims.md"
    text = claims.read_text() if claims.exists() else ""
    return Report(
        edition=edition,
        artefacts=[read_artefact(name, folder, plans.get(name), states) for name in names],
        not_drawn=not_drawn(edition, names, plans, states),
        runs=runs,
        origin=origin(plans, states),
        committed_files=committed_files(edition, data),
        claims=markdown_table(text),
        claims_notes=[line for line in text.splitlines() if line and not line.startswith("|")],
        ledger=read_table_csv(LEDGER),
        frames=sorted((data / "frames").glob("*.png")),
    )
