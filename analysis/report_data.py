"""What the report says of one scale, gathered from files alone: what was drawn, the runs behind it, claims, files."""

import csv
import dataclasses
import json
import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from PIL import Image

from analysis import explain
from analysis.edition import OVERRIDDEN, Edition
from analysis.runs import MissingData, check_edition, check_figure, code_of, stretches

ROOT = Path(__file__).parent.parent
LEDGER = ROOT / "docs" / "hyperparameters.csv"
OWN_FILES = ("claims", "report")  # Markdown files of a scale's folder that are no tables
VIDEOS = {".mp4": "video/mp4", ".gif": "image/gif"}
STATING = (".pdf", ".svg", ".png", ".tex")  # files that state the runs behind them
THERE = ("finished", "committed")
NOT_HERE = "not trained here"  # a run that others start from; committed skills may stand in for it


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


@dataclass
class RunFacts:
    """One run of this scale: what it is, how it is doing, where it came from, what it cost."""

    run_id: str
    algo: str = ""
    env: str = ""
    labels: list[str] = field(default_factory=list)  # what figures call it
    seed: str = ""
    physics: str = ""
    state: str = "missing"
    used_in: list[str] = field(default_factory=list)
    commit: str = ""
    dirty: bool | None = None  # None: no manifest here
    code: list[str] = field(default_factory=list)  # `code_of` each stretch of a run that was interrupted
    lock: str = ""
    cpu: str = ""
    seconds: float | None = None  # core-seconds, a run has one thread; None: it has no clocks here
    videos: list[Path] = field(default_factory=list)


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


def read_json(path: Path) -> dict[str, Any]:
    """An object in JSON.

    Raises:
        ValueError: it is none, with the file's name.
    """
    try:
        content = json.loads(path.read_text())
    except ValueError as error:
        raise ValueError(f"{path}: is no JSON ({error})") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path}: must hold a JSON object")
    return content


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


def core_seconds(path: Path) -> float | None:
    """Sum of timing.csv's seconds, None without the file; a last line torn by a kill does not count."""
    if not path.exists():
        return None
    text = path.read_text()
    return sum(float(row["seconds"]) for row in csv.DictReader(text[: text.rfind("\n") + 1].splitlines()))


def is_own(path: Path) -> bool:
    """Whether a file lies in its folder itself: what a link leads to is not read."""
    return path.is_file() and not path.is_symlink()


def read_folder(facts: RunFacts, runs_dir: Path) -> None:
    """Add what the run's folder says; without a folder nothing is added."""
    folder = runs_dir / facts.run_id
    if folder.name != facts.run_id or not folder.is_dir():  # an id with a slash in it is no folder of runs_dir
        return
    if facts.state != "committed" and (folder / "status.json").exists():
        facts.state = str(read_json(folder / "status.json").get("state", "unknown"))
    if (folder / "manifest.json").exists():
        content = read_json(folder / "manifest.json")
        identity = content.get("identity", {})
        facts.algo = str(identity.get("algo", ""))
        facts.env, facts.seed = facts.env or str(identity.get("env", "")), facts.seed or str(identity.get("seed", ""))
        facts.commit, facts.lock = str(content.get("git_commit") or ""), str(content.get("lock") or "")
        facts.dirty, facts.cpu = bool(content.get("git_difference")), str(content.get("cpu") or "")
        facts.code = list(dict.fromkeys(map(code_of, stretches(content))))
    facts.seconds = core_seconds(folder / "timing.csv")
    facts.videos = sorted(path for path in folder.iterdir() if path.suffix in VIDEOS and is_own(path))


def read_runs(plans: dict[str, dict[str, Any]], runs_dir: Path) -> list[RunFacts]:
    """Each planned run once, in the plans' order, with the runs whose skills or policies it starts from before it."""
    runs: dict[str, RunFacts] = {}
    for figure, plan in plans.items():
        for planned in plan["runs"]:
            for ancestor in planned.get("ancestors", []):
                facts = runs.setdefault(str(ancestor), RunFacts(str(ancestor), state=NOT_HERE))
                facts.used_in += [figure] if figure not in facts.used_in else []
            facts = runs.setdefault(str(planned["run_id"]), RunFacts(str(planned["run_id"])))
            label = str(planned.get("variant_label", ""))
            facts.labels += [label] if label not in facts.labels else []
            facts.used_in += [figure] if figure not in facts.used_in else []
            facts.env, facts.seed = str(planned.get("env_label", "")), str(planned.get("seed", ""))
            facts.physics = str(planned.get("physics", ""))
            # A run that one figure takes from the committed rows may be trained for another.
            facts.state = facts.state if facts.state == "committed" else str(planned.get("state", "missing"))
    for facts in runs.values():
        read_folder(facts, runs_dir)
    return list(runs.values())


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
