"""Tables: numbers worked by hand, and LaTeX that compiles."""

import re
import shutil
import subprocess

import pandas as pd
import pytest

from analysis.runs import Results
from paper_figures import table1, table2, table3, tabular

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
    # Seeds have means 2 and 4, then 2 and 1: 3 becomes 1.5, half as much; deviations are sqrt(2) and sqrt(1/2), and a
    # resample of two seeds is one seed twice, or the other, with probability 1/4 each.
    assert ppo["original"] == "3.00 ± 1.41 [2.00, 4.00]"
    assert ppo["mass"] == "1.50 ± 0.71 [1.00, 2.00] (-50 %)"
    assert table["snake_gather", "label_hippo_random"]["mass"] == "**2.00 ± 0.00 [2.00, 2.00] (+0 %)**"
    assert table["ant_gather", "label_ppo"]["mass"] == "-1.00 ± 0.00 [-1.00, -1.00] (+50 %)"  # of the absolute value
    assert table["ant_gather", "label_hippo_random"]["mass"] == "**0.50 ± 0.71 [0.00, 1.00] (n/a)**"
    assert ppo["n"] == "2"


def test_one_seed_has_neither_spread_nor_interval():
    assert table1.cell(pd.Series([3.0]), 2.0) == "3.00 (+50 %)"


def test_the_papers_numbers_stand_below_ours_in_the_same_columns(results):
    table = table1.rows(results)
    at = [row["method"] for row in table].index("label_ppo")
    paper = table[at + 1]
    assert list(paper) == list(table[at])
    assert (paper["method"], paper["n"]) == ("paper: label_ppo", "5")
    assert (paper["original"], paper["mass"]) == ("2.72", "3.16 (+16 %)")


def test_a_table_that_fits_is_not_wrapped_and_one_that_does_not_shares_the_line():
    assert tabular.columns([{"a": "x" * 80, "b": "y"}]) == "ll"
    types = tabular.columns([{"a": "x" * 298, "b": "y", "c": "z" * 98}])
    left = (tabular.LINE - 3) / tabular.LINE
    shares = [float(share) for share in re.findall(r"p\{([0-9.]+)", types)]
    assert shares == pytest.approx([0.75 * left, 0.25 * left], abs=1e-3)
    assert re.sub(r">\{[^}]*\}p\{[^}]*\}", "p", types) == "plp"


def test_what_latex_would_read_as_a_command_is_escaped():
    assert tabular.escaped(r"50 % of a_b & $x$ {y} \z") == r"50 \% of a\_b \& \$x\$ \{y\} \textbackslash{}z"
    assert tabular.escaped("**1.0 ± 2** =") == r"\textbf{1.0 $\pm$ 2} ="


def lemma():
    """Table 2's input: one seed, every quantity with as many digits as it can have."""
    names = [f"{prefix}_{name}" for prefix in ("own", "other") for name in table2.PROBABILITIES]
    spread = [f"{name}_{what}" for name in (*names, *table2.COSINES) for what in ("mean", "std")]
    run = {"env": "snake_gather", "env_label": "Snake Gather", "variant": "given_skills_random_p"}
    labels = {"variant_label": "given skills, random p", "seed": 0}
    rows = [run | {"seed": 0, "run_id": "a" * 12, "metric": metric, "value": 0.123456} for metric in spread]
    return Results({"runs": [run | labels], "title": "t"}, pd.DataFrame(rows), [])


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="pdflatex is not installed")
def test_every_table_compiles_alone_and_stays_on_its_page(results, tmp_path):
    assert table3.main(["--out", str(tmp_path)]) == 0
    wide = [
        row | dict.fromkeys(("mass", "damping", "inertia", "friction"), "**-10.00 ± 10.00 [-10.00, 10.00] (-100 %)** =")
        for row in table1.rows(results)
    ]
    tabular.write(tmp_path / "smoke/table1", "t", "n", wide, "2 runs, set ab: a b")
    tabular.write(tmp_path / "smoke/table2", "t", "n", table2.rows(lemma()), "1 runs, set ab: a")
    for name in ("table1", "table2", "table3"):
        command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", f"{name}.tex"]
        for _ in range(3):  # longtable finds its widths in the first two
            result = subprocess.run(command, cwd=tmp_path / "smoke", capture_output=True, text=True, check=False)
            assert result.returncode == 0, result.stdout[-2000:]
        assert "Overfull" not in result.stdout, name
        assert (tmp_path / f"smoke/{name}.pdf").stat().st_size > 5000
