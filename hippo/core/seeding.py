"""One tree of random streams per run: a purpose and its indices name a stream, so no stream can disturb another.

A stream is derived from (run seed, purpose, indices) alone. Learners ask for a new stream at every iteration, which
leaves nothing random to save in a checkpoint and makes a resumed run equal to an uninterrupted one by construction.
"""

import hashlib

import numpy as np
import torch


def stream(seed: int, purpose: str, *indices: int) -> np.random.SeedSequence:
    """The seed sequence of one purpose, e.g. `stream(seed, "policy", iteration)`."""
    name = int.from_bytes(hashlib.sha256(purpose.encode()).digest()[:8], "little")
    return np.random.SeedSequence(entropy=seed, spawn_key=(name, *indices))


def integer(seed: int, purpose: str, *indices: int) -> int:
    """A 63-bit seed for libraries that take a plain integer."""
    return int(stream(seed, purpose, *indices).generate_state(1, np.uint64)[0] >> np.uint64(1))


def numpy_generator(seed: int, purpose: str, *indices: int) -> np.random.Generator:
    """A numpy generator on its own stream."""
    return np.random.Generator(np.random.PCG64(stream(seed, purpose, *indices)))


def torch_generator(seed: int, purpose: str, *indices: int) -> torch.Generator:
    """A torch (CPU) generator on its own stream."""
    return torch.Generator().manual_seed(integer(seed, purpose, *indices))
