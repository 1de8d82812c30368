"""A training run killed at ten random moments, three of them inside a checkpoint write, ends at the same bytes."""

import multiprocessing
import os
import random
import signal
import time

import torch

from hippo import hippo
from tests.toy import run

CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(["hippo.hippo", "torch._dynamo"])  # imported once; processes are forked from that


def train(folder, die_in_write, ready):
    """Train in `folder`; die in a call of fsync, of which every checkpoint has two: its own and its folder's."""
    torch.set_num_threads(1)
    real_fsync, writes = os.fsync, 0

    def fsync(descriptor):
        nonlocal writes
        writes += 1
        if writes == die_in_write:
            os.kill(os.getpid(), signal.SIGKILL)
        real_fsync(descriptor)

    os.fsync = fsync
    ready.set()
    config = hippo.HippoConfig(iterations=80, batch_size=200, horizon=20, num_skills=3)
    run(hippo.train, config, folder, death_rate=0.02)


def start(folder, die_in_write=0):
    """A process that has just begun to train in `folder`."""
    ready = CONTEXT.Event()
    process = CONTEXT.Process(target=train, args=(folder, die_in_write, ready))
    process.start()
    assert ready.wait(60)
    return process


def ended(process):
    """How it ended: 0, or minus the signal that ended it."""
    process.join(120)
    return process.exitcode


def checkpointed(folder):
    """When the last checkpoint was written."""
    path = folder / "checkpoint.pt"
    return path.stat().st_mtime_ns if path.exists() else None


def test_ten_kills_leave_no_trace(tmp_path):
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    assert ended(start(whole)) == 0
    rng = random.Random(0)
    for attempt in range(10):
        inside_a_write, before = attempt in (2, 5, 8), checkpointed(cut)
        process = start(cut, die_in_write=rng.choice([3, 4, 5, 6]) if inside_a_write else 0)
        if not inside_a_write:
            while attempt % 2 and process.is_alive() and checkpointed(cut) == before:
                time.sleep(0.001)
            time.sleep(rng.uniform(0, 0.05))
            process.kill()
        assert ended(process) == -signal.SIGKILL, "the run was over before the kill: make it longer"
    assert ended(start(cut)) == 0
    for name in ("progress.csv", "checkpoint.pt", "checkpoint.prev.pt"):
        assert (cut / name).read_bytes() == (whole / name).read_bytes()
    assert {p.name for p in cut.iterdir()} == {p.name for p in whole.iterdir()}
