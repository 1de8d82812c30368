"""What is outside a run leaves it alone: its terminal, its shell, signals that come twice, a file system's locks."""

import contextlib
import errno
import fcntl
import os
import shutil
import signal
import subprocess
import sys
import time

import psutil
import pytest

from experiments import slurm, status, sweep, train
from experiments.config import compose_run
from experiments.console import Console, unattended
from experiments.status import Status, locked, read_status
from tests import ROOT

TINY = ["env=block_hopper", "scale=smoke", "iterations=2", "batch_size=400"]


@pytest.fixture
def tiny_run(tmp_path):
    return compose_run([*TINY, f"runs_dir={tmp_path}"])


@contextlib.contextmanager
def nobody_reads():
    """A file descriptor of a pipe whose reader has gone."""
    reader, writer = os.pipe()
    os.close(reader)
    yield writer
    os.close(writer)


@pytest.mark.parametrize(
    "command",
    [
        ["analysis.explain", "paper_figures/data/laptop/fig3.csv"],
        ["analysis.claims", "--help"],
        ["paper_figures.compare", "--help"],
        ["experiments.sweep", "status", "fig3", "--runs-dir", "nowhere"],
    ],
)
def test_a_command_whose_reader_has_gone_ends_quietly(command):
    with nobody_reads() as pipe:
        result = subprocess.run([sys.executable, "-m", *command], cwd=ROOT, stdout=pipe, stderr=subprocess.PIPE)
    assert result.stderr == b""
    assert result.returncode in (-signal.SIGPIPE, 128 + signal.SIGPIPE)


def test_every_command_of_experiments_ends_as_all_others():
    commands = [path for path in (ROOT / "experiments").rglob("*.py") if "__main__" in path.read_text()]
    assert len(commands) > 10
    assert [path.name for path in commands if "    run_command(main)\n" not in path.read_text()] == []


@pytest.mark.parametrize("module", ["experiments.train", "experiments.evaluate"])
def test_ctrl_c_while_modules_are_imported_ends_quietly(module, tmp_path):
    (tmp_path / "torch.py").write_text("import os, signal, time\nos.kill(os.getpid(), signal.SIGINT)\ntime.sleep(9)")
    result = subprocess.run(
        [sys.executable, "-m", module],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(tmp_path)},
        capture_output=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    assert (result.returncode, result.stdout, result.stderr) == (-signal.SIGINT, b"", b"")


def test_a_run_goes_on_without_its_terminal_and_its_log_has_every_line(tmp_path):
    arguments = ["env=block_hopper", "scale=smoke", "iterations=20", "batch_size=400", f"runs_dir={tmp_path}"]
    run = compose_run(arguments)
    with nobody_reads() as pipe:
        process = subprocess.Popen(
            [sys.executable, "-m", "experiments.train", *arguments], cwd=ROOT, stdout=pipe, stderr=pipe
        )
        while not (run.folder / "checkpoint.pt").exists():
            assert process.poll() is None
            time.sleep(0.01)
        process.send_signal(signal.SIGHUP)
        assert process.wait(60) == 0
    assert read_status(run.folder)["state"] == "finished"
    log = (run.folder / "train.log").read_text().splitlines()
    assert ["iteration" in line for line in log] == [True] * 20 + [False]
    assert log[-1] == train.what_next(run)


def test_a_terminal_that_takes_nothing_keeps_nobody_waiting(tmp_path):
    reader, writer = os.pipe()
    fcntl.fcntl(writer, fcntl.F_SETPIPE_SZ, 4096)
    with open(writer, "w") as terminal, (tmp_path / "log").open("w") as log:
        console = Console(terminal, log)
        for i in range(1000):
            print(f"line {i}", file=console)
        assert os.read(reader, 6) == b"line 0"
        os.close(reader)
        print("the last", file=console)
    assert (tmp_path / "log").read_text().splitlines() == [*(f"line {i}" for i in range(1000)), "the last"]


def test_what_already_goes_to_the_log_is_there_once(tmp_path):
    with (tmp_path / "log").open("a") as stream, contextlib.redirect_stdout(stream), unattended(tmp_path / "log"):
        print("once")
    assert (tmp_path / "log").read_text() == "once\n"


def test_a_run_in_the_background_outlives_its_shell(tmp_path):
    arguments = ["env=block_hopper", "scale=smoke", "iterations=30", "batch_size=400", f"runs_dir={tmp_path}"]
    run = compose_run(arguments)
    quick = f"from experiments import status, train; status.HEARTBEAT_SECONDS = 0.02; train.main({arguments})"
    shell = 'nohup "$0" -c "$1" > /dev/null 2>&1 & while [ ! -e "$2/checkpoint.pt" ]; do sleep 0.01; done'
    subprocess.run(["bash", "-c", shell, sys.executable, quick, str(run.folder)], cwd=ROOT, check=True, timeout=60)
    iteration = read_status(run.folder)["iteration"]
    assert iteration < 29
    while (state := read_status(run.folder)["state"]) == "running":
        time.sleep(0.05)
    assert state == "finished"


def test_the_workers_of_a_sweep_end_with_it(tmp_path):
    script = tmp_path / "quick_sweep.py"  # workers import it again
    script.write_text(
        "import sys\nfrom experiments import status, sweep\nstatus.HEARTBEAT_SECONDS = 0.02\n"
        "if __name__ == '__main__':\n    sys.exit(sweep.main(sys.argv[1:]))\n"
    )
    settings = ["--runs-dir", str(tmp_path / "runs"), "--workers", "1", "--yes", "--set", "iterations=5000"]
    process = subprocess.Popen(
        [sys.executable, str(script), "run", "fig3", *settings],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stdout=subprocess.DEVNULL,
    )
    while not (found := list((tmp_path / "runs").glob("*/checkpoint.pt"))):
        assert process.poll() is None
        time.sleep(0.05)
    worker = psutil.Process(read_status(found[0].parent)["pid"])
    process.kill()
    process.wait()
    worker.wait(30)
    assert read_status(found[0].parent)["message"] == "stopped by SIGTERM; start it again to continue"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_stopped_run_names_the_signal_and_a_second_one_disturbs_nothing(number, tiny_run, monkeypatch, capsys):
    monkeypatch.setitem(train.WORK, "train", lambda *_: os.kill(os.getpid(), number))
    end = Status.end

    def disturbed_end(*arguments, **changes):
        os.kill(os.getpid(), number)
        end(*arguments, **changes)

    monkeypatch.setattr(Status, "end", disturbed_end)
    handlers = signal.signal(signal.SIGINT, signal.default_int_handler), signal.getsignal(signal.SIGTERM)
    try:
        assert train.execute(tiny_run) == "preempted"
    finally:
        signal.signal(signal.SIGINT, handlers[0])
    assert signal.getsignal(signal.SIGTERM) is handlers[1]
    message = f"stopped by {number.name}; start it again to continue"
    assert read_status(tiny_run.folder)["message"] == message
    assert capsys.readouterr().err == f"preempted: {message}\n"


def test_a_stop_whose_exception_was_lost_is_heard_at_the_next_iteration(tiny_run, monkeypatch):
    content = Status.update

    def update(self, **changes):
        content(self, **changes)
        if changes.get("iteration") == 0:
            with contextlib.suppress(train.Preempted):  # as Python does when a finaliser raises
                os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(Status, "update", update)
    assert train.execute(tiny_run) == "preempted"


def test_temporary_files_of_processes_that_are_gone_are_removed_at_the_next_start(tiny_run, monkeypatch):
    monkeypatch.setitem(train.WORK, "train", lambda *_: None)
    gone = subprocess.Popen(["true"])
    gone.wait()
    tiny_run.folder.mkdir()
    for pid in (gone.pid, os.getppid()):
        (tiny_run.folder / f"status.json.{pid}.tmp").write_text("{")
    assert train.execute(tiny_run) == "finished"
    assert [path.name for path in tiny_run.folder.glob("*.tmp")] == [f"status.json.{os.getppid()}.tmp"]


@pytest.fixture
def no_locks(monkeypatch, request):
    """As on an NFS export that is mounted with `nolock`."""

    def flock(*_):
        raise OSError(request.param, os.strerror(request.param))

    monkeypatch.setattr(fcntl, "flock", flock)


ANSWERS = [errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP]


@pytest.mark.parametrize("no_locks", ANSWERS, indirect=True)
def test_a_file_system_without_locks_is_refused_in_one_line(no_locks, tmp_path, capsys):
    folder = tmp_path / "runs"
    for command in (
        lambda: train.main([*TINY, f"runs_dir={folder}"]),
        lambda: sweep.main(["run", "fig3", "--yes", "--runs-dir", str(folder)]),
    ):
        assert command() == 1
        error = capsys.readouterr().err
        assert error.startswith("error: ")
        assert error.count("\n") == 1
        assert "runs_dir=FOLDER" in error
        assert f"{status.SOFT_LOCKS}=1" in error
    assert not list(folder.rglob("status.json"))


@pytest.mark.parametrize("no_locks", ANSWERS, indirect=True)
def test_soft_locks_stand_in_where_they_are_asked_for(no_locks, tiny_run, monkeypatch, capsys):
    monkeypatch.setenv(status.SOFT_LOCKS, "1")
    monkeypatch.setitem(train.WORK, "train", lambda *_: None)
    tiny_run.folder.mkdir()
    with locked(tiny_run.folder / ".lock"):
        assert train.execute(tiny_run) == "running"
        assert f"If it is gone, delete {tiny_run.folder / '.lock.soft'}" in capsys.readouterr().out
        status.mark_lost(tiny_run, "killed")
        assert read_status(tiny_run.folder)["state"] == "missing"
    assert train.execute(tiny_run) == "finished"
    assert not (tiny_run.folder / ".lock.soft").exists()


def test_without_scontrol_a_job_at_its_time_limit_says_so_and_its_run_stays_resumable(tiny_run, monkeypatch, capsys):
    (tiny_run.runs_dir / "bin").mkdir()
    (tiny_run.runs_dir / "bin/git").symlink_to(str(shutil.which("git")))
    monkeypatch.setenv("PATH", str(tiny_run.runs_dir / "bin"))
    monkeypatch.setenv("SLURM_JOB_ID", "7")
    with monkeypatch.context() as at_the_limit:
        at_the_limit.setitem(train.WORK, "train", lambda *_: os.kill(os.getpid(), signal.SIGUSR2))
        with pytest.raises(RuntimeError, match="not finished"):
            slurm.Job(tiny_run.runs_dir)([tiny_run.to_yaml()])
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "scontrol" in line]
    assert line.startswith("not requeued, which needs scontrol here")
    assert line.endswith("`sweep run` continues it")
    assert read_status(tiny_run.folder)["state"] == "preempted"
    assert slurm.Job(tiny_run.runs_dir)([tiny_run.to_yaml()]) == {tiny_run.run_id: "finished"}
