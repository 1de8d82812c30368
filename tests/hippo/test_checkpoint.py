"""Checkpoints survive kills, damage and full disks, and cannot carry code."""

import os
import pickle
import random
import signal
import subprocess
import sys
import textwrap
import time

import pytest
import torch

from hippo.core.checkpoint import DIGEST_BYTES, MAGIC, Checkpoint, CheckpointError, load, save

STATE = {"iteration": 3, "tensors": {"w": torch.arange(6.0).view(2, 3), "flag": torch.tensor(True)}, "list": [1, 2.5]}


def test_what_is_saved_is_loaded(tmp_path):
    save(tmp_path / "c.pt", STATE)
    loaded = load(tmp_path / "c.pt")
    assert loaded["iteration"] == 3
    assert loaded["list"] == [1, 2.5]
    assert torch.equal(loaded["tensors"]["w"], STATE["tensors"]["w"])
    assert [p.name for p in tmp_path.iterdir()] == ["c.pt"]


def test_every_one_of_a_hundred_bit_flips_is_detected(tmp_path):
    path = tmp_path / "c.pt"
    save(path, STATE)
    intact = path.read_bytes()
    rng = random.Random(0)
    for _ in range(100):
        damaged = bytearray(intact)
        damaged[rng.randrange(len(damaged))] ^= 1 << rng.randrange(8)
        path.write_bytes(damaged)
        with pytest.raises(CheckpointError):
            load(path)


def test_truncation_at_any_length_is_detected(tmp_path):
    path = tmp_path / "c.pt"
    save(path, STATE)
    intact = path.read_bytes()
    for length in (0, 5, len(MAGIC), len(MAGIC) + DIGEST_BYTES, len(intact) // 2, len(intact) - 1):
        path.write_bytes(intact[:length])
        with pytest.raises(CheckpointError):
            load(path)


def test_a_pickle_with_a_valid_digest_does_not_run(tmp_path):
    import hashlib

    class Payload:
        def __reduce__(self):
            return os.system, (f"touch {tmp_path}/ran",)

    payload = pickle.dumps(Payload())
    (tmp_path / "c.pt").write_bytes(MAGIC + hashlib.sha256(payload).digest() + payload)
    with pytest.raises(CheckpointError, match="is no checkpoint"):
        load(tmp_path / "c.pt")
    assert not (tmp_path / "ran").exists()


def test_a_damaged_checkpoint_falls_back_to_the_previous_one_aloud(tmp_path, capsys):
    checkpoint = Checkpoint(tmp_path)
    assert checkpoint.load() is None
    checkpoint.save({"iteration": 0})
    checkpoint.save({"iteration": 1})
    checkpoint.current.write_bytes(checkpoint.current.read_bytes()[:-1])
    assert checkpoint.load() == {"iteration": 0}
    assert "checkpoint.pt" in capsys.readouterr().err
    checkpoint.previous.write_bytes(b"x")
    with pytest.raises(CheckpointError, match="no intact checkpoint"):
        checkpoint.load()


def test_a_failed_write_leaves_the_old_checkpoint_and_no_temporary_file(tmp_path, monkeypatch):
    checkpoint = Checkpoint(tmp_path)
    checkpoint.save({"iteration": 0})

    def full(fd):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        checkpoint.save({"iteration": 1})
    assert checkpoint.load() == {"iteration": 0}
    assert [p.name for p in tmp_path.iterdir()] == ["checkpoint.pt"]


def test_a_process_killed_while_saving_always_leaves_a_loadable_checkpoint(tmp_path):
    script = textwrap.dedent("""
        import sys, pathlib, torch
        from hippo.core.checkpoint import Checkpoint
        checkpoint = Checkpoint(pathlib.Path(sys.argv[1]))
        state = checkpoint.load()
        i = 0 if state is None else state["iteration"]
        print("ready", flush=True)
        while True:
            i += 1
            checkpoint.save({"iteration": i, "w": torch.full((200_000,), float(i))})
    """)
    last, rng = 0, random.Random(1)
    for _ in range(6):
        process = subprocess.Popen([sys.executable, "-c", script, str(tmp_path)], stdout=subprocess.PIPE)
        process.stdout.readline()
        time.sleep(0.1 + 0.1 * rng.random())
        process.send_signal(signal.SIGKILL)
        process.wait()
        state = Checkpoint(tmp_path).load()
        assert state["iteration"] > last
        assert torch.equal(state["w"], torch.full((200_000,), float(state["iteration"])))
        last = state["iteration"]


def test_what_was_loaded_is_saved_beside_something_new_as_the_same_bytes(tmp_path):
    def fresh():
        return {"state": {0: {"step": torch.ones(1)}}, "groups": [{"rate": 0.1}]}

    save(tmp_path / "whole.pt", {"first": fresh(), "second": fresh()})
    loaded = load(tmp_path / "whole.pt")
    save(tmp_path / "mixed.pt", {"first": loaded["first"], "second": fresh()})
    assert (tmp_path / "mixed.pt").read_bytes() == (tmp_path / "whole.pt").read_bytes()
