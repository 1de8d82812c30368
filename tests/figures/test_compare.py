"""Any runs beside each other: methods by what differs, never of two scales or two kinds of physics."""

import json

import pytest
import yaml

from paper_figures import compare


def run_folder(root, run_id, rows=2, kind="train", scale="smoke", **identity):
    """A run folder as training leaves it, as far as comparing reads it; two iterations of ten steps."""
    whole = {"algo": "ppo", "settings": {}, "env": "block_hopper", "options": {}, "seed": 0}
    whole |= {"iterations": 2, "batch_size": 10} | identity
    folder = root / run_id
    folder.mkdir(parents=True)
    config = yaml.safe_dump({"kind": kind, "scale": scale})
    manifest = {"run_id": run_id, "identity": whole, "config": config, "git_commit": "c" * 40}
    (folder / "manifest.json").write_text(json.dumps(manifest))
    lines = "".join(f"{i},{10 * i + 10},{i}\n" for i in range(rows))
    (folder / "progress.csv").write_text("iteration,env_steps,return_mean\n" + lines)
    return folder


def compared(tmp_path, *folders):
    """Exit code of comparing `folders`."""
    return compare.main([*map(str, folders), "--out", str(tmp_path / "out")])


def test_runs_that_differ_in_their_seed_alone_are_one_method_and_settings_name_the_others(tmp_path, capsys):
    folders = [run_folder(tmp_path, f"a{seed}", seed=seed) for seed in (0, 1)]
    folders.append(run_folder(tmp_path, "b", rows=1, settings={"gamma": 0.9}))
    assert compared(tmp_path, *folders, folders[0]) == 0  # the same run twice is one run
    caption = (tmp_path / "out/smoke/compare.caption.txt").read_text()
    assert (
        "Last 10 % of iterations, mean ± standard deviation over seeds, Block Hopper: ppo 1 ± 0; ppo gamma=0.9 0."
        in caption
    )
    assert "incomplete: block_hopper ppo gamma=0.9 seed 0" in capsys.readouterr().out
    assert (tmp_path / "out/smoke/compare.csv").read_text().count("\n") == 1 + 2 + 2 + 1
    assert (tmp_path / "out/smoke/compare.png").stat().st_size > 1000


@pytest.mark.parametrize(
    ("other", "message"),
    [
        ({"scale": "paper"}, "of more than one scale (paper, smoke)"),
        ({"options": {"physics": "fast"}}, "block_hopper: of more than one physics (fast, paper)"),
        ({"kind": "evaluate"}, "is a run of kind evaluate"),
    ],
)
def test_what_must_not_be_drawn_together_is_refused_in_one_line(other, message, tmp_path, capsys):
    folders = [run_folder(tmp_path, "a"), run_folder(tmp_path, "b", **other)]
    assert compared(tmp_path, *folders) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_folder_of_no_run_and_a_run_without_a_row_are_named(tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    assert compared(tmp_path, tmp_path / "empty") == 2
    assert "is no run folder" in capsys.readouterr().err
    assert compared(tmp_path, run_folder(tmp_path, "a", rows=0)) == 2
    assert "none of them has a row yet" in capsys.readouterr().err
