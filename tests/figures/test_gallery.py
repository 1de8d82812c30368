"""The skills gallery: information against cases worked by hand, and from a skills file to a picture."""

import hashlib
import math
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import torch

from experiments.artefacts import gallery
from hippo.core.policies import SkillPolicy
from hippo.core.skills import save_skills
from hippo.envs import make
from paper_figures import gallery as pictures


def skills_file(path, num_skills=2, **changes):
    envs = make("hopper", 1, 0)
    policy = SkillPolicy(envs.robot_size, num_skills, 3, [8, 8], torch.Generator().manual_seed(3))
    envs.close()
    metadata = {"robot": "hopper", "observation": "paper", "env": "hopper", "algo": "diayn"}
    metadata |= {"run_id": "0123456789ab", "env_steps": 1, "physics": "paper"}
    save_skills(path, policy, metadata | changes)
    return policy


def test_skills_that_never_share_a_cell_give_log_n_nat():
    skill = np.arange(12) % 3
    cell = np.stack([np.broadcast_to(skill, (5, 12)), np.zeros((5, 12), int)], -1)
    assert gallery.information(cell, skill, 3) == pytest.approx(math.log(3))
    assert gallery.permuted_information(cell, skill, 3, 0) < 0.5 * math.log(3)


def test_identical_skills_on_paths_of_their_own_score_high_and_the_permutation_takes_it_away():
    # Every path stays in a cell of its own, whatever its skill: the plug-in estimate is log n all the same.
    skill = np.arange(60) % 6
    cell = np.stack([np.broadcast_to(np.random.default_rng(0).permutation(60), (40, 60)), np.zeros((40, 60), int)], -1)
    plug_in = gallery.information(cell, skill, 6)
    assert plug_in == pytest.approx(math.log(6))
    assert plug_in - gallery.permuted_information(cell, skill, 6, 0) == pytest.approx(0, abs=1e-9)


def test_a_hand_worked_table_of_visits():
    # Two skills of equal use; cell 0 holds 3 steps of z = 0 and 1 of z = 1, cell 1 the other way round.
    cell = np.array([[[0, 0], [0, 0]], [[0, 0], [1, 0]], [[0, 0], [1, 0]], [[1, 0], [1, 0]]])
    expected = math.log(2) + 0.75 * math.log(0.75) + 0.25 * math.log(0.25)
    assert gallery.information(cell, np.array([0, 1]), 2) == pytest.approx(expected)


def test_the_distance_of_action_distributions_worked_by_hand():
    class TwoSkills:
        num_skills = 2

        def see(self, obs):
            return obs

        def means(self, obs):
            return torch.stack([torch.zeros(len(obs), 2), torch.tensor([3.0, 4.0]).expand(len(obs), 2)], 1)

        def log_std(self):
            return torch.tensor([[1.0, 1.0], [1.0, 13.0]]).log()

    assert gallery.action_distance(TwoSkills(), torch.zeros(5, 3)) == pytest.approx(math.sqrt(25 + 144))


def test_a_path_that_ends_early_stays_where_it_ended():
    # Path 0 ends after its second step, 3 m from its start; the slot goes on with a new path from elsewhere.
    x = np.array([[1.0, 0.0], [2.0, 1.0], [50.0, 2.0], [51.0, 3.0]])
    after = np.array([[2.0, 1.0], [4.0, 2.0], [51.0, 3.0], [52.0, 4.0]])
    done = torch.tensor([[0, 0], [1, 0], [0, 0], [1, 1]], dtype=torch.bool)
    flat = lambda a: torch.from_numpy(np.stack([a, np.zeros_like(a), np.zeros_like(a)], -1))  # noqa: E731
    paths = SimpleNamespace(steps=SimpleNamespace(done=done), position=flat(x), next_position=flat(after))
    place = gallery.from_start(paths)
    assert place[..., 0].T.tolist() == [[0, 1, 3, 3, 3], [0, 1, 2, 3, 4]]
    assert after[-1, 0] - x[0, 0] == 51  # what the slot's last position would have claimed


def test_a_skill_counts_as_further_only_beyond_every_random_skill_of_every_network():
    rows = [("trained", 0, 0, 5.0), ("trained", 0, 1, 3.0), ("trained", 0, "", 9.0)]
    rows += [("random", 0, 0, 2.0), ("random", 1, 0, 4.0), ("random", 1, "", 9.0)]
    metrics = pd.DataFrame(rows, columns=["group", "network", "skill", "value"]).assign(metric="distance")
    assert gallery.further_than_random(metrics) == 1
    assert gallery.further_than_random(metrics[metrics["network"] == 0]) == 2


def test_from_a_skills_file_to_a_picture_that_is_the_same_twice(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(gallery.STEPS, "diayn", 25)
    path = tmp_path / "hopper.pt"
    skills_file(path)
    data = tmp_path / "measured"
    assert gallery.main([str(path), "--paths", "8", "--out", str(data)]) == 0
    assert sorted(file.name for file in tmp_path.iterdir()) == ["hopper.pt", "measured"]
    assert "hopper, trained skills: 8/8 paths" in capsys.readouterr().out
    metrics = pd.read_csv(data / "hopper.metrics.csv")
    assert metrics.groupby("group")["network"].nunique().to_dict() == {"random": 3, "trained": 1}
    assert set(metrics["run_id"]) == {"0123456789ab"}
    assert set(metrics["skills_sha256"]) == {hashlib.sha256(path.read_bytes()).hexdigest()[:12]}
    of_all = metrics[(metrics["group"] == "trained") & metrics["skill"].isna()].set_index("metric")["value"]
    assert of_all["paths"] == 8
    difference = of_all["information"] - of_all["information_permuted"]
    assert of_all["information_corrected"] == pytest.approx(difference, abs=1e-5)
    random = metrics[(metrics["group"] == "random") & metrics["skill"].isna() & (metrics["metric"] == "distance")]
    assert random["value"].nunique() == 3
    assert pictures.value(metrics, "random", "distance") == pytest.approx(random["value"].mean())
    visits = pd.read_csv(data / "hopper.visits.csv")
    assert visits.groupby("group")["steps"].sum().tolist() == [8 * 25, 8 * 25]
    for out in ("a", "b"):
        assert pictures.main(["--data", str(data), "--out", str(tmp_path / out)]) == 0
    for name in ("hopper.png", "hopper.pdf", "hopper.svg", "hopper.caption.txt"):
        assert (tmp_path / "a/gallery" / name).read_bytes() == (tmp_path / "b/gallery" / name).read_bytes()


def test_what_is_measured_is_not_measured_again_but_other_skills_are_even_of_the_same_run(tmp_path, monkeypatch):
    path = tmp_path / "hopper.pt"
    skills_file(path)
    studied = []

    def study(skills, *_):
        studied.append(1)
        table = pd.DataFrame({"run_id": ["0123456789ab"], "skills_sha256": [gallery.digest(skills)]})
        return {"metrics": table, "paths": table, "visits": table}

    monkeypatch.setattr(gallery, "study", study)
    for _ in range(2):
        assert gallery.main([str(path)]) == 0
    assert len(studied) == 1
    (tmp_path / "hopper.visits.csv").unlink()
    gallery.main([str(path)])
    assert len(studied) == 2
    skills_file(path, num_skills=3)  # the run's id is the same
    gallery.main([str(path)])
    assert len(studied) == 3


def test_where_nothing_can_draw_one_line_says_what_to_install(tmp_path, monkeypatch, capsys):
    path = tmp_path / "hopper.pt"
    skills_file(path)
    monkeypatch.setattr(gallery, "is_measured", lambda *_: True)
    monkeypatch.setenv("MUJOCO_GL", "nothing")
    assert gallery.main([str(path), "--videos", str(tmp_path / "videos")]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "make install-render" in line
    assert list((tmp_path / "videos").iterdir()) == []


def test_cells_are_as_wide_as_the_smallest_gap_between_their_middles():
    middles = pd.Series([0.5, 0.533, 0.567, 0.7])  # thirtieths, written to the millimetre
    assert pictures.spacing(middles) == pytest.approx(1 / 30, rel=0.002)
    assert pictures.spacing(pd.Series([0.5, 0.5])) == 1


def test_bad_input_is_named_in_one_line(tmp_path, capsys):
    path = tmp_path / "hopper.pt"
    assert gallery.main([str(path)]) == 2
    skills_file(path)
    assert gallery.main([str(path), "--paths", "3"]) == 2
    path.write_bytes(path.read_bytes()[:-9])
    assert gallery.main([str(path)]) == 2
    errors = capsys.readouterr().err.splitlines()
    assert len(errors) == 3
    assert "No such file" in errors[0]
    assert "paths=3: must be at least 4, two for each of 2 skills" in errors[1]
    assert "damaged" in errors[2]
    skills_file(path, algo="vic")
    assert gallery.main([str(path)]) == 2
    assert "must hold skills of snn, diayn for ant" in capsys.readouterr().err
    assert pictures.main(["--data", str(tmp_path)]) == 2
    assert "no measured skills" in capsys.readouterr().err


def test_the_page_about_skills_has_the_table_that_the_committed_measurements_give(capsys):
    assert pictures.main(["--table"]) == 0
    page = (pictures.SKILLS.parents[2] / "docs/skills.md").read_text()
    between = page.partition("--table -->\n")[2].partition("<!-- end of table -->")[0]
    assert between == capsys.readouterr().out
