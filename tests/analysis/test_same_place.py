"""Methods are compared at the same place: saw-tooths over whole cycles, HIRO at its own steps, and by time."""

import json

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from analysis import claims, predicates, results, stats
from analysis.runs import Results, read_plan
from experiments import commit
from experiments.plan import make_plan
from hippo.core.files import DamagedFile
from paper_figures import clock, curves
from tests.analysis.test_analysis import planned

NAMED = {claim.name: claim for claim in claims.CLAIMS}


def saw(iterations, cycle, height=1.0):
    """0 in the first third of a cycle, in which only the master learns, then `height`."""
    return np.where(np.arange(iterations) % cycle < cycle // 3, 0.0, height)


# --------------------------------------------------------------------------------------------------------- whole cycles


@pytest.mark.parametrize(
    ("iterations", "naive"),
    # Warm-up in the last tenth: 108..119 none, 180..199 all of it, 900..999 the 40 of 900..919 and 960..979.
    [(120, 1.0), (200, 0.0), (1000, 0.6)],
)
def test_the_end_of_a_saw_tooth_is_the_mean_of_whole_cycles_wherever_training_stops(iterations, naive):
    curve = saw(iterations, 60)
    assert stats.final_performance(curve) == pytest.approx(naive)  # what depends on where in a cycle the end falls
    assert stats.final_performance(curve, 60) == pytest.approx(2 / 3)
    assert stats.initial_performance(curve, 60) == pytest.approx(2 / 3)
    assert stats.whole_cycles(curve, 60).mean() == pytest.approx(2 / 3)


def test_a_tenth_is_as_many_whole_cycles_as_hold_it():
    # 10 % of 1000 iterations are 100, in two cycles of 60; of 200 they are 20, in one; of 40 there is no whole cycle.
    assert [stats.window(rows, 60) for rows in (1000, 200, 40)] == [120, 60, 4]
    assert [stats.window(rows) for rows in (1000, 200, 4)] == [100, 20, 1]
    curve = np.arange(200.0)  # ends at 179, the last cycle's mean is that of 120..179
    assert stats.final_performance(curve, 60) == 149.5
    assert stats.final_performance(np.arange(40.0), 60) == stats.final_performance(np.arange(40.0))


def learning_curves(env, steps, plan=()):
    """Three seeds per variant: variant -> (environment steps per row, values)."""
    rows = [
        {"env": env, "variant": v, "seed": seed, "run_id": f"{v}{seed}", "metric": "return_mean"}
        | {"env_steps": each * (t + 1), "value": x + 0.01 * seed}
        for v, (each, values) in steps.items()
        for seed in range(3)
        for t, x in enumerate(values)
    ]
    return Results({"runs": list(plan)}, pd.DataFrame(rows), [])


def mlsh(iterations, cycle=60):
    """The planned run of MLSH in Block Hopper, 50 steps an iteration."""
    return {"env": "block_hopper", "variant": "mlsh", "variant_label": "MLSH", "env_label": "Block Hopper"} | {
        "cycle": cycle,
        "iterations": iterations,
        "env_steps": 50 * iterations,
        "physics": "paper",
    }


def test_a_verdict_on_mlsh_does_not_depend_on_where_in_a_cycle_its_training_ends():
    flat = np.full(200, 0.7)  # HiPPO; MLSH's mean over cycles is 2/3, its end a warm-up or none
    both = {"hippo_random": (50, flat), "mlsh": (50, saw(200, 60))}
    for measure, expected in (("final", 2 / 3), ("gain", 0.0), ("steadiness", 0.0), ("area", 0.667)):
        data = learning_curves("block_hopper", both, [mlsh(200)])
        of = predicates.curve_scores(data, "block_hopper", ("hippo_random", "mlsh"), measure)[1]
        assert of[0] == pytest.approx(expected, abs=5e-3), measure
    blind = learning_curves("block_hopper", both, [mlsh(200, cycle=1)])
    of = predicates.curve_scores(blind, "block_hopper", ("hippo_random", "mlsh"), "final")[1]
    assert of[0] == pytest.approx(0.0)


def test_a_thinned_saw_tooth_keeps_whole_cycles():
    rows = pd.DataFrame({"env_steps": 50 * np.arange(1, 1001), "run_id": "a", "value": saw(1000, 60)})
    thin = commit.thinned(rows, 60)  # groups of 4 are enough, and 4 divides 60: 15 rows a cycle
    assert len(thin) == 250
    curve, data = thin["value"].to_numpy(), Results({"runs": [mlsh(1000)]}, thin, [])
    cycle = data.rows_per_cycle("block_hopper", "mlsh", thin["env_steps"].iloc[0])
    assert cycle == 15
    assert stats.final_performance(curve, cycle) == pytest.approx(2 / 3)
    longer = commit.thinned(pd.concat([rows, rows]), 60)  # 2000: groups of 8 would do, 10 is the next that divides 60
    assert len(longer) == 200
    assert len(commit.thinned(pd.concat([rows, rows]))) == 250


def test_results_and_captions_take_whole_cycles_too():
    data = learning_curves("block_hopper", {"mlsh": (50, saw(200, 60))}, [mlsh(200) | {"kind": "train"}])
    (row,) = results.performance(data, "block_hopper")
    assert "| 0.68 ± 0.01 | 0.00 ± 0.00 | 0.68 ± 0.01 |" in row
    assert "MLSH 0.677 ± 0.01" in curves.final_line(data, "block_hopper")


def test_a_plan_says_how_long_cycles_are_and_how_many_steps_a_run_takes(tmp_path):
    plan = make_plan("fig5", "laptop", [], True, tmp_path)
    entries = {e.variant: e.as_planned() for e in plan.entries}
    assert {variant: run["cycle"] for variant, run in entries.items() if run["cycle"] > 1} == {"mlsh": 60}
    assert entries["mlsh"]["env_steps"] == 120 * 50_000
    path = plan.write(tmp_path)
    path.write_text(path.read_text().replace('"cycle": 60', '"cycle": "x"'))
    with pytest.raises(DamagedFile, match="cycle"):
        read_plan(path)


# ----------------------------------------------------------------------------------------------- HIRO's number of steps


def test_hiro_is_compared_where_its_own_budget_ends_too_and_both_are_said():
    late = np.concatenate([np.zeros(20), np.full(100, 5.0)])  # HiPPO learns only after HIRO's 1 M steps
    everywhere = [
        learning_curves(env, {"hippo_random": (50_000, late), "hiro": (10_000, np.ones(100))}) for env in predicates.ALL
    ]
    data = Results({}, pd.concat([each.frame for each in everywhere]), [])
    ruling = claims.judge(NAMED["beats_hiro"], data)
    assert ruling.verdict == claims.REPRODUCED
    assert ruling.at == "at the 1 M steps of hiro"
    assert ruling.at_these_steps.verdict == claims.NOT_REPRODUCED
    assert claims.verdict_of(ruling) == ("reproduced; at the 1 M steps of hiro: not reproduced (the opposite is shown)")
    words = claims.in_words(ruling)
    assert words.count("block_hopper +4") == 1
    assert words.count("block_hopper -1") == 1


def test_methods_with_one_budget_have_one_verdict():
    both = {"hippo_random": (50, np.arange(10.0)), "mlsh": (50, np.arange(10.0))}
    ruling = claims.judge(NAMED["beats_mlsh"], learning_curves("block_hopper", both))
    assert (ruling.at, ruling.at_these_steps) == ("", None)


# ---------------------------------------------------------------------------------------------------------- wall-clock


def with_clocks(tmp_path, seconds):
    """`planned` runs of 3 iterations whose clocks are `seconds` per iteration, None for no file."""
    planned(tmp_path, [3, 3])
    for seed, each in enumerate(seconds):
        if each is not None:
            lines = "".join(f"{i},{each}\n" for i in range(3))
            (tmp_path / f"{seed:012x}/timing.csv").write_text("iteration,seconds\n" + lines)
    arguments = ["--scale", "smoke", "--runs-dir", str(tmp_path), "--data", str(tmp_path / "data")]
    assert curves.main("fig3", [*arguments, "--out", str(tmp_path / "out")]) == 0
    return tmp_path / "out/smoke"


def test_curves_by_wall_clock_stand_beside_those_by_steps_where_clocks_are_there(tmp_path):
    out = with_clocks(tmp_path, [3600, 1800])
    assert Image.open(out / "fig3.clock.png").info["Title"].endswith("by wall-clock")
    assert "by wall-clock" in (out / "fig3.caption.txt").read_text()


def test_there_are_none_where_a_clock_is_missing(tmp_path):
    out = with_clocks(tmp_path, [3600, None])
    assert not (out / "fig3.clock.png").exists()
    assert "wall-clock" not in (out / "fig3.caption.txt").read_text()


def test_hours_are_the_sum_of_a_runs_own_seconds(tmp_path):
    data = learning_curves("block_hopper", {"hiro": (50, np.ones(2))}, [mlsh(2) | {"variant": "hiro"}])
    for seed, each in enumerate((1800, 3600, 7200)):
        (tmp_path / f"hiro{seed}").mkdir()
        (tmp_path / f"hiro{seed}/timing.csv").write_text(f"iteration,seconds\n0,{each}\n1,{each}\n")
    clocked = clock.by_clock(data, tmp_path)
    assert clocked.frame["env_steps"].tolist() == [0.5, 1.0, 1.0, 2.0, 2.0, 4.0]
    assert clocked.plan["runs"][0]["env_steps"] == 4.0
    assert json.dumps(clocked.plan)  # the plan as it was otherwise
    (tmp_path / "hiro2/timing.csv").write_text("iteration,seconds\n0,1\n")  # a power cut lost a line
    assert clock.by_clock(data, tmp_path) is None
