"""Standardisation: of advantages over a batch, and of a regression's inputs and targets."""

import torch
from torch import Tensor, nn

EPSILON = 1e-8  # added to every standard deviation (the authors' constant)


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
