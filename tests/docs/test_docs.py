"""The documentation: every link, picture, target and module that it names is there."""

import importlib.util
import re
import subprocess

import pytest
import yaml

from tests import ROOT

PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")),
    *sorted((ROOT / "docs").rglob("*.md")),
]
MAKEFILE = (ROOT / "Makefile").read_text()
ids = [str(page.relative_to(ROOT)) for page in PAGES]


def links(text):
    """Targets of Markdown links and pictures that are no web addresses, without their fragments."""
    found = re.findall(r"\]\(([^)\s]+)\)", text)
    return [target.partition("#")[0] for target in found if not re.match(r"[a-z]+:", target) and target[0] != "#"]


def targets():
    """Names of the Makefile's targets, patterns expanded."""
    names = set(re.findall(r"^([a-z%-]+):", MAKEFILE, re.MULTILINE))
    return names | {path.stem for path in (ROOT / "paper_figures").glob("*.py")}


@pytest.mark.parametrize("page", PAGES, ids=ids)
def test_every_link_and_picture_is_there(page):
    missing = [target for target in links(page.read_text()) if not (page.parent / target).exists()]
    assert not missing


@pytest.mark.parametrize("page", PAGES, ids=ids)
def test_every_make_target_and_module_that_is_named_exists(page):
    text = page.read_text()
    named = set(re.findall(r"(?:^|`|    )make ([a-z][a-z0-9N-]*)", text.replace("figN", "fig3"), re.MULTILINE))
    known = targets()
    assert not {name for name in named if name not in known and name.partition("-")[0] not in ("plan", "draw")}
    modules = {name.rstrip(".") for name in re.findall(r"python -m ([a-z_.0-9]+)", text)}
    made_by_the_page = {name.removesuffix(".py").replace("/", ".") for name in re.findall(r"title=\"(.*?)\"", text)}
    assert not {name for name in modules - made_by_the_page if importlib.util.find_spec(name) is None}


@pytest.mark.parametrize("page", PAGES, ids=ids)
def test_every_file_and_folder_of_tests_that_is_named_exists(page):
    named = re.findall(r"tests/[\w/]+(?:\.\w+)?", page.read_text())
    assert not [name for name in named if not (ROOT / name).exists()]


def test_tests_are_run_by_the_group_and_a_wrong_one_is_one_line_that_names_the_choices():
    right = subprocess.run(
        ["make", "--no-print-directory", "--dry-run", "test", "ONLY=envs docs"],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert right.stdout.rstrip().endswith("tests/envs tests/docs")
    wrong = subprocess.run(
        ["make", "--no-print-directory", "test", "ONLY=env"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert wrong.returncode == 2
    (line,) = wrong.stderr.splitlines()
    assert "ONLY=env is no group" in line
    assert all(
        f" {group}" in line for group in ("analysis", "baselines", "docs", "envs", "experiments", "figures", "hippo")
    )


def test_every_commit_of_the_changelog_is_one_of_ours():
    named = re.findall(r"`([0-9a-f]{7})`", (ROOT / "CHANGELOG.md").read_text())
    assert len(named) > 5
    command = ["git", "cat-file", "-e"]
    if subprocess.run([*command, "HEAD~20"], cwd=ROOT, capture_output=True, check=False).returncode:
        pytest.skip("no history here")
    assert not [name for name in named if subprocess.run([*command, name], cwd=ROOT, check=False).returncode]


def test_issues_about_numbers_are_asked_for_run_manifest_and_cpu():
    text = (ROOT / ".github/ISSUE_TEMPLATE/number.md").read_text()
    assert all(word in text for word in ("run_id", "manifest.json", "CPU"))


def test_what_is_checked_before_a_commit_is_what_make_lint_checks():
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"][0]["hooks"]
    tools = {hook["entry"].split()[0] for hook in hooks} - {"sh"}
    assert tools == {
        tool.replace("$(BIN)", ".venv/bin") for tool in re.findall(r"^\t(\$\(BIN\)/(?:ruff|mypy))", MAKEFILE, re.M)
    }


def test_the_readme_activates_the_environment_before_the_first_python_command():
    text = (ROOT / "README.md").read_text()
    assert 0 < text.index(". .venv/bin/activate") < text.index("python -m")


def test_a_broken_link_would_be_found():
    assert links("[a](there.md#x) ![b](pictures/b.png) [c](https://example.org) [d](#here)") == [
        "there.md",
        "pictures/b.png",
    ]


def test_every_page_is_reached_from_the_readme():
    seen, todo = set(), [ROOT / "README.md"]
    while todo:
        page = todo.pop()
        if page in seen or page.suffix != ".md" or not page.exists():
            continue
        seen.add(page)
        for target in links(page.read_text()):
            place = (page.parent / target).resolve()
            todo += sorted(place.glob("*.md")) if place.is_dir() else [place]
    assert not [str(page.relative_to(ROOT)) for page in PAGES if page not in seen]


def test_every_test_that_the_page_on_failures_names_exists():
    named = re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", (ROOT / "docs/failures.md").read_text())
    assert len(named) > 20
    missing = [name for path, name in named if f"def {name}(" not in (ROOT / path).read_text()]
    assert not missing


def test_findings_quote_numbers_that_other_pages_have():
    def decimals(text):
        return set(re.findall(r"(?<![\w.])\d+\.\d+", text))

    docs = ROOT / "docs"
    pages = ["results.md", "reproduce.md", "modern.md", "environments/calibration.md", *docs.glob("studies/*.md")]
    there = set().union(*(decimals((docs / page).read_text()) for page in pages))
    there |= {f"{float(number):.{digits}f}" for number in there for digits in range(1, len(number.split(".")[1]))}
    sections = re.split(r"^## ", (docs / "findings.md").read_text(), flags=re.MULTILINE)
    quoted = {title: decimals(text) - there for title, text in (s.split("\n", 1) for s in sections if "(Figure 3" in s)}
    assert len(quoted) == 2
    assert not any(quoted.values()), quoted
