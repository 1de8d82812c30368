"""The run log: deterministic columns, truncation on resume, episode statistics, and guards."""

import numpy as np
import pytest
import torch

from hippo.core.episodes import episode_statistics
from hippo.core.log import Diverged, RunLog, check_finite


def write(log: RunLog, iterations: range) -> None:
    for i in iterations:
        log.row({"iteration": i, "return_mean": i / 3}, {"seconds": 1.0})


def test_floats_are_written_so_that_they_read_back_exactly(tmp_path):
    log = RunLog(tmp_path)
    log.row({"iteration": 0, "x": 0.1 + 0.2}, {"seconds": 1.5})
    assert (tmp_path / "progress.csv").read_text() == "iteration,x\n0,0.30000000000000004\n"
    assert (tmp_path / "timing.csv").read_text() == "iteration,seconds\n0,1.5\n"


@pytest.mark.parametrize("torn", ["", "5,", "5,1.66666"])
def test_resume_drops_what_the_checkpoint_does_not_cover(tmp_path, torn):
    write(RunLog(tmp_path), range(3))
    expected = (tmp_path / "progress.csv").read_bytes()
    write(RunLog(tmp_path), range(3, 5))
    with (tmp_path / "progress.csv").open("a") as file:
        file.write(torn)  # killed while writing
    RunLog(tmp_path).resume(3)
    assert (tmp_path / "progress.csv").read_bytes() == expected


def test_resume_from_scratch_removes_every_row(tmp_path):
    write(RunLog(tmp_path), range(2))
    RunLog(tmp_path).resume(0)
    assert not (tmp_path / "progress.csv").exists()


def test_on_row_sees_metrics_and_timing(tmp_path):
    seen = []
    RunLog(tmp_path, on_row=lambda metrics, timing: seen.append((metrics, timing))).row({"iteration": 0}, {"s": 1.0})
    assert seen == [({"iteration": 0}, {"s": 1.0})]


def test_episode_statistics_worked_by_hand():
    # Column 0: one episode of 4 steps, return 4. Column 1: return 1 (2 steps), then 5 + 1 = 6 (2 steps).
    # Column 2: return -10 after one step, then an episode that the batch cuts (in neither mean).
    reward = np.array([[1, 1, -10], [1, 0, 7], [1, 5, 7], [1, 1, 7]], float)
    done = np.array([[0, 0, 1], [0, 1, 0], [0, 0, 0], [1, 1, 0]], bool)
    s = episode_statistics(reward, done)
    assert s["return_mean"] == pytest.approx((4 + 1 - 10) / 3)
    assert s["return_mean_all"] == pytest.approx((4 + 1 + 6 - 10) / 4)
    assert (s["return_min"], s["return_max"], s["episodes"]) == (-10.0, 4.0, 4)
    assert s["length_mean"] == pytest.approx((4 + 2 + 1) / 3)


def test_a_batch_without_a_completed_episode_has_no_return():
    s = episode_statistics(np.ones((3, 2)), np.zeros((3, 2), bool))
    assert np.isnan(s["return_mean"])
    assert s["episodes"] == 0


def test_a_non_finite_tensor_stops_the_run_with_its_name():
    with pytest.raises(Diverged, match="iteration 7: rewards has 1 non-finite of 3") as caught:
        check_finite(7, observations=torch.ones(2), rewards=torch.tensor([1.0, float("nan"), 2.0]))
    dump = caught.value.dump
    assert (dump["iteration"], dump["name"], dump["indices"].tolist()) == (7, "rewards", [[1]])
    check_finite(7, observations=torch.ones(2))
