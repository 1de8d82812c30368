"""The import table of the architecture: which package may never import which (walks the syntax trees)."""

import ast
from pathlib import Path

import pytest

from tests import ROOT

FORBIDDEN = {
    "hippo/envs": ("torch", "hippo.core", "hippo.hippo", "baselines", "experiments", "analysis", "hydra"),
    "hippo/core": ("mujoco", "hippo.envs", "hippo.hippo", "baselines", "experiments", "analysis", "hydra", "omegaconf"),
    "hippo/hippo.py": ("hippo.envs", "baselines", "experiments", "hydra", "omegaconf", "mujoco"),
    "hippo/gradients.py": ("hippo.envs", "baselines", "experiments", "hydra", "omegaconf", "mujoco"),
    "baselines": ("hippo.hippo", "hippo.envs", "baselines", "experiments", "hydra", "omegaconf", "mujoco"),
    "experiments": ("analysis", "paper_figures"),
    "analysis": ("torch", "mujoco", "hippo", "baselines", "experiments", "paper_figures"),
    "paper_figures": ("torch", "mujoco", "hippo", "baselines", "experiments"),
}
ALLOWED = {
    "paper_figures/fig2.py": ("hippo.envs",),  # the picture of the environments renders them
    # What a file must hold, and whether it still does, is said once; neither knows torch.
    "analysis/runs.py": ("hippo.core.files", "hippo.core.results"),
    "analysis/explain.py": ("hippo.core.files",),
    "experiments/plan.py": ("analysis.edition",),  # where plans lie is agreed on once
    "experiments/own_sweep.py": ("analysis.edition",),
    "experiments/own_compare.py": ("analysis.runs", "paper_figures"),  # a sweep of one's own is drawn by its name
    "experiments/commit.py": ("analysis",),  # from run folders to committed rows
    "experiments/study.py": ("analysis", "paper_figures"),  # from a file of runs to their page
}


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


def within(name: str, packages: tuple[str, ...]) -> bool:
    return any(name == package or name.startswith(package + ".") for package in packages)


@pytest.mark.parametrize("place", FORBIDDEN)
def test_no_package_imports_what_it_must_not(place):
    target = ROOT / place
    files = [target] if target.suffix == ".py" else sorted(target.rglob("*.py"))
    for path in files:
        allowed = ALLOWED.get(str(path.relative_to(ROOT)), ())
        wrong = {n for n in imported(path) if within(n, FORBIDDEN[place]) and not within(n, allowed)}
        assert not wrong, f"{path.relative_to(ROOT)} imports {sorted(wrong)}"


def test_the_walk_sees_imports_inside_functions_and_of_submodules(tmp_path):
    (tmp_path / "m.py").write_text("def f():\n    from hippo import hippo\n    import torch.nn\n")
    found = imported(tmp_path / "m.py")
    assert within("torch.nn", FORBIDDEN["analysis"])
    assert any(within(name, FORBIDDEN["baselines"]) for name in found)
