"""Passes over a batch in shuffled minibatches, as in a PPO of today and in the published code of the competitors."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from hippo.core.ppo import Level, Rows, clipped_surrogate, in_chunks, maximize, surrogate_statistics


@dataclass
class Critic:
    """A value function's share of a minibatch: what it says of rows, and what they turned out to be worth."""

    value: Callable[[Rows], Tensor]
    target: Tensor  # (B,)


def minibatches(rows: int, parts: int, epochs: int, generator: torch.Generator) -> Iterator[Tensor]:
    """Indices of `parts` minibatches of an even size that cover range(rows), for every one of `epochs` passes.

    Indices are ascending within a minibatch, so rows that are sorted (by skill) stay so.
    """
    for _ in range(epochs):
        for part in torch.randperm(rows, generator=generator).tensor_split(max(1, min(parts, rows))):
            yield part.sort().values


def maximize_in_minibatches(
    levels: Sequence[Level],
    optimizer: torch.optim.Optimizer,
    epochs: int,
    parts: int,
    clip_range: float,
    num_steps: int,
    generator: torch.Generator,
    critics: Sequence[Critic] = (),
    value_loss_weight: float = 0.5,
    entropy_weight: float = 0.0,
    max_gradient_norm: float = 0.0,
) -> dict[str, float]:
    """Ascend the clipped surrogates in `parts` minibatches per pass; each step is on the sum of its levels' means.

    A minibatch is a set of rows that all levels and critics share: a level whose rows are fewer (`Level.at`) takes part
    with those that lie in it. One part without critics is hippo.core.ppo.maximize: full-batch steps on the sum over
    `num_steps`.

    Args:
        critics: value functions that descend their mean squared error over the same rows, times `value_loss_weight`.
        entropy_weight: of the mean entropy of every level. max_gradient_norm: of all parameters together; 0: any.

    Returns:
        Per level `<name>_approx_kl` and `<name>_clip_fraction`; and `surrogate`: means over the last pass.
    """
    if parts <= 1 and not critics:
        return maximize(levels, optimizer, epochs, clip_range, num_steps)
    size = len(levels[0].advantage if levels[0].at is None else levels[0].at)
    parts = max(1, min(parts, size))
    old = [in_chunks(level.log_prob, len(level.advantage)) for level in levels]
    parameters = [p for group in optimizer.param_groups for p in group["params"]]
    # Sums of the last pass, as tensors: reading a number out of one at every step would cost as much as the step.
    sums = torch.zeros(len(levels), 3)  # KL, clipped and surrogate of every level
    for step, rows in enumerate(minibatches(size, parts, epochs, generator)):
        loss = torch.zeros(())
        for i, (level, before) in enumerate(zip(levels, old, strict=True)):
            own = rows if level.at is None else level.at[rows]
            own = own if level.at is None else own[own >= 0]
            if not len(own):
                continue
            log_prob = level.log_prob(own)
            objective = clipped_surrogate(log_prob, before[own], level.advantage[own], clip_range).mean()
            loss = loss - objective
            if entropy_weight and level.entropy is not None:
                loss = loss - entropy_weight * level.entropy(own)
            if step >= parts * (epochs - 1):
                statistics = (*surrogate_statistics(log_prob, before[own], clip_range), objective.detach() * len(own))
                sums[i] += torch.stack(statistics)
        for critic in critics:
            loss = loss + value_loss_weight * (critic.value(rows) - critic.target[rows]).square().mean()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        if max_gradient_norm:
            nn.utils.clip_grad_norm_(parameters, max_gradient_norm)
        optimizer.step()
    means = sums / torch.tensor([[len(level.advantage)] for level in levels])
    metrics: dict[str, float] = {}
    for level, (kl, clipped, _) in zip(levels, means.tolist(), strict=True):
        metrics |= {f"{level.name}_approx_kl": kl, f"{level.name}_clip_fraction": clipped}
    return metrics | {"surrogate": float(means[:, 2].sum())}
