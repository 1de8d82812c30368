"""Passes over a batch in shuffled minibatches, as the published code of the competitors takes them."""

from collections.abc import Iterator

import torch
from torch import Tensor

from hippo.core.ppo import Level, clipped_surrogate, in_chunks, maximize, surrogate_statistics


def minibatches(rows: int, parts: int, epochs: int, generator: torch.Generator) -> Iterator[Tensor]:
    """Indices of `parts` minibatches of an even size that cover range(rows), for every one of `epochs` passes.

    Indices are ascending within a minibatch, so rows that are sorted (by skill) stay so.
    """
    for _ in range(epochs):
        for part in torch.randperm(rows, generator=generator).tensor_split(max(1, min(parts, rows))):
            yield part.sort().values


def maximize_in_minibatches(
    level: Level,
    optimizer: torch.optim.Optimizer,
    epochs: int,
    parts: int,
    clip_range: float,
    num_steps: int,
    generator: torch.Generator,
) -> dict[str, float]:
    """Ascend the clipped surrogate of one level in `parts` minibatches per pass, each step on its minibatch's mean.

    One part is hippo.core.ppo.maximize: full-batch steps on the sum over `num_steps`.

    Returns:
        `<name>_approx_kl`, `<name>_clip_fraction` and `surrogate`, means over the last pass.
    """
    if parts <= 1:
        return maximize([level], optimizer, epochs, clip_range, num_steps)

    size = len(level.advantage)
    parts = min(parts, size)
    old = in_chunks(level.log_prob, size)
    # Sums of the last pass, as tensors: reading a number out of one at every step would cost as much as the step.
    kl, clipped, surrogate = torch.zeros(3)
    for step, rows in enumerate(minibatches(size, parts, epochs, generator)):
        log_prob = level.log_prob(rows)
        objective = clipped_surrogate(log_prob, old[rows], level.advantage[rows], clip_range).mean()
        optimizer.zero_grad(set_to_none=True)
        (-objective).backward()
        optimizer.step()
        if step >= parts * (epochs - 1):
            kl_sum, clipped_sum = surrogate_statistics(log_prob, old[rows], clip_range)
            kl, clipped = kl + kl_sum, clipped + clipped_sum
            surrogate = surrogate + objective.detach() * len(rows)
    return {
        f"{level.name}_approx_kl": float(kl / size),
        f"{level.name}_clip_fraction": float(clipped / size),
        "surrogate": float(surrogate / size),
    }
