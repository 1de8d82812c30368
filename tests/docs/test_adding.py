"""docs/adding.md, done: its blocks are put into a copy of the project and its commands are run there."""

import os
import shlex
import shutil
import subprocess
import sys

import pytest

from tests.docs.pages import ROOT, blocks

pytestmark = pytest.mark.timeout(600)  # the page trains nine runs, and the machine may be busy
COPIED = (
    "analysis",
    "baselines",
    "experiments",
    "hippo",
    "paper_figures",
    "docs",
    "tests",
    "requirements.lock",
    "pyproject.toml",
)


def insert(text, block, name):
    """`text` with the + lines of `block` after the line above them, which must be there once; a - line goes."""
    first, *added = block.splitlines()
    line = first[1:]
    assert text.splitlines().count(line) == 1, f"{name}: not there once: {line}"
    kept = [] if first.startswith("-") else [line]
    new = "\n".join([*kept, *(a.removeprefix("+") for a in added)])
    return text.replace(f"{line}\n", f"{new}\n", 1)


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    """A copy of the project after everything that the page says; commands ran and their output is in said.txt."""
    root = tmp_path_factory.mktemp("copy")
    for name in COPIED:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, root / name, ignore=shutil.ignore_patterns("out"))  # with what numba has compiled
        else:
            shutil.copy(source, root / name)
    environment = os.environ | {"PYTHONPATH": str(root), "XDG_CACHE_HOME": str(root / "cache")}
    said = ""
    for kind, title, block in blocks("adding.md"):
        if kind == "sh":
            for line in block.splitlines():
                python, *rest = shlex.split(line)
                assert python == "python"
                done = subprocess.run(
                    [sys.executable, *rest], cwd=root, env=environment, capture_output=True, text=True, timeout=200
                )
                assert done.returncode == 0, f"{line}\n{done.stdout}\n{done.stderr}"
                said += done.stdout
        elif kind == "diff":
            path = root / title
            path.write_text(insert(path.read_text(), block, title))
        else:
            assert not (root / title).exists()
            (root / title).write_text(block)
    return root, said


def test_every_block_was_used_and_every_command_ran(project):
    root, said = project
    for title in ("baselines/random_search.py", "hippo/envs/forward.py", "paper_figures/fig10.py"):
        assert (root / title).exists()
    assert "random_search hopper_forward seed 0  iteration 4/4" in said
    assert "| `noise` | 0.03 |" in (root / "docs/hyperparameters.md").read_text()


def test_the_figure_is_drawn_from_all_its_runs(project):
    root, _ = project
    caption = (root / "paper_figures/out/smoke/fig10.caption.txt").read_text()
    assert "Random search, larger steps" in caption
    assert "Missing" not in caption
    assert (root / "paper_figures/out/smoke/fig10.png").stat().st_size > 1000


def test_the_code_on_the_page_is_as_clean_as_the_projects(project):
    root, _ = project
    files = [
        "baselines/random_search.py",
        "hippo/envs/forward.py",
        "paper_figures/fig10.py",
        "hippo/envs/registration.py",
    ]
    for check in (["format", "--check"], ["check"]):
        command = [sys.executable, "-m", "ruff", *check, *files]
        done = subprocess.run(command, cwd=root, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout


def test_of_a_changed_equation_4_the_tests_notice_that_the_page_names(project):
    root, said = project
    named = ["tests/hippo/test_hierarchy.py", "tests/hippo/test_golden.py"]
    only = "levels_hold or (stored_ones and (hier_vpg or option_critic) and not modern)"
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *named, "-k", only]
    environment = {key: text for key, text in os.environ.items() if not key.startswith("PYTEST")}
    done = subprocess.run(
        command, cwd=root, env=environment | {"PYTHONPATH": str(root)}, capture_output=True, text=True
    )
    noticed = {line.split("::")[1].split(" ")[0] for line in done.stdout.splitlines() if line.startswith("FAILED")}
    assert noticed == {
        "test_levels_hold_what_was_done_and_how_likely_it_was",
        "test_a_learners_numbers_are_the_stored_ones_of_its_revision[hier_vpg]",
    }, done.stdout
    assert "passed" in done.stdout
    states = [line.split()[2:5] for line in said.splitlines() if "0/120" in line]
    assert {state for variant, _, state in states if variant.startswith("hippo")} == {"missing"}
    assert {state for variant, _, state in states if variant.startswith("ppo")} == {"committed"}
