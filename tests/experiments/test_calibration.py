"""The ends of the Block tasks: crossings as they are, the search for a blind gait, and the gaits that were found."""

import json
import re
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from experiments import crossings
from experiments.artefacts import calibration, gait_picture, gait_search
from experiments.config import compose_run
from experiments.crossings import Crossings
from experiments.plan import Entry
from hippo.envs import make
from tests import ROOT

CALIBRATION = ROOT / "docs/environments/calibration.md"


def put(envs, x, pitch):
    """Leave the robots at rest at x (N,) and pitch (N,)."""
    envs.physics.qpos[:, 0 if envs.robot_name == "half_cheetah" else 1] = x
    envs.physics.qpos[:, 2], envs.physics.qvel[:] = pitch, 0.0
    envs.physics.forward(np.arange(envs.num_envs))


def height(envs, i):
    """MuJoCo's own, in m, of robot i's torso."""
    data = envs.physics.data(i)
    mujoco.mj_kinematics(envs.physics.model, data)
    return data.body("torso").xpos[2]


@pytest.mark.parametrize("task", gait_search.TASKS)
def test_a_crossing_is_tumbled_by_the_torsos_angle_and_has_the_height_of_the_torso(task):
    inner = make(task, 4, 0, horizon=2)
    envs = Crossings(inner)
    still = np.zeros(inner.action_space.shape)
    for pitches in ([0.5, 1.5, -1.5, 0.0], [0.5, 1.5, 2 * np.pi - 0.5, 0.0]):
        envs.reset(seed=0)
        put(inner, [2.9, 2.9, 4.9, 0.0], pitches)  # one wall, one, two at once, none
        envs.step(still)
        heights = [height(inner, i) for i in range(4)]
        put(inner, [4.9, 2.9, 4.9, 2.9], [2.0, 0.0, 0.0, 2.0])  # another, none, none, the first
        envs.step(still)  # the end of the episodes: what follows counts for nothing
        put(inner, np.full(4, 9.0), np.zeros(4))
        envs.step(still)
        rows = envs.rows()
        assert [row["crossings"] for row in rows] == [2, 1, 2, 1]
        assert [row["crossings_tumbled"] for row in rows] == [1, 1, 2 if pitches[2] == -1.5 else 0, 1]
        np.testing.assert_allclose([rows[i]["crossings_height"] for i in (1, 2)], heights[1:3], atol=1e-6)


def test_no_crossing_has_no_height_and_the_summary_weighs_every_wall_alike():
    rows = [dict(zip(crossings.COLUMNS, values, strict=True)) for values in ((0, 0, None), (1, 1, 0.4), (3, 0, 0.8))]
    assert crossings.summary(rows) == "4 walls cleared, 25% of them with |pitch| > 1 rad, torso at 0.70 m"
    assert crossings.summary(rows[:1]) == "no wall was cleared"


def test_a_gait_is_one_sinusoid_per_joint_of_a_common_frequency():
    gait = gait_search.Gait(frequency=2.0, amplitude=(1.0, 0.5), phase=(0.0, np.pi / 2), offset=(0.1, -0.2))
    parameters = gait_search.row(gait)[None]
    assert gait_search.gait(parameters[0]) == gait
    # A quarter of a period of 0.5 s later the sine is at its top and the cosine at nothing.
    np.testing.assert_allclose(gait_search.actions(parameters, 0.125), [[1.1, -0.2]], atol=1e-15)


def test_the_search_finds_the_best_parameters_and_repeats_itself(monkeypatch):
    target = np.array([1.5, 0.3, 0.7, 0.2, 1.0, -1.0, 0.5, 0.1, -0.1, 0.0])
    monkeypatch.setattr(gait_search, "scores", lambda task, p, *arguments: -((p - target) ** 2).sum(1))
    found = [gait_search.search("block_hopper", 4_000_000, seed=0, report=lambda _: None) for _ in range(2)]
    np.testing.assert_allclose(gait_search.row(found[0]), target, atol=0.1)
    assert found[0] == found[1]


def test_a_score_is_walls_and_the_way_in_walls_of_fresh_episodes(monkeypatch):
    standing = np.zeros((2, 10))
    score = gait_search.scores("block_hopper", standing, 3, seed=0, horizon=2)
    assert score.shape == (2,)
    assert (np.abs(score) < 0.05).all()
    assert score[0] != score[1]


@pytest.mark.parametrize("task", gait_search.TASKS)
def test_the_committed_gait_clears_walls_without_seeing_them_as_the_page_says(task):
    rows, _ = calibration.measure(task, calibration.blind_gait(task), episodes=4, seed=1)
    written = re.search(rf"\| `{task}` \| blind gait \| ([0-9.]+) ", CALIBRATION.read_text())
    assert np.mean([row["crossings"] for row in rows]) > float(written[1]) / 2


def test_a_strip_shows_the_gait_around_the_clearing_of_a_wall(monkeypatch):
    class Recorder:
        def __init__(self, envs, width, height):
            self.envs, self.blank = envs, np.zeros((height, width, 3), np.uint8)

        def frame(self, i):
            seen.append((self.envs.physics.data(i).time, int(self.envs.task.cleared[i])))
            return self.blank

        def close(self):
            pass

    seen = []
    monkeypatch.setattr(gait_picture, "Renderer", Recorder)
    assert gait_picture.frames_of("block_half_cheetah").shape == (240, 6 * 320, 3)
    assert [cleared for _, cleared in seen] == [1, 1, 1, 2, 2, 2]
    np.testing.assert_allclose(np.diff([time for time, _ in seen]), gait_picture.APART, atol=0.051)


@pytest.mark.parametrize("task", gait_search.TASKS)
def test_the_ceiling_is_what_the_page_says_of_the_blind_gait(task):
    written = re.search(rf"\| `{task}` \| blind gait \| ([0-9.]+) ", CALIBRATION.read_text())
    assert crossings.CEILING[task] == float(written[1])


def test_a_figure_s_finished_runs_have_a_row_each_with_walls_and_without(tmp_path, monkeypatch, capsys):
    def entry(env, state):
        return Entry(compose_run([f"env={env}", "algo=ppo", "scale=smoke"], tmp_path), env, "ppo", "PPO", state)

    made = [entry("snake_gather", "finished"), entry("block_hopper", "running")]  # no walls; not finished
    plan = SimpleNamespace(entries=made, edition="scale smoke")
    monkeypatch.setattr(calibration, "make_plan", lambda *arguments: plan)
    arguments = ["--figure", "fig3", "--scale", "smoke", "--runs-dir", str(tmp_path)]
    assert calibration.main(arguments) == 2
    error = f"error: --figure=fig3: has no finished run on a Block task at scale smoke in {tmp_path}\n"
    assert capsys.readouterr().err == error
    made.append(entry("block_half_cheetah", "finished"))
    walls = {False: (10, 6), True: (4, 4)}

    def evaluate(run, episodes, seed, blank_walls):
        return [dict(zip(crossings.COLUMNS, (n, n // 2, 0.5), strict=True)) for n in walls[blank_walls]]

    monkeypatch.setattr(calibration, "evaluate", evaluate)
    assert calibration.main(arguments) == 0
    header, rule, row = capsys.readouterr().out.splitlines()
    assert header.replace("\\|", "").count("|") == rule.count("|") == row.count("|")
    cells = row.split(" | ")
    assert cells[1:3] == ["PPO, seed 0", "8.00"]
    assert cells[4:8] == ["50%", "0.50", "49%", "4.00"]


def test_the_command_prints_a_row_per_task_and_policy(monkeypatch, capsys):
    monkeypatch.setattr(calibration, "make", lambda *a, **k: make(*a, **k | {"horizon": 3}))
    assert calibration.main(["--episodes", "2", "--tumble"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(" | ")[1] for line in lines[2:]] == ["uniform actions", "Gaussian noise", "blind gait"] * 2


@pytest.mark.parametrize(
    ("main", "arguments", "message"),
    [
        (gait_search.main, ["block_hopper", "--steps", "10"], "--steps=10: must be at least one generation"),
        (gait_search.main, ["block_hopper", "--seed", "-1"], "--seed=-1"),
        (calibration.main, ["--episodes", "0"], "--episodes=0: must be at least 1"),
        (calibration.main, ["--seed", "-1"], "--seed=-1"),
        (gait_picture.main, ["gaits.jpg"], "out=gaits.jpg: must end in .png"),
        (gait_picture.main, ["nowhere/gaits.png"], "out=nowhere/gaits.png: must be a file that can be written"),
        (calibration.main, ["--figure", "fig33"], "figure=fig33: "),
        (calibration.main, ["--figure", "fig3", "--tumble"], "--tumble"),
    ],
)
def test_bad_input_is_refused_in_a_line(main, arguments, message, capsys):
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert message in captured.err
    assert captured.err.count("\n") == 1
    assert not captured.out


def test_a_search_renews_its_own_entry_only(tmp_path, monkeypatch):
    out = tmp_path / "gaits.json"
    out.write_text(json.dumps({"block_hopper": "kept"}))
    gait = gait_search.Gait(1.0, (1.0,), (0.0,), (0.0,))
    monkeypatch.setattr(gait_search, "search", lambda *arguments: gait)
    assert gait_search.main(["block_half_cheetah", "--out", str(out)]) == 0
    found = json.loads(out.read_text())
    assert found["block_hopper"] == "kept"
    monkeypatch.setattr(gait_search, "FOUND", out)
    assert gait_search.committed("block_half_cheetah") == gait
