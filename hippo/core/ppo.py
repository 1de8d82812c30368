"""The clipped surrogate of PPO (Schulman et al. 2017, equation 7) and a full-batch step taken in chunks."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

Rows = slice | Tensor  # which rows of a batch: a slice, or their indices
CHUNK = 25_000  # rows per forward and backward pass; bounds the memory of their activations


def clipped_surrogate(log_prob: Tensor, old_log_prob: Tensor, advantage: Tensor, clip_range: float) -> Tensor:
    """min(w A, clip(w, 1 - eps, 1 + eps) A) per sample, with w = pi(a|s) / pi_old(a|s); to be maximised."""
    ratio = (log_prob - old_log_prob).exp()
    return torch.minimum(ratio * advantage, ratio.clamp(1 - clip_range, 1 + clip_range) * advantage)


def surrogate_statistics(log_prob: Tensor, old_log_prob: Tensor, clip_range: float) -> tuple[Tensor, Tensor]:
    """Sums over the samples of the KL estimate (w - 1) - log w (Schulman's k3) and of |w - 1| > eps."""
    log_ratio = (log_prob - old_log_prob).detach()
    ratio = log_ratio.exp()
    return (ratio - 1 - log_ratio).sum(), ((ratio - 1).abs() > clip_range).to(log_prob.dtype).sum()


def chunks(rows: int) -> Iterator[slice]:
    """Consecutive slices of at most CHUNK rows, all of about the same size, that cover range(rows)."""
    parts = -(-rows // CHUNK)
    for part in range(parts):
        yield slice(rows * part // parts, rows * (part + 1) // parts)


def in_chunks(function: Callable[[slice], Tensor], rows: int) -> Tensor:
    """Concatenation of `function(slice)` over all chunks, without gradients."""
    with torch.no_grad():
        return torch.cat([function(part) for part in chunks(rows)])


@dataclass
class Level:
    """One policy's share of a clipped objective: its log-probability of what it did, and how good that was."""

    name: str  # prefix of the metrics
    log_prob: Callable[[Rows], Tensor]  # rows -> log-probability under the current parameters
    advantage: Tensor  # (B,)
    direct: Callable[[], Any] | None = None  # makes the same for small minibatches (hippo/core/direct.py)
    at: Tensor | None = None  # which of its rows belongs to every row of a minibatch, -1 for none; None: the same


def maximize(
    levels: Sequence[Level], optimizer: torch.optim.Optimizer, updates: int, clip_range: float, num_steps: int
) -> dict[str, float]:
    """Take `updates` full-batch steps on sum over levels and rows of the clipped surrogate, over `num_steps`.

    Gradients are accumulated over chunks in a fixed order, so the result does not depend on anything but the batch.

    Returns:
        Per level, at the last gradient evaluated: `<name>_approx_kl`, `<name>_clip_fraction`; and `surrogate`, the
        objective there.
    """
    metrics = {f"{level.name}_{what}": 0.0 for level in levels for what in ("approx_kl", "clip_fraction")}
    metrics["surrogate"] = 0.0
    old_log_prob = [torch.empty_like(level.advantage) for level in levels]  # filled by the first update
    for update in range(updates):
        optimizer.zero_grad(set_to_none=True)
        surrogate = 0.0
        for level, old in zip(levels, old_log_prob, strict=True):
            rows, kl, clipped = len(level.advantage), 0.0, 0.0
            for c in chunks(rows):
                log_prob = level.log_prob(c)
                if update == 0:
                    old[c] = log_prob.detach()
                objective = clipped_surrogate(log_prob, old[c], level.advantage[c], clip_range).sum()
                (-objective / num_steps).backward()
                kl_sum, clipped_sum = surrogate_statistics(log_prob, old[c], clip_range)
                surrogate, kl, clipped = (
                    surrogate + float(objective.detach()),
                    kl + float(kl_sum),
                    clipped + float(clipped_sum),
                )
            metrics |= {f"{level.name}_approx_kl": kl / rows, f"{level.name}_clip_fraction": clipped / rows}
        optimizer.step()
        metrics["surrogate"] = surrogate / num_steps
    return metrics
