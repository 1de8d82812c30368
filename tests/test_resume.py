"""A training run killed at ten random moments, three of them inside a checkpoint write, ends at the same bytes."""

import random
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

SCRIPT = textwrap.dedent("""
    import os, signal, sys
    from pathlib import Path
    import torch
    torch.set_num_threads(1)
    from hippo import hippo
    from tests.toy import run

    folder, die_in_write = Path(sys.argv[1]), int(sys.argv[2])
    real_fsync = os.fsync
    writes = 0

    def fsync(fd):
        # Two calls per checkpoint: the file before its rename, the folder after it.
        global writes
        writes += 1
        if writes == die_in_write:
            os.kill(os.getpid(), signal.SIGKILL)
        real_fsync(fd)

    os.fsync = fsync
    print("ready", flush=True)
    config = hippo.HippoConfig(iterations=120, batch_size=1000, horizon=20, num_skills=3)
    run(hippo.train, config, folder, death_rate=0.02)
    print("done", flush=True)
""")


def start(folder, die_in_write=0):
    command = [sys.executable, "-c", SCRIPT, str(folder), str(die_in_write)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parent.parent)


def test_ten_kills_leave_no_trace(tmp_path):
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    start(whole).wait(120)
    rng, kills = random.Random(0), 0
    for attempt in range(10):
        inside_a_write = attempt in (2, 5, 8)
        process = start(cut, die_in_write=rng.choice([3, 4, 5, 6]) if inside_a_write else 0)
        assert process.stdout.readline() == "ready\n"
        if not inside_a_write:
            time.sleep(rng.uniform(0.02, 0.25))
            process.send_signal(signal.SIGKILL)
        assert process.wait(60) == -signal.SIGKILL, "the run was over before the kill: make it longer"
        kills += 1
    process = start(cut)
    assert process.communicate(timeout=120)[0] == "ready\ndone\n"
    assert kills == 10
    for name in ("progress.csv", "checkpoint.pt", "checkpoint.prev.pt"):
        assert (cut / name).read_bytes() == (whole / name).read_bytes()
    assert {p.name for p in cut.iterdir()} == {p.name for p in whole.iterdir()}
