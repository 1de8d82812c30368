"""Studies: the runs a file describes, rows kept once, a table worked by hand, and the committed pages are fresh."""

import json

import pandas as pd
import pytest

from experiments import study
from experiments.choices import choices
from experiments.status import write_atomically

TWO = {
    "title": "Two step sizes",
    "text": "Why.",
    "settings": ["scale=smoke", "iterations=2"],
    "environments": {"block_hopper": ["batch_size=2000"], "block_half_cheetah": []},
    "variants": {"PPO": ["algo=ppo"]},
    "over": {"algo.learning_rate": ["1e-4", "3e-4"]},
    "seeds": [100, 101],
    "metrics": ["return_mean"],
}
# Returns of the two iterations by environment and step size, for seed 100; seed 101 has one more.
RETURNS = {
    ("block_hopper", 1e-4): (0.0, 2.0),
    ("block_hopper", 3e-4): (2.0, 4.0),
    ("block_half_cheetah", 1e-4): (1.0, 1.0),
    ("block_half_cheetah", 3e-4): (0.0, 1.0),
}


@pytest.fixture
def trained(tmp_path):
    """A study whose runs are finished, as far as their folders say."""
    made = study.build("two", TWO, tmp_path / "runs")
    for run in (e.run for e in made.entries):
        run.folder.mkdir(parents=True)
        values = [x + run.seed - 100 for x in RETURNS[run.env, run.config.learning_rate]]
        rows = "".join(f"{i},{2000 * (i + 1)},{x},7\n" for i, x in enumerate(values))
        (run.folder / "progress.csv").write_text("iteration,env_steps,return_mean,other\n" + rows)
        write_atomically(run.folder / "status.json", json.dumps({"state": "finished", "message": ""}))
    return made


def test_a_study_is_its_variants_times_what_they_are_tried_over(tmp_path):
    made = study.build("two", TWO, tmp_path)
    assert len({e.run.run_id for e in made.entries}) == 8
    assert {e.variant for e in made.entries} == {"PPO, learning_rate=1e-4", "PPO, learning_rate=3e-4"}
    assert [e.run.seed for e in made.entries] == [100] * 4 + [101] * 4  # whole comparisons first
    batches = {e.run.env: e.run.config.batch_size for e in made.entries}
    assert batches["block_hopper"] == 2000 != batches["block_half_cheetah"]


def test_the_table_worked_by_hand(trained, tmp_path, capsys):
    assert study.train(trained, 1, tmp_path / "rows") == 0
    before = (tmp_path / "rows/two.csv").read_bytes()
    assert study.train(trained, 1, tmp_path / "rows") == 0
    assert (tmp_path / "rows/two.csv").read_bytes() == before  # nothing twice
    assert before.count(b"\n") == 1 + 8 * 2
    assert b"other" not in before
    assert study.show(trained, tmp_path / "rows", tmp_path / "pages") == 0
    page = (tmp_path / "pages/two.md").read_text()
    # Mean areas are 1.5, 3.5 (their mean 2.5) and 1.5, 1 (1.25): scores (0.6 + 1.2) / 2 and (1.4 + 0.8) / 2.
    first = "| PPO, learning_rate=1e-4 | 2 | 2.50 ± 0.71 | 1.50 ± 0.71 | 2 | 1.50 ± 0.71 | 1.50 ± 0.71 | 0.90 |"
    second = "| **PPO, learning_rate=3e-4** | 2 | 4.50 ± 0.71 | 3.50 ± 0.71 | 2 | 1.50 ± 0.71 | 1.00 ± 0.71 | 1.10 |"
    assert first in page
    assert second in page
    assert (tmp_path / "pages/two.png").stat().st_size > 10_000


def test_a_study_that_is_not_whole_says_so_and_takes_no_choice(trained, tmp_path):
    frame = pd.concat([study.rows_of(trained, entry) for entry in trained.entries[:-1]])
    page = study.page(trained, frame, "two.png")
    assert "**Not whole yet**: 7 of 8 runs." in page
    assert "| **" not in page


def test_without_rows_and_without_such_a_study_it_says_so(trained, tmp_path, capsys):
    assert study.show(trained, tmp_path / "rows", tmp_path / "pages") == 1
    assert "no rows yet; `python -m experiments.study run two` makes them" in capsys.readouterr().err
    assert study.main(["run", "tunning", "--runs-dir", str(tmp_path / "x")]) == 2
    assert "study=tunning: did you mean tuning?" in capsys.readouterr().err
    assert study.main(["run", "tuning", "--workers", "0", "--runs-dir", str(tmp_path / "x")]) == 2
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize("name", choices("study"))
def test_the_committed_pages_are_fresh(name, tmp_path, capsys):
    made = study.load(name, tmp_path)
    if not (study.ROWS / f"{name}.csv").exists():
        pytest.skip("not trained yet")
    assert study.show(made, study.ROWS, tmp_path) == 0
    written = study.PAGES / f"{name}.md"
    assert (tmp_path / f"{name}.md").read_text() == written.read_text(), f"run `experiments.study show {name}`"
