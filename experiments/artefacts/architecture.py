"""The rooms of the code and what may import what: the table that a test holds the imports to, and docs/architecture.md.

python -m experiments.artefacts.architecture    # renews the page's tables and docs/pictures/architecture.svg
"""

import ast
import functools
import html
import re
from dataclasses import dataclass
from pathlib import Path

from experiments.choices import ROOT
from experiments.command_line import run_command
from experiments.status import write_atomically

PAGE = ROOT / "docs" / "architecture.md"
PICTURE = ROOT / "docs" / "pictures" / "architecture.svg"
MARK = re.compile(r"(<!-- table: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)
CODE = ("hippo", "baselines", "experiments", "analysis", "paper_figures")
HYDRA = ("hydra", "omegaconf")
ABOVE = ("experiments", "analysis", "paper_figures")


@dataclass(frozen=True)
class Room:
    """Files of one purpose."""

    places: tuple[str, ...]  # folders and files; a file belongs to the room that names it most closely
    says: str  # what is in it
    column: float  # where it stands in the picture, from 0 (left) to 3 (right)
    never: tuple[str, ...]  # modules that none of its files imports, nor anything within them


ROOMS = {
    "hippo.envs": Room(
        ("hippo/envs",),
        "robots and tasks",
        0,
        ("torch", "hippo.core", "hippo.hippo", "hippo.agent", "baselines", *ABOVE, *HYDRA),
    ),
    "hippo.core": Room(
        ("hippo/core",),
        "mathematics that learners share",
        1.5,
        ("mujoco", "hippo.envs", "hippo.hippo", "hippo.agent", "baselines", *ABOVE, *HYDRA),
    ),
    "the method": Room(
        ("hippo/hippo.py", "hippo/gradients.py"),
        "Algorithm 2; Lemma 1",
        1,
        ("mujoco", "hippo.envs", "hippo.agent", "baselines", *ABOVE, *HYDRA),
    ),
    "baselines": Room(
        ("baselines",),
        "the other learners",
        2,
        ("mujoco", "hippo.envs", "hippo.hippo", "hippo.agent", "baselines", *ABOVE, *HYDRA),
    ),
    "hippo": Room(("hippo",), "as a library: load, act, train", 0.5, (*ABOVE, *HYDRA)),
    "analysis": Room(
        ("analysis",),
        "from runs to numbers",
        3,
        ("torch", "mujoco", "hippo", "baselines", "experiments", "paper_figures"),
    ),
    "paper_figures": Room(
        ("paper_figures",), "from numbers to pictures", 3, ("torch", "mujoco", "hippo", "baselines", "experiments")
    ),
    "experiments": Room(
        ("experiments",),
        "from a configuration to runs",
        1.5,
        ("experiments.bench", "experiments.artefacts", "analysis", "paper_figures"),
    ),
    "experiments.bench": Room(
        ("experiments/bench",), "how fast it is", 1.5, ("experiments.artefacts", "analysis", "paper_figures")
    ),
    "experiments.artefacts": Room(
        ("experiments/artefacts",), "committed pages, rows, pictures", 1.5, ("analysis", "paper_figures")
    ),
}
# What a file may import nevertheless, and why.
EXCEPTIONS: dict[str, tuple[tuple[str, ...], str]] = {
    "baselines/option_critic.py": (
        ("baselines.option_critic_config", "baselines.option_critic_advantages", "baselines.ppoc"),
        "its own parts",
    ),
    "baselines/option_critic_advantages.py": (("baselines.option_critic_config",), "the same learner"),
    "baselines/ppoc.py": (
        ("baselines.option_critic_config", "baselines.option_critic_advantages"),
        "the same learner as it was published",
    ),
    "baselines/hiro.py": (
        ("baselines.hiro_config", "baselines.hiro_levels", "baselines.hiro_cloning"),
        "its own parts",
    ),
    "baselines/hiro_levels.py": (("baselines.hiro_config",), "the same learner"),
    "baselines/hiro_cloning.py": (("baselines.hiro_config", "baselines.hiro_levels"), "the same learner"),
    "paper_figures/fig2.py": (("hippo.envs",), "the picture of the environments renders them"),
    "analysis/runs.py": (("hippo.core.files", "hippo.core.results"), "what a run's file must hold is said once"),
    "analysis/explain.py": (("hippo.core.files",), "the same"),
    "experiments/plan.py": (("analysis.edition",), "where plans lie is agreed on once"),
    "experiments/own_sweep.py": (("analysis.edition",), "the same"),
    "experiments/own_compare.py": (("analysis.runs", "paper_figures"), "a sweep of one's own is drawn by its name"),
    "experiments/commit.py": (("analysis",), "from run folders to committed rows"),
    "experiments/study.py": (("analysis", "paper_figures"), "from a file of runs to their page"),
}
BY_NAME = {("hippo", "the method"), ("hippo", "baselines")}  # hippo.learners imports what it is asked for


def imported(path: Path) -> set[str]:
    """Every module name that `path` imports, anywhere in it."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative imports hide where a name comes from"
            names |= {node.module or ""} | {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def within(name: str, modules: tuple[str, ...]) -> bool:
    """Whether `name` is one of the modules, or in one."""
    return any(name == module or name.startswith(module + ".") for module in modules)


def room_of(file: str) -> str:
    """The room of a file or a folder, by the place that names it most closely; `file` is relative to the root."""
    names = {place: room for room in ROOMS for place in ROOMS[room].places}
    return names[max((place for place in names if f"{file}/".startswith(f"{place}/")), key=len)]


@functools.cache
def files() -> dict[str, list[str]]:
    """The code of every room, relative to the root."""
    found: dict[str, list[str]] = {room: [] for room in ROOMS}
    for path in sorted(path for folder in CODE for path in (ROOT / folder).rglob("*.py")):
        found[room_of(str(path.relative_to(ROOT)))].append(str(path.relative_to(ROOT)))
    return found


def wrong_imports(room: str) -> list[str]:
    """What files of a room import and must not."""
    return [
        f"{file} imports {name}"
        for file in files()[room]
        for name in sorted(imported(ROOT / file))
        if within(name, ROOMS[room].never) and not within(name, EXCEPTIONS.get(file, ((), ""))[0])
    ]


@functools.cache
def arrows() -> dict[tuple[str, str], bool]:
    """Which room imports which, and whether more than the exceptions do so."""
    modules = {file.removesuffix(".py").replace("/", "."): room for room in ROOMS for file in files()[room]}
    found = dict.fromkeys(BY_NAME, True)
    for room in ROOMS:
        for file in files()[room]:
            excepted = EXCEPTIONS.get(file, ((), ""))[0]
            for name in imported(ROOT / file):
                other = modules.get(name) or modules.get(f"{name}.__init__")
                if other is not None and other != room:
                    found[room, other] = found.get((room, other), False) or not within(name, excepted)
    return found


def floor(room: str, above: tuple[str, ...] = ()) -> int:
    """One above the highest room that it imports; 0 for one that imports none.

    Raises:
        ValueError: rooms import each other in a circle.
    """
    if room in above:
        raise ValueError(f"a circle of imports: {' -> '.join([*above[above.index(room) :], room])}")
    return max((floor(other, (*above, room)) + 1 for one, other in arrows() if one == room), default=0)


def drawn() -> list[tuple[str, str]]:
    """The arrows that no longer way implies."""

    def reaches(one: str, other: str) -> bool:
        return (one, other) in arrows() or any(reaches(b, other) for a, b in arrows() if a == one)

    return sorted(
        (one, other) for one, other in arrows() if not any(reaches(b, other) for a, b in arrows() if a == one)
    )


WIDE, HIGH, ACROSS, UP = 220, 46, 240, 84  # of a room, and from one to the next, in px


def corner(room: str) -> tuple[float, float]:
    """The upper left corner of a room in the picture."""
    top = max(floor(each) for each in ROOMS)
    return 10 + ROOMS[room].column * ACROSS, 10 + (top - floor(room)) * UP


def picture() -> str:
    """The floors as SVG: text alone, so that every machine writes the same bytes."""
    width, height = 3 * ACROSS + WIDE + 20, max(floor(room) for room in ROOMS) * UP + HIGH + 20
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" font-family="sans-serif">',
        '<defs><marker id="tip" viewBox="0 0 8 8" refX="8" refY="4" markerWidth="7" markerHeight="7" orient="auto">'
        '<path d="M0 0 8 4 0 8z" fill="#444"/></marker></defs>',
        f'<rect width="{width}" height="{height}" fill="white"/>',
    ]
    for one, other in drawn():
        (x, y), (to_x, to_y) = corner(one), corner(other)
        dashes = "" if arrows()[one, other] else ' stroke-dasharray="5 4"'
        lines.append(
            f'<line x1="{x + WIDE / 2:g}" y1="{y + HIGH:g}" x2="{to_x + WIDE / 2:g}" y2="{to_y:g}" stroke="#444"'
            f'{dashes} marker-end="url(#tip)"/>'
        )
    for name, room in ROOMS.items():
        x, y = corner(name)
        middle = f'x="{x + WIDE / 2:g}" text-anchor="middle"'
        lines += [
            f'<rect x="{x:g}" y="{y:g}" width="{WIDE}" height="{HIGH}" rx="5" fill="#eef3f8" stroke="#444"/>',
            f'<text {middle} y="{y + 19:g}" font-size="14" font-weight="bold">{html.escape(name)}</text>',
            f'<text {middle} y="{y + 36:g}" font-size="12">{html.escape(room.says)}</text>',
        ]
    return "\n".join([*lines, "</svg>"]) + "\n"


def rooms_table() -> str:
    """A row per room, the top floor first."""
    lines = ["| floor | room | what is there | never imports |", "|---|---|---|---|"]
    for name in sorted(ROOMS, key=floor, reverse=True):
        places = ", ".join(f"`{place}`" for place in ROOMS[name].places)
        never = ", ".join(f"`{module}`" for module in ROOMS[name].never)
        lines.append(f"| {floor(name)} | {places} | {ROOMS[name].says} | {never} |")
    return "\n".join(lines)


def exceptions_table() -> str:
    """A row per file that may import more."""
    lines = ["| file | may import | because |", "|---|---|---|"]
    for file, (modules, why) in EXCEPTIONS.items():
        lines.append(f"| `{file}` | {', '.join(f'`{module}`' for module in modules)} | {why} |")
    return "\n".join(lines)


def renewed() -> str:
    """The page with its tables as they are now."""
    tables = {"rooms": rooms_table, "exceptions": exceptions_table}
    return MARK.sub(lambda m: f"{m[1]}{tables[m[2]]()}\n{m[3]}", PAGE.read_text())


def main() -> int:
    """Renew the page and its picture."""
    for path, text in ((PAGE, renewed()), (PICTURE, picture())):
        write_atomically(path, text)
        print(f"wrote {path}")
    return 0


if __name__ == "__main__":
    run_command(main)
