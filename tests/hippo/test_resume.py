"""A training run killed at ten random moments, three of them inside a checkpoint write, ends at the same bytes."""

import multiprocessing
import os
import random
import signal
import time

import pytest
import torch

from hippo import hippo
from hippo.core.checkpoint import load
from tests.baselines import test_pretraining
from tests.baselines.roam import roam
from tests.hippo.test_training import LEARNERS, learner
from tests.hippo.toy import run

CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(
    ["tests.baselines.test_pretraining", "tests.hippo.test_training", "torch._dynamo"]
)  # imported once; processes are forked from that


def long_hippo():
    """The learner that ten kills try, and how it is run."""
    config = hippo.HippoConfig(iterations=80, batch_size=200, horizon=20, num_skills=3)
    return run, hippo.train, config


def one_of_all(name):
    """A learner of test_training.py or test_pretraining.py, and how it is run."""
    if name in LEARNERS:
        return run, *learner(name, iterations=20, batch_size=200)
    module, config = test_pretraining.METHODS[name]
    return roam, module.train, config(**test_pretraining.SMALL | {"iterations": 20})


def train(folder, die_in_write, ready, made, arguments):
    """Train what `made(*arguments)` says in `folder`; die in a call of fsync.

    Of these every checkpoint has two: its own and its folder's.
    """
    torch.set_num_threads(1)
    real_fsync, writes = os.fsync, 0

    def fsync(descriptor):
        nonlocal writes
        writes += 1
        if writes == die_in_write:
            os.kill(os.getpid(), signal.SIGKILL)
        real_fsync(descriptor)

    os.fsync = fsync
    how, what, config = made(*arguments)
    ready.set()
    how(what, config, folder, death_rate=0.02)


def start(folder, die_in_write=0, made=long_hippo, arguments=()):
    """A process that has just begun to train in `folder`."""
    ready = CONTEXT.Event()
    process = CONTEXT.Process(target=train, args=(folder, die_in_write, ready, made, arguments))
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


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_kills_leave_no_trace_of_any_learner(tmp_path):
    rng, kills = random.Random(1), 0
    one_each = {LEARNERS[name][0]: name for name in reversed(LEARNERS)}.values()  # the first settings of each
    for name in (*one_each, *test_pretraining.METHODS):
        whole, cut = tmp_path / name / "whole", tmp_path / name / "cut"
        assert ended(start(whole, made=one_of_all, arguments=(name,))) == 0
        for checkpoints in (0, rng.randint(1, 3), rng.randint(1, 3)):  # that are written before the kill
            process = start(cut, made=one_of_all, arguments=(name,))
            for _ in range(checkpoints):
                before = checkpointed(cut)
                while process.is_alive() and checkpointed(cut) == before:
                    time.sleep(0.001)
            time.sleep(rng.uniform(0, 0.05))
            process.kill()
            assert ended(process) == -signal.SIGKILL, "the run was over before the kill: make it longer"
            kills += 1
        kept = load(cut / "checkpoint.pt")["iteration"]
        assert ended(start(cut, made=one_of_all, arguments=(name,))) == 0
        files = {path.name for path in whole.iterdir()}  # HIRO ends without its previous checkpoint
        assert {path.name for path in cut.iterdir()} == files >= {"progress.csv", "checkpoint.pt"}
        for file in files - {"timing.csv"}:
            assert (cut / file).read_bytes() == (whole / file).read_bytes(), (name, file)
        print(f"{name}: gone on after iteration {kept}, the same bytes")
    print(f"{kills} kills over all learners")
    assert kills >= 20
