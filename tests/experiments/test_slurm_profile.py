"""What a Slurm job asks for: every key reaches sbatch's script and the dry run, which needs no Slurm."""

import re

import pytest
from submitit.slurm.slurm import _make_sbatch_string

from experiments import slurm, sweep
from experiments.config import compose_run
from experiments.slurm_profile import Profile, load_profile
from hippo.core.settings import ConfigError

PROFILE = """
partition: cpu,long
account: lab
qos: low
gres: "gpu:1"
exclude: "node[3-5],node9"
mail: me@example.org
setup:
  - module load python/3.12
  - export PATH="$HOME/bin:$PATH"  # as it is
python: apptainer exec --bind "$HOME" image.sif python
extra: [--exclusive, --licenses=foo:2, "--container-image=docker://nvcr.io#x/y:1"]
"""


@pytest.fixture
def profile(tmp_path):
    (tmp_path / "p.yaml").write_text(PROFILE)
    return load_profile(tmp_path / "p.yaml")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("qos: 'a b'", "profile qos='a b'"),
        ("gres: [gpu]", "profile gres=\\['gpu'\\]"),
        ('exclude: "a\\n#SBATCH --x"', "profile exclude="),
        ("mail: 'me@example.org; rm'", "profile mail="),
        ("setup: module load python", "must be null or a list of lines"),
        ('setup: ["a\\nb"]', "must be one line of text"),
        ('setup: ["a\\rb"]', "must be one line of text"),
        ("setup: ['']", "must be one line of text"),
        ("setup: [1]", "must be one line of text"),
        ("setup: []", "must not be empty"),
        ('python: "a\\nb"', "profile python="),
        ("python: [python]", "profile python="),
        ("extra: --exclusive", "must be null or a list of lines"),
        ("extra: [-x]", "must be --name or --name=value"),
        ("extra: ['--comment=a b']", "without blanks, quotes"),
        ("""extra: ["--comment='a'"]""", "without blanks, quotes"),
        ('extra: ["--comment=a\\n#SBATCH --time=1"]', "must be one line of text"),
        ("extra: ['--comment=$(x)']", "without blanks, quotes"),
        ("extra: [--time=10]", "is what a key of the profile, or the launcher itself, says"),
        ("extra: [--array=0-3]", "is what a key of the profile, or the launcher itself, says"),
        ("extras: [--x]", "did you mean extra?"),
    ],
)
def test_a_profile_that_would_break_the_script_is_one_line(text, message, tmp_path):
    (tmp_path / "p.yaml").write_text(text)
    with pytest.raises(ConfigError, match=message) as caught:
        load_profile(tmp_path / "p.yaml")
    assert "\n" not in str(caught.value)


def test_the_dry_run_shows_every_key_where_there_is_no_slurm_and_writes_nothing(profile, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("PATH", str(tmp_path))
    arguments = ["--name", "lr", "--over", "algo=hippo,ppo", "--set", "iterations=1", "--set", "batch_size=400"]
    on_slurm = ["--launcher", "slurm", "--profile", str(tmp_path / "p.yaml"), "--runs-dir", str(tmp_path / "runs")]
    assert sweep.main(["run", *arguments, *on_slurm, "--dry-run"]) == 0
    said = capsys.readouterr().out
    assert "hippo-lr-smoke: array of 1 jobs, 4 runs" in said
    for word in ("qos low", "gres gpu:1", "exclude node[3-5],node9", "mail me@example.org", "time_minutes 240"):
        assert word in said
    for line in (*profile.setup, profile.python, *profile.extra):
        assert f": {line}\n" in said
    assert "0 already queued or running, 4 to submit" in said
    assert not (tmp_path / "runs").exists()
    assert sweep.main(["run", *arguments, *on_slurm]) == 2
    assert "needs Slurm's sbatch" in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()


@pytest.fixture
def submitted(monkeypatch, tmp_path):
    """What submitit is given instead of a cluster: the executor's arguments, the script, the number of jobs."""
    given = {}

    class Executor:
        def __init__(self, folder, cluster, slurm_max_num_timeout, slurm_python=None):
            given["python"] = slurm_python

        def update_parameters(self, **parameters):
            plain = {k.removeprefix("slurm_"): v for k, v in parameters.items()}
            names = {"name": "job_name", "timeout_min": "time", "mem_gb": "mem", "tasks_per_node": "ntasks_per_node"}
            given["script"] = _make_sbatch_string("x", tmp_path, **{names.get(k, k): v for k, v in plain.items()})

        def map_array(self, job, groups):
            given["jobs"] = len(groups)
            return [type("Job", (), {"job_id": "77_0"})]

    monkeypatch.setattr(slurm.submitit, "AutoExecutor", Executor)
    monkeypatch.setattr(slurm, "snapshot", lambda folder: folder / "code")
    monkeypatch.setattr(slurm, "max_array_size", lambda: 100)
    monkeypatch.setattr(slurm, "_ask", lambda *command: "")
    return given


def test_every_key_reaches_the_script_and_the_job_says_what_it_is(profile, submitted, tmp_path):
    run = compose_run(["env=block_hopper", "scale=smoke"], tmp_path / "runs")
    assert slurm.submit([run], tmp_path / "runs", profile, False, "fig3-laptop") == 1
    lines = submitted["script"].splitlines()
    options = dict(line.removeprefix("#SBATCH --").partition("=")[::2] for line in lines if line.startswith("#SBATCH"))
    wanted = {"qos": "low", "gres": "gpu:1", "exclude": "'node[3-5],node9'", "account": "lab", "partition": "cpu,long"}
    wanted |= {"mail-user": "me@example.org", "mail-type": "END,FAIL", "exclusive": "", "licenses": "foo:2"}
    wanted |= {"container-image": "'docker://nvcr.io#x/y:1'", "requeue": "", "time": "240", "ntasks-per-node": "1"}
    assert {key: options.get(key) for key in wanted} == wanted
    assert re.fullmatch("hippo-fig3-laptop-[0-9a-f]{10}", options["job-name"])
    first = lines.index("# setup") + 1
    assert lines[first : first + 2] == profile.setup
    assert lines[first + 2].startswith("export PYTHONPATH=")  # not for modules to undo
    assert submitted["python"] == profile.python


def test_what_is_not_said_is_not_asked_for(submitted, tmp_path):
    run = compose_run(["env=block_hopper", "scale=smoke"], tmp_path / "runs")
    slurm.submit([run], tmp_path / "runs", Profile(), False)
    for word in ("qos", "gres", "exclude", "mail", "partition", "account"):
        assert f"--{word}" not in submitted["script"]
    assert submitted["python"] is None


def test_cancelling_takes_the_jobs_of_one_plan_in_one_runs_folder_only(tmp_path, monkeypatch, capsys):
    asked = []
    (tmp_path / "slurm/batches").mkdir(parents=True)
    names = [
        "hippo-lr-smoke-aaaaaaaaaa",
        "hippo-lr-smoke-bbbbbbbbbb",
        "hippo-lr_2-smoke-cccccccccc",
        "hippo-dddddddddd",
    ]
    for name in names:
        (tmp_path / f"slurm/batches/{name}.json").write_text('[["r1"], ["r2"]]')
    queue = [
        f"0|7|PENDING|{names[0]}",
        f"1|7|RUNNING|{names[0]}",
        f"N/A|8|RUNNING|{names[1]}",
        f"0|9|RUNNING|{names[2]}",
    ]
    queue += [f"0|10|RUNNING|{names[3]}", "0|11|RUNNING|hippo-lr-smoke-eeeeeeeeee", f"2|7|COMPLETED|{names[0]}"]
    monkeypatch.setattr(slurm, "_ask", lambda *command: asked.append(command) or "\n".join(queue))
    assert slurm.cancel("lr-smoke", tmp_path) == 3
    assert asked[-1] == ("scancel", "7_0", "7_1", "8")
    assert len(asked) == 2
    assert slurm.cancel("fig3-smoke", tmp_path) == 0
    assert slurm.cancel("lr-smoke", tmp_path / "elsewhere") == 0
    assert len(asked) == 3
    assert not (tmp_path / "elsewhere").exists()


def test_a_figure_s_jobs_are_cancelled_by_its_name_and_edition(tmp_path, monkeypatch, capsys):
    labels = []
    monkeypatch.setattr(slurm, "cancel", lambda label, runs_dir: labels.append(label) or 2)
    for more in ([], ["--scale", "laptop"], ["--set", "algo.gamma=0.9"]):
        assert sweep.main(["cancel", "fig7", "--runs-dir", str(tmp_path), *more]) == 0
    assert labels[:2] == ["fig7-smoke", "fig7-laptop"]
    assert re.fullmatch(r"fig7\+[0-9a-f]{8}-smoke-overridden", labels[2])
    assert "fig7: 2 jobs cancelled" in capsys.readouterr().out
    assert sweep.main(["cancel", "fig33"]) == 2
