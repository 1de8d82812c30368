"""What a plan promises: each run once, parents first, what it costs; what is retried; a full disk."""

import dataclasses
import functools
import json
import os
import subprocess

import pytest

from experiments import config, costs, launchers, sweep, train
from experiments.config import compose_run
from experiments.plan import make_plan, overview, summary
from experiments.status import Status, read_status

TINY = ["env=block_hopper", "scale=smoke", "iterations=2", "batch_size=400"]
SETTINGS = ["iterations=1", "batch_size=400", "env.horizon=50"]
FIGURES = {
    "one": {
        "title": "one",
        "environments": ["block_hopper", "snake_gather"],
        "not_trained": {"smoke": ["snake_gather"]},
        "environment_settings": {"block_hopper": ["env.terminate_on_fall=true"]},
        "variants": {"a": {"label": "A", "algo": "hippo"}, "b": {"label": "B", "algo": "ppo"}},
    },
    "two": {
        "title": "two",
        "kind": "evaluate",
        "evaluation": {"episodes": 3, "perturbations": ["mass", "friction"], "strengths": ["all"]},
        "environments": ["block_hopper"],
        "environment_settings": {"block_hopper": ["env.terminate_on_fall=true"]},
        "variants": {"a": {"label": "A", "algo": "hippo"}},
    },
}


@pytest.fixture(autouse=True)
def figures(monkeypatch):
    """Two figures, of which the second looks at half of the first's runs."""
    monkeypatch.setattr("experiments.plan.load_figure", FIGURES.__getitem__)


@pytest.fixture
def measured(monkeypatch):
    """What was measured; a step costs 0.1 ms."""
    names = []

    def measure(run):
        names.append((run.algo, run.env))
        return costs.Cost(1e-4, 100_000, 600, "2026-01-01")

    monkeypatch.setattr(costs, "measure", measure)
    return names


def plan(figure, tmp_path):
    return make_plan(figure, "smoke", SETTINGS, False, tmp_path)


# ------------------------------------------------------------------------------------------------- what there is to do


def test_a_figure_leaves_out_environments_and_gives_others_their_own_settings(tmp_path):
    one = plan("one", tmp_path)
    assert [(e.run.env, e.variant, e.run.seed) for e in one.entries] == [
        ("block_hopper", variant, seed) for variant in "ab" for seed in (0, 1)
    ]
    assert all(e.run.options == {"terminate_on_fall": True} for e in one.entries)
    written = json.loads(one.write(tmp_path).read_text())
    assert written["not_trained"] == [{"env": "snake_gather", "env_label": "Snake Gather"}]


def test_one_run_of_a_figure_can_be_picked_and_brings_what_it_needs(tmp_path, capsys):
    arguments = ["run", "two", "--runs-dir", str(tmp_path), *(f"--set={s}" for s in SETTINGS)]
    wanted, other = (e.run for e in make_plan("two", "smoke", SETTINGS, False, tmp_path).entries)
    assert sweep.main([*arguments, "--only", wanted.run_id]) == 0
    assert wanted.parent is not None
    done = {path.parent.name for path in tmp_path.glob("*/status.json")}
    assert done == {wanted.run_id, wanted.parent.run_id}
    assert sweep.main([*arguments, "--only", "nonsense"]) == 2
    error = capsys.readouterr().err
    assert "only=nonsense" in error
    assert other.run_id in error


def test_whole_comparisons_come_one_after_another_in_the_environments_asked_for(tmp_path, monkeypatch):
    monkeypatch.setitem(FIGURES["one"], "environments", ["block_hopper", "block_half_cheetah", "ant_gather"])
    begun = []
    monkeypatch.setattr(sweep, "run_locally", functools.partial(one_after_another, begun))
    arguments = ["run", "one", "--runs-dir", str(tmp_path), "--order", "seeds"]
    assert sweep.main([*arguments, "--env", "block_half_cheetah,block_hopper"]) == 0
    assert [(run.seed, run.env, run.algo) for run in begun] == [
        (seed, env, algo)
        for seed in (0, 1)
        for env in ("block_half_cheetah", "block_hopper")
        for algo in ("hippo", "ppo")
    ]
    written = json.loads((tmp_path / "plans/smoke/one.json").read_text())["runs"]
    assert {run["env"] for run in written} == {"block_hopper", "block_half_cheetah", "ant_gather"}
    assert {run["state"] for run in written if run["env"] != "ant_gather"} == {"finished"}


def one_after_another(begun, todo, workers, on_change, in_order):
    """Stands in for the pool."""
    begun += todo if in_order else []
    return {run.run_id: "finished" for run in todo}


def test_the_pool_takes_the_longest_first_after_what_others_need_unless_it_is_to_keep_the_order(tmp_path):
    short, long, middle = (compose_run([*TINY, f"iterations={n}", f"runs_dir={tmp_path}"]) for n in (1, 3, 2))
    after = dataclasses.replace(short, kind="measure")
    runs = [short, after, long, middle]
    assert launchers.queue_of(runs, in_order=True) == runs
    assert launchers.queue_of(runs, in_order=False) == [short, long, after, middle]  # measuring takes two batches


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--env", "snake_gather"], "env=snake_gather: valid: block_hopper"),
        (["--env", "block_hopper,"], "env=: valid: block_hopper"),
        (["--order", "env"], "order=env: valid: longest, seeds"),
        (["--order", "seeds", "--launcher", "slurm"], "order=seeds: valid: longest"),
    ],
)
def test_an_environment_or_order_that_does_not_exist_is_refused_in_one_line(arguments, message, tmp_path, capsys):
    assert sweep.main(["run", "one", *arguments, "--runs-dir", str(tmp_path / "runs")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()


def test_an_evaluation_depends_on_the_trained_run_of_another_figure(tmp_path):
    one, two = plan("one", tmp_path), plan("two", tmp_path)
    parents = [e.run.parent for e in two.entries]
    assert [p.run_id for p in parents] == [e.run.run_id for e in one.entries if e.variant == "a"]
    todo = two.todo()
    assert [run.kind for run in todo] == ["train", "evaluate"] * 2
    assert [run.env_steps for run in todo] == [400, 3 * 3 * 50] * 2  # the original and two changed environments
    todo[0].folder.mkdir()
    Status(todo[0]).end("finished", results={})
    assert [run.kind for run in plan("two", tmp_path).todo()] == ["evaluate", "train", "evaluate"]


def test_the_overview_counts_shared_runs_once_and_costs_what_was_measured(tmp_path, measured):
    lines = overview([plan("one", tmp_path), plan("two", tmp_path)], workers=2).splitlines()
    assert measured == [("hippo", "block_hopper"), ("ppo", "block_hopper")]
    table = {line.split()[0]: line.split()[1:] for line in lines[1:4]}
    # runs, shared, done, running, preempted, failed, missing, then 1600 and 1700 steps; 2 of one's 4 runs are shared
    assert table["one"][:7] == ["4", "2", "0", "0", "0", "0", "4"]
    assert table["two"][:7] == ["4", "2", "0", "0", "0", "0", "4"]
    assert table["together"][:7] == ["6", "2", "0", "0", "0", "0", "6"]
    steps = {name: round(sum(run.env_steps for run in plan(name, tmp_path).todo())) for name in ("one", "two")}
    assert steps == {"one": 1600, "two": 2 * 400 + 2 * 450}
    assert "wall-clock with 2 processes" in lines[4]
    overview([plan("one", tmp_path)], workers=2)
    assert len(measured) == 2  # remembered


def test_a_preempted_run_is_counted_as_such_and_not_as_failed(tmp_path, measured):
    for entry, state in zip(
        plan("one", tmp_path).entries, ("preempted", "failed", "diverged", "preempted"), strict=True
    ):
        entry.run.folder.mkdir(parents=True)
        Status(entry.run).end(state)
    one = plan("one", tmp_path)
    head, line, *_ = overview([one], workers=2).splitlines()
    counts = dict(zip(head.split()[:8], line.split()[:8], strict=True))
    assert (counts["preempted"], counts["failed"], counts["missing"]) == ("2", "2", "0")
    assert "(1 diverged, 1 failed, 2 preempted)" in summary(one)


def test_a_short_training_measures_time_and_size(tmp_path):
    run = compose_run([*TINY, f"runs_dir={tmp_path / 'runs'}"])
    (cost,) = (costs.Cost(**entry) for entry in costs.calibrate([run]).values())
    assert 1e-6 < cost.seconds_per_step < 1e-2
    assert cost.checkpoint_bytes > 50_000
    assert 200 < cost.row_bytes < 5_000
    assert not (tmp_path / "runs").exists()
    assert costs.cost(run) == cost
    assert costs.seconds(run) == 800 * cost.seconds_per_step


def test_a_plan_composes_every_variant_once_and_asks_hydra_once_per_environment_and_algorithm(tmp_path, monkeypatch):
    composed, asked = [], config._base.cache_info().misses
    monkeypatch.setattr("experiments.plan.compose_run", lambda *a: composed.append(a) or compose_run(*a))
    made = make_plan("one", "paper", [], False, tmp_path)
    assert len(made.entries) == 2 * 2 * 5
    assert len(composed) == 2 * 2  # not once more per seed
    assert config._base.cache_info().misses <= asked + 2 * 2
    make_plan("one", "paper", [], False, tmp_path)
    assert config._base.cache_info().misses <= asked + 2 * 2


# ---------------------------------------------------------------------------------------------------------- dependency


def test_what_depends_on_a_run_waits_for_it_and_fails_with_it(tmp_path, monkeypatch):
    two = plan("two", tmp_path)
    todo = two.todo()
    assert launchers.run_locally(todo, 2, lambda *_: None) == {run.run_id: "finished" for run in todo}
    rows = (todo[1].folder / "episodes.csv").read_text().splitlines()
    assert len(rows) == 1 + 3 * 3
    bad = [dataclasses.replace(run, runs_dir=tmp_path / "b") for run in todo]
    for run in (bad[0], bad[2]):
        run.folder.mkdir(parents=True)
        (run.folder / "checkpoint.pt").write_text("damaged")
    states = launchers.run_locally(bad, 2, lambda *_: None)
    assert set(states.values()) == {"failed"}
    assert not bad[1].folder.exists()


# --------------------------------------------------------------------------------------------------------------- retry


def test_retry_takes_what_the_machine_made_fail_and_only_so_often(tmp_path, capsys):
    one = plan("one", tmp_path)
    ends = [("failed", "infrastructure"), ("failed", "error"), ("diverged", ""), ("preempted", "")]
    for entry, (state, cause) in zip(one.entries, ends, strict=True):
        entry.run.folder.mkdir(parents=True)
        Status(entry.run).end(state, "why", cause=cause)
    one = plan("one", tmp_path)
    assert sweep.may_retry(one) == [one.entries[0].run, one.entries[3].run]
    arguments = ["--runs-dir", str(tmp_path), *(x for s in SETTINGS for x in ("--set", s))]
    assert sweep.main(["status", "one", *arguments]) == 0
    table = capsys.readouterr().out
    assert "2 to try again: python -m experiments.sweep retry one --scale smoke" in table
    assert f"why (log: {one.entries[0].run.folder / 'train.log'})" in table
    assert sweep.main(["retry", "one", *arguments]) == 1  # two are done now, two are not to be retried
    assert [read_status(e.run.folder)["state"] for e in one.entries] == ["finished", "failed", "diverged", "finished"]
    assert read_status(one.entries[0].run.folder)["attempts"] == 2
    for _ in range(2):
        Status(one.entries[0].run).end("preempted")
    assert sweep.may_retry(one) == []


# ------------------------------------------------------------------------------------------------------------ manifest


def test_a_manifest_rebuilds_the_same_run_and_the_same_bytes(tmp_path, capsys):
    run = compose_run([*TINY, "seed=3", "algo.period_min=2", f"runs_dir={tmp_path / 'a'}"])
    assert train.execute(run) == "finished"
    manifest = run.folder / "manifest.json"
    assert train.main(["--from-manifest", str(manifest), f"runs_dir={tmp_path / 'b'}"]) == 0
    again = tmp_path / "b" / run.run_id
    for name in ("progress.csv", "checkpoint.pt", "config.yaml"):
        assert (again / name).read_bytes() == (run.folder / name).read_bytes()


def test_a_manifest_of_other_code_or_no_manifest_is_refused(tmp_path, capsys, monkeypatch):
    run = compose_run([*TINY, f"runs_dir={tmp_path / 'a'}"])
    assert train.execute(run) == "finished"
    manifest = run.folder / "manifest.json"
    monkeypatch.setattr("hippo.hippo.REVISION", 99)
    for arguments, message in (
        ([str(manifest), f"runs_dir={tmp_path / 'b'}"], "algo_revision: 1 there, 99 here"),
        ([str(tmp_path / "none.json")], "must be a run's manifest.json"),
        ([str(run.folder / "progress.csv")], "must be a run's manifest.json"),
        ([str(manifest), "seed=1"], "takes a manifest.json and at most runs_dir=FOLDER"),
    ):
        assert train.main(["--from-manifest", *arguments]) == 2
        assert message in capsys.readouterr().err
    assert not (tmp_path / "b").exists()


# ----------------------------------------------------------------------------------------------------------- full disk


@pytest.fixture
def small_disk(tmp_path):
    """A file system of 1 MB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(folder)], check=False).returncode
    if mounted != 0:
        pytest.skip("mounting a small file system needs root")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def test_a_full_disk_fails_the_run_clearly_and_it_goes_on_once_there_is_space(
    small_disk, tmp_path, capsys, monkeypatch
):
    reference = compose_run([*TINY, "iterations=4", f"runs_dir={tmp_path / 'reference'}"])
    assert train.execute(reference) == "finished"
    run = dataclasses.replace(reference, runs_dir=small_disk)
    ballast = small_disk / "ballast"
    save = train.Checkpoint.save

    def fill_then_save(self, state):
        if state["iteration"] == 2 and not ballast.exists():
            free = os.statvfs(small_disk)
            ballast.write_bytes(bytes(free.f_bavail * free.f_bsize - 8192))
        save(self, state)

    monkeypatch.setattr(train.Checkpoint, "save", fill_then_save)
    assert train.execute(run) == "failed"
    assert "No space left on device" in capsys.readouterr().err
    assert not list(small_disk.rglob("*.tmp"))
    assert train.Checkpoint(run.folder).load()["iteration"] == 1
    assert train.execute(run) == "failed"  # still no space
    assert not list(small_disk.rglob("*.tmp"))
    ballast.unlink()
    monkeypatch.setattr(train.Checkpoint, "save", save)
    assert train.execute(run) == "finished"
    assert (run.folder / "progress.csv").read_bytes() == (reference.folder / "progress.csv").read_bytes()


@pytest.mark.slow
def test_a_full_disk_under_a_sweep_stops_the_launching_and_the_same_command_goes_on(small_disk, capsys):
    runs = [compose_run([*TINY, "iterations=1", f"seed={seed}"], small_disk) for seed in range(2)]
    free = os.statvfs(small_disk)
    (small_disk / "ballast").write_bytes(bytes(free.f_bavail * free.f_bsize))
    states = launchers.run_locally(runs, 1, lambda *_: None)
    first, second = states.values()
    assert first in ("failed", "lost")  # on a full disk its process may not even be able to say so
    assert second == "missing"
    assert f"no space left on the disk of {small_disk}: 1 runs are not started" in capsys.readouterr().err
    (small_disk / "ballast").unlink()
    assert set(launchers.run_locally(runs, 1, lambda *_: None).values()) == {"finished"}
