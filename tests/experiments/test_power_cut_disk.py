"""The power cut itself: the image of a live ext4 is copied while a run trains on it, mounted elsewhere, and goes on.

What the kernel had not yet written is not in the copy, as after a cut. The replay in test_power_cut.py needs no
privileges and tries more points; this one asks a real file system.
"""

import contextlib
import os
import random
import shutil
import signal
import subprocess
import sys
import time

import pytest

from experiments import train
from experiments.config import compose_run
from experiments.status import read_status
from tests import ROOT

pytestmark = pytest.mark.slow
ITERATIONS, CUTS, MEGABYTES = 30, 6, 32
SETTINGS = ["algo=ppo", "env=block_hopper", "scale=smoke", f"iterations={ITERATIONS}", "batch_size=400"]
RESULTS = ("progress.csv", "checkpoint.pt")


def written(folder):
    """Lines of a run's log."""
    log = folder / "progress.csv"
    return log.read_bytes().count(b"\n") if log.exists() else 0


def do(*command):
    subprocess.run(command, check=True, capture_output=True)


@contextlib.contextmanager
def mounted(image, place):
    """The file system in `image`, at `place` while the block runs."""
    place.mkdir(exist_ok=True)
    do("mount", "-o", "loop", str(image), str(place))
    try:
        yield place
    finally:
        do("umount", str(place))


@pytest.fixture
def image(tmp_path):
    """An empty ext4 in a file, which can be mounted here."""
    path = tmp_path / "disk.img"
    with path.open("wb") as file:
        file.truncate(MEGABYTES * 2**20)
    try:
        do("mkfs.ext4", "-q", str(path))
        with mounted(path, tmp_path / "try"):
            pass
    except (OSError, subprocess.CalledProcessError) as error:
        said = getattr(error, "stderr", b"") or str(error).encode()
        pytest.skip(f"no loop device can be had here (needs root and mkfs.ext4): {said.decode().strip()}")
    return path


def cut(image, copy, pid):
    """Copy the image as it is at one moment: the process stands still, and a copy that the kernel wrote into is made
    anew."""
    os.kill(pid, signal.SIGSTOP)
    try:
        before = None
        while (now := image.read_bytes()) != before:
            before = now
        copy.write_bytes(now)
    finally:
        os.kill(pid, signal.SIGCONT)


def test_a_run_on_a_disk_whose_power_is_cut_goes_on_to_the_same_bytes(image, tmp_path):
    command = [sys.executable, "-m", "experiments.train", *SETTINGS, f"runs_dir={tmp_path / 'disk'}"]
    # So many lines of the log are there before each cut, and a moment more passes.
    copies, lines, moments = [], range(1, ITERATIONS, ITERATIONS // CUTS), random.Random(0)
    with mounted(image, tmp_path / "disk") as disk:
        run = compose_run(SETTINGS, disk)
        with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL) as process:
            while len(copies) < CUTS and process.poll() is None:
                if written(run.folder) < lines[len(copies)]:
                    time.sleep(0.001)
                    continue
                time.sleep(moments.uniform(0.0, 0.05))
                copies.append(tmp_path / f"{len(copies)}.img")
                cut(image, copies[-1], process.pid)
        assert process.returncode == 0
        whole = {name: (run.folder / name).read_bytes() for name in RESULTS}
    found = []
    for copy in copies:
        with mounted(copy, tmp_path / "elsewhere") as elsewhere:
            again = compose_run(SETTINGS, elsewhere)
            found.append((read_status(again.folder)["state"], written(again.folder)))
            assert train.execute(again) == "finished", found
            assert {name: (again.folder / name).read_bytes() for name in RESULTS} == whole, found
            assert read_status(again.folder)["state"] == "finished"
        copy.unlink()
    print(f"{len(copies)} power cuts, the same bytes after each; state and lines of the log that each left: {found}")
    assert len({lines for _, lines in found}) >= 4
    shutil.rmtree(tmp_path / "elsewhere")
