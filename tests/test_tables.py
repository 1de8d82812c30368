"""Tables: numbers worked by hand, and LaTeX that compiles."""

import shutil
import subprocess

import pandas as pd
import pytest

from analysis.runs import Results
from paper_figures import table1, table3, tabular

RUNS = [
    {"env": env, "variant": variant, "env_label": env, "variant_label": f"label_{variant}"}
    for env in ("snake_gather", "ant_gather")
    for variant in ("ppo", "hippo_random")
]
RETURNS = {  # original, mass: per seed, a list of episodes
    ("snake_gather", "ppo"): ([[1.0, 3.0], [4.0, 4.0]], [[2.0, 2.0], [1.0, 1.0]]),
    ("snake_gather", "hippo_random"): ([[2.0, 2.0], [2.0, 2.0]], [[2.0, 2.0], [2.0, 2.0]]),
    ("ant_gather", "ppo"): ([[-2.0, -2.0], [-2.0, -2.0]], [[-1.0, -1.0], [-1.0, -1.0]]),
    ("ant_gather", "hippo_random"): ([[0.0, 0.0], [0.0, 0.0]], [[1.0, 1.0], [0.0, 0.0]]),
}


@pytest.fixture
def results():
    rows = [
        {"env": env, "variant": variant, "seed": seed, "run_id": f"{variant}{seed}", "metric": metric, "value": value}
        for (env, variant), both in RETURNS.items()
        for metric, seeds in zip(("return:none:original", "return:mass:original"), both, strict=True)
        for seed, episodes in enumerate(seeds)
        for value in episodes
    ]
    return Results({"runs": RUNS, "title": "t"}, pd.DataFrame(rows), [])


def test_table_1_worked_by_hand(results):
    table = {(row["environment"], row["method"]): row for row in table1.rows(results)}
    ppo = table["snake_gather", "label_ppo"]
    # Seeds have means 2 and 4, then 2 and 1: 3 ± 1 becomes 1.5 ± 0.5, half as much.
    assert ppo["original"] == "3.00 ± 1.00"
    assert ppo["mass"] == "1.50 ± 0.50 (-50 %)"
    assert table["snake_gather", "label_hippo_random"]["mass"] == "**2.00 ± 0.00 (+0 %)**"
    assert table["ant_gather", "label_ppo"]["mass"] == "-1.00 ± 0.00 (+50 %)"  # of the absolute value
    assert table["ant_gather", "label_hippo_random"]["mass"] == "**0.50 ± 0.50 (n/a)**"
    assert ppo["paper"].startswith("2.72; mass 3.16 (+16 %)")
    assert ppo["n"] == "2"


def test_what_latex_would_read_as_a_command_is_escaped():
    assert tabular.escaped(r"50 % of a_b & $x$ {y} \z") == r"50 \% of a\_b \& \$x\$ \{y\} \textbackslash{}z"
    assert tabular.escaped("**1.0 ± 2** =") == r"\textbf{1.0 $\pm$ 2} ="


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="pdflatex is not installed")
def test_every_table_compiles_alone(results, tmp_path):
    assert table3.main(["--out", str(tmp_path)]) == 0
    tabular.write(tmp_path / "smoke/table1", "t", "n", table1.rows(results), "runs: a b")
    for name in ("table1", "table3"):
        command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", f"{name}.tex"]
        result = subprocess.run(command, cwd=tmp_path / "smoke", capture_output=True, text=True, check=False)
        assert result.returncode == 0, result.stdout[-2000:]
        assert (tmp_path / f"smoke/{name}.pdf").stat().st_size > 5000
