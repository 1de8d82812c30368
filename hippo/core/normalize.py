"""Standardisation: of advantages over a batch, of a regression's inputs and targets, and by running statistics."""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn

EPSILON = 1e-8  # added to every standard deviation (the authors' constant)
FILTER_RANGE = 5.0  # filtered observations are clipped to +- this (OpenAI baselines)
FILTER_MIN_STD = 0.1  # floor of a column's standard deviation (OpenAI baselines)
REWARD_RANGE = 10.0  # scaled rewards are clipped to +- this (Stable-Baselines3)


def standardize(x: Tensor) -> Tensor:
    """(x - mean) / (std + 1e-8) over all entries, population std."""
    return (x - x.mean()) / (x.std(correction=0) + EPSILON)


class Standardizer(nn.Module):
    """Column-wise (x - mean) / (std + 1e-8) with the statistics of the last batch it was fitted to.

    Constant columns (std below 1e-6 of the column's size) keep scale one, so float noise in them is not blown up.
    """

    mean: Tensor
    scale: Tensor

    def __init__(self, size: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("scale", torch.ones(size))

    def fit(self, x: Tensor) -> None:
        """Take over mean and standard deviation of `x` (B, size), computed in float64."""
        x = x.double()
        mean, std = x.mean(0), x.std(0, correction=0)
        constant = std <= 1e-6 * (1 + mean.abs())
        self.mean.copy_(mean)
        self.scale.copy_(torch.where(constant, torch.ones_like(std), std + EPSILON))

    def forward(self, x: Tensor) -> Tensor:
        """Standardised `x` (..., size)."""
        return (x - self.mean) / self.scale

    def invert(self, y: Tensor) -> Tensor:
        """The inverse of `forward`."""
        return y * self.scale + self.mean


class RunningMoments(nn.Module):
    """Mean and variance of the columns of all rows ever taken in, in float64 (Chan, Golub and LeVeque 1979)."""

    count: Tensor
    mean: Tensor
    variance: Tensor

    def __init__(self, size: int) -> None:
        super().__init__()
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("variance", torch.ones(size, dtype=torch.float64))

    def update(self, x: Tensor) -> None:
        """Take in rows `x` (..., size)."""
        x = x.reshape(-1, x.shape[-1]).double()
        total = self.count + len(x)
        share, shift = len(x) / total, x.mean(0) - self.mean
        within = (1 - share) * self.variance + share * x.var(0, correction=0)
        self.variance.copy_(within + share * (1 - share) * shift.square())
        self.mean.add_(share * shift)
        self.count.copy_(total)


class ObservationFilter(RunningMoments):
    """Standardises by the mean and the standard deviation of all observations that `update` has seen, and clips.

    Exactly the identity until the first update. Learners update it with a batch after they have learnt from it, so a
    whole batch is seen through the same statistics; whatever only acts leaves them alone.
    """

    def _shift_and_scale(self) -> tuple[Tensor, Tensor]:
        scale = self.variance.sqrt().clamp(min=FILTER_MIN_STD)
        return self.mean.to(torch.get_default_dtype()), scale.to(torch.get_default_dtype())

    def forward(self, x: Tensor) -> Tensor:
        """(..., D) -> (..., D)."""
        if not self.count:
            return x
        shift, scale = self._shift_and_scale()
        return ((x - shift) / scale).clamp(-FILTER_RANGE, FILTER_RANGE)

    def actor(self) -> Callable[[np.ndarray], np.ndarray]:
        """The same function in numpy, for the statistics as they are now."""
        if not self.count:
            return lambda x: x
        shift, scale = (x.numpy() for x in self._shift_and_scale())
        return lambda x: np.clip((x - shift) / scale, -FILTER_RANGE, FILTER_RANGE)


def actor_of(observation_filter: ObservationFilter | None) -> Callable[[np.ndarray], np.ndarray]:
    """What a policy with this filter, or with none, sees of observations (N, D)."""
    return (lambda x: x) if observation_filter is None else observation_filter.actor()


class RewardScale(RunningMoments):
    """Divides rewards by the running standard deviation of the discounted sums of past rewards, and clips.

    The sums are those of Engstrom et al. (2020), section 3: G_t = r_t + gamma G_{t-1}, from zero at every episode's
    start. Learners take a batch in before they scale it, so that the first reward is not divided by almost nothing.
    """

    def __init__(self) -> None:
        super().__init__(1)

    def take_in(self, reward: Tensor, done: Tensor, gamma: float) -> None:
        """Know the rewards and episode ends (T, N) of one more batch, which starts with fresh episodes."""
        sums, running = torch.empty_like(reward), torch.zeros_like(reward[0])
        for t in range(len(reward)):
            running = reward[t] + gamma * running
            sums[t] = running
            running = running.masked_fill(done[t], 0.0)
        self.update(sums.unsqueeze(-1))

    def forward(self, reward: Tensor) -> Tensor:
        """Scaled rewards, in the shape of `reward`."""
        return (reward / (self.variance.sqrt() + EPSILON)).clamp(-REWARD_RANGE, REWARD_RANGE)
