"""What a report knows of every run: its plan's row and what its folder says."""

import csv
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from analysis.runs import code_of, stretches

VIDEOS = {".mp4": "video/mp4", ".gif": "image/gif"}
NOT_HERE = "not trained here"  # a run that others start from; committed skills may stand in for it


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
