"""The results page: numbers by hand, nothing pooled, and the committed page is what the committed rows say."""

import json

import pandas as pd
import pytest

from analysis import claims, results
from analysis.command_line import PROTOCOLS
from analysis.edition import Edition
from analysis.runs import COLUMNS, Results
from experiments.plan import make_plan
from tests import ROOT
from tests.analysis.test_analysis import planned

EDITIONS = [Edition(scale, protocol) for protocol in PROTOCOLS for scale in results.SCALES]


def tables(edition):
    """Committed rows, without what says where their runs come from."""
    return sorted(path for path in (results.DATA / edition.folder).glob("*.csv") if "." not in path.stem)


def committed(tmp_path, scale="laptop"):
    """A plan and committed rows: PPO, two seeds, ten iterations, returns 0 to 9 and 10 to 19."""
    planned(tmp_path, [10, 10], iterations=10, states=("committed", "committed"))
    plan = json.loads((tmp_path / "plans/smoke/fig3.json").read_text()) | {"scale": scale}
    (tmp_path / "plans" / scale).mkdir()
    (tmp_path / f"plans/{scale}/fig3.json").write_text(json.dumps(plan))
    rows = [
        ["fig3", scale, "block_hopper", "ppo", seed, f"{seed:012x}", 10 * (i + 1), "return_mean", 10.0 * seed + i]
        for seed in (0, 1)
        for i in range(10)
    ]
    (tmp_path / "data" / scale).mkdir(parents=True)
    pd.DataFrame(rows, columns=COLUMNS).to_csv(tmp_path / f"data/{scale}/fig3.csv", index=False)


def test_final_and_area_by_hand(tmp_path):
    committed(tmp_path)
    page, summary = results.pages(results.load_all(tmp_path, tmp_path / "data"), tmp_path)
    # Last 10 %: 9 and 19, whose deviation is sqrt(50); first: 0 and 10; areas: 4.5 and 14.5.
    assert "| PPO | 2 | 0.0 M | 14.00 ± 7.07 | 9.00 ± 0.00 | 9.50 ± 7.07 |" in page
    assert "### A title (fig3, laptop scale)" in page
    rows = [line for line in page.splitlines() if "| no data" in line]
    assert len(rows) == len(claims.CLAIMS) - 1  # one is decided by arithmetic
    everything = len(claims.CLAIMS)
    assert f"{everything} claims: 0 reproduced, 1 not reproduced, {everything - 1} undecided." in page
    assert len([line for line in summary.splitlines() if line.startswith("| ")]) == 2  # the head, and that one


def test_what_is_not_trained_names_methods_and_of_those_begun_the_seeds():
    def run(env, variant, seed):
        return {"env_label": env, "variant_label": variant, "seed": seed}

    planned = [run(env, variant, seed) for env in "AB" for variant in ("PPO", "HiPPO") for seed in range(3)]
    missing = [r for r in planned if r["env_label"] == "A" and r["seed"] > 0]
    missing += [run("B", "PPO", 2), *(run("B", "HiPPO", seed) for seed in range(3))]
    assert results.untrained(Results({"runs": planned}, pd.DataFrame(), missing)) == [
        "A: all, seed 1, 2",
        "B: PPO, seed 2",
        "B: HiPPO",
    ]


def test_without_committed_rows_it_says_so(tmp_path):
    for text in results.pages(results.load_all(tmp_path, tmp_path / "data"), tmp_path):
        assert "No results are committed yet." in text


def test_rows_without_a_plan_are_one_clear_error(tmp_path, capsys):
    committed(tmp_path)
    (tmp_path / "plans/laptop/fig3.json").unlink()
    arguments = ["--runs-dir", str(tmp_path), "--data", str(tmp_path / "data"), "--docs", str(tmp_path)]
    assert results.main(arguments) == 2
    assert "no plan at scale laptop" in capsys.readouterr().err
    assert not (tmp_path / "results.md").exists()


def test_the_committed_page_is_fresh(tmp_path):
    for edition in EDITIONS:
        for path in tables(edition):
            make_plan(path.stem, edition.scale, [], False, tmp_path, edition.protocol).write(tmp_path)
    written = (ROOT / "docs" / "results.md").read_text()
    page, summary = results.pages(results.load_all(tmp_path, results.DATA), ROOT / "docs" / "pictures")
    assert page == written, "run `make results`"
    assert results.MARK.search((ROOT / "README.md").read_text())[0].split("-->\n")[1] == summary + "<!-- end -->"


@pytest.mark.parametrize("edition", EDITIONS, ids=str)
def test_every_committed_row_belongs_to_a_planned_run(edition, tmp_path):
    for path in tables(edition):
        plan = make_plan(path.stem, edition.scale, [], False, tmp_path, edition.protocol)
        ids = set(pd.read_csv(path, dtype={"run_id": str})["run_id"])
        assert ids <= {entry.run.run_id for entry in plan.entries}
