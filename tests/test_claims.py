"""Claims and provenance: verdicts worked by hand, the paper's own numbers, and the runs behind a file."""

import json

import numpy as np
import pandas as pd
import pytest
import yaml

from analysis import claims, explain
from analysis.runs import Results
from tests.test_analysis import planned
from tests.test_figures import draw

PAPER = yaml.safe_load((claims.ROOT / "paper_figures/paper_values.yaml").read_text())
NAMED = {claim.name: claim for claim in claims.CLAIMS}
GOOD, BAD, NOISE = ([5.0, 5.1, 4.9], [0.0, 0.1, -0.1]), ([0.0, 0.1, -0.1], [5.0, 5.1, 4.9]), ([0, 5, 9.0], [1, 4, 8.0])


def results(scores, missing=()):
    """Flat curves of 10 rows for fig3's random p and ppo: place -> (favoured seeds, other seeds)."""
    rows = [
        {
            "env": env,
            "variant": v,
            "seed": s,
            "run_id": f"{env}{v}{s}",
            "env_steps": t,
            "metric": "return_mean",
            "value": x,
        }
        for env, both in scores.items()
        for v, values in zip(("hippo_random", "ppo"), both, strict=True)
        for s, x in enumerate(values)
        for t in range(1, 11)
    ]
    return Results({}, pd.DataFrame(rows), [{"run_id": run} for run in missing])


def judged(scores, missing=()):
    return claims.judge(NAMED["better_than_ppo"], results(scores, missing))[0]


def test_a_sentence_is_reproduced_only_where_it_holds_in_every_environment_it_names():
    assert judged(dict.fromkeys(claims.ALL, GOOD)) == claims.REPRODUCED
    assert judged(dict.fromkeys(claims.ALL, GOOD) | {"ant_gather": NOISE}) == claims.INCONCLUSIVE
    assert judged(dict.fromkeys(claims.ALL, GOOD) | {"ant_gather": BAD}) == claims.NOT_REPRODUCED
    assert judged(dict.fromkeys(claims.ALL[:3], GOOD)) == claims.INCONCLUSIVE  # one was not trained


def test_two_seeds_or_a_run_cut_short_decide_nothing():
    two = ([5.0, 5.1], [0.0, 0.1])
    assert judged(dict.fromkeys(claims.ALL, two)) == claims.INCONCLUSIVE
    assert judged(dict.fromkeys(claims.ALL, GOOD), ["ant_gatherppo2"]) == claims.INCONCLUSIVE


def test_welchs_interval_worked_by_hand():
    # Means 2 and 0; variances 1 and 0 of three seeds: standard error sqrt(1/3), 2 degrees of freedom, t = 4.30265.
    difference = claims.welch(np.array([1.0, 2.0, 3.0]), np.zeros(3))
    assert difference.mean == 2
    assert difference.high == pytest.approx(2 + 4.30265 / 3**0.5, abs=1e-4)
    assert claims.welch(np.ones(3), np.zeros(3)).low == 1


def test_holm_widens_the_intervals_and_stops_at_the_first_failure():
    y = np.arange(6.0)
    x = y + 2.8  # standard error 1.0801: 2.592 of them, between t(10) at 5 % (2.228) and at 1.25 % (3.038)
    alone, of_four = claims.welch(x, y), claims.holm(dict.fromkeys("abcd", (x, y)))
    assert alone.low > 0
    assert all(d.low < 0 for d in of_four.values())
    strong = (np.arange(6) + 50.0, np.arange(6.0))
    stepped = claims.holm({"strong": strong, "x": (x, y)})
    assert stepped["x"].low == pytest.approx(alone.low)  # the last one left is tested at 5 %


def test_faster_is_the_area_and_final_is_the_end():
    frame = results({"ant_gather": GOOD}).frame
    late = (frame["variant"] == "ppo") & (frame["env_steps"] == 10)
    frame.loc[late, "value"] = 100.0  # better only at the very end
    r = Results({}, frame, [])
    area = claims.curve_scores(r, "ant_gather", ("hippo_random", "ppo"), "area")
    final = claims.curve_scores(r, "ant_gather", ("hippo_random", "ppo"), "final")
    assert final[1].tolist() == [100.0] * 3
    assert area[0][0] == pytest.approx(5.0)
    assert area[1][0] == pytest.approx(0.5 * 100 / 9, rel=0.01)  # one triangle of nine


def test_the_papers_own_numbers_support_six_of_eight_but_not_more_robust_than_ppo():
    assert NAMED["six_of_eight"].printed(PAPER) == (6, 8)
    assert NAMED["zero_shot_return"].printed(PAPER) == (8, 8)
    assert NAMED["zero_shot_drop"].printed(PAPER) == (1, 8)
    assert NAMED["cosine_almost_one"].printed(PAPER) == (4, 4)
    assert NAMED["epsilon_a_tenth"].printed(PAPER) == (4, 4)


def test_six_of_eight_needs_six_certain_cells_and_falls_with_three_certain_losses():
    claim = NAMED["six_of_eight"]
    win, lose = claims.Difference(1, 0.5, 1.5, 0, (3, 3)), claims.Difference(-1, -1.5, -0.5, 0, (3, 3))
    for wins, expected in ((6, claims.REPRODUCED), (5, claims.NOT_REPRODUCED)):
        cells = dict(zip(claims.CELLS, [win] * wins + [lose] * (8 - wins), strict=True))
        assert claims.verdict(claim, cells) == expected
    assert claims.verdict(claim, dict.fromkeys(claims.CELLS[:5], win)) == claims.INCONCLUSIVE


def test_every_figures_variants_are_those_of_its_yaml():
    for claim in claims.CLAIMS:
        conf = yaml.safe_load((claims.ROOT / f"experiments/conf/figure/{claim.figure}.yaml").read_text())
        cells = claim.pairs.__closure__
        named = {c.cell_contents for c in cells if isinstance(c.cell_contents, str)} - {"final", "area"}
        if claim.figure != "table2":
            assert named <= set(conf["variants"]), claim.name


def test_smoke_gives_no_verdicts(tmp_path, capsys):
    assert claims.main(["--runs-dir", str(tmp_path), "--out", str(tmp_path / "out")]) == 0
    text = capsys.readouterr().out
    assert text.startswith("smoke: no verdicts")
    assert " reproduced |" not in text
    assert (tmp_path / "out/smoke/claims.md").read_text() == text


def test_the_runs_behind_a_picture_are_listed(tmp_path, capsys):
    planned(tmp_path, [3, 2])
    assert draw(tmp_path) == 0
    ids = sorted(run["run_id"] for run in json.loads((tmp_path / "plans/smoke/fig3.json").read_text())["runs"])
    for suffix in ("png", "pdf", "svg", "csv"):
        assert explain.run_ids(tmp_path / f"out/smoke/fig3.{suffix}") == ids
    capsys.readouterr()
    assert explain.main([str(tmp_path / "out/smoke/fig3.pdf"), "--runs-dir", str(tmp_path)]) == 0
    assert "block_hopper  ppo  seed 1  failed" in capsys.readouterr().out
    (tmp_path / "table.tex").write_text("% 2 runs, set 0123456789ab: 0123456789ab ba9876543210; commits: 0123456789\n")
    assert explain.run_ids(tmp_path / "table.tex") == ["0123456789ab", "ba9876543210"]


def test_a_file_without_provenance_is_refused(tmp_path, capsys):
    (tmp_path / "x.png").write_bytes(b"nothing")
    assert explain.main([str(tmp_path / "x.png")]) == 2
    assert explain.main([str(tmp_path / "gone.pdf")]) == 2
    assert capsys.readouterr().err.count("error:") == 2
