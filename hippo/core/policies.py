"""Policies: a flat Gaussian, the manager's categorical and the skill network (paper section 2 and appendix A).

All nets are tanh multilayer perceptrons (networks.py). Standard deviations do not depend on the state.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor, nn

from hippo.core.networks import (
    SkillLinear,
    for_few_grouped_rows,
    for_few_rows,
    grouped_layers,
    mlp,
    normalize_columns,
)
from hippo.core.normalize import ObservationFilter
from hippo.core.view import Ego

MIN_STD = 1e-4  # floor of the standard deviation (authors' code)
POLICY_HEAD = 0.01  # norm of a policy's last weights under `initialisation=normc` (OpenAI Baselines)


def gaussian_log_prob(mean: Tensor, log_std: Tensor, action: Tensor) -> Tensor:
    """log N(action; mean, diag(exp(log_std)^2)): (..., A) -> (...)."""
    residual = (action - mean) * torch.exp(-log_std)
    constant = 0.5 * action.shape[-1] * math.log(2 * math.pi)
    return -0.5 * residual.square().sum(-1) - log_std.sum(-1) - constant


class _GroupedGaussian(torch.autograd.Function):
    """`grouped_gaussian_log_prob` and its gradient in closed form, one pass over the rows each way."""

    @staticmethod
    def forward(ctx: Any, mean: Tensor, log_std: Tensor, action: Tensor, counts: Sequence[int]) -> Tensor:
        mean, log_std, action, out = (
            mean.contiguous(),
            log_std.contiguous(),
            action.contiguous(),
            mean.new_empty(len(mean)),
        )
        log_densities(mean.numpy(), log_std.numpy(), action.numpy(), np.array(counts), out.numpy())
        ctx.save_for_backward(mean, log_std, action)
        ctx.counts = np.array(counts)
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, None, None]:
        mean, log_std, action = (t.numpy() for t in ctx.saved_tensors)
        to_mean, to_log_std = np.empty_like(mean), np.zeros(log_std.shape)
        gradient = gradients[0].contiguous().numpy()
        through_log_densities(gradient, mean, log_std, action, ctx.counts, to_mean, to_log_std)
        return torch.from_numpy(to_mean), torch.from_numpy(to_log_std.astype(log_std.dtype)), None, None


@numba.njit(cache=True, error_model="numpy")
def log_densities(
    mean: np.ndarray, log_std: np.ndarray, action: np.ndarray, counts: np.ndarray, out: np.ndarray
) -> None:
    """Write log N(action; mean, std) to out (B,): mean and action (B, A), log_std (Z, A), counts (Z,)."""
    row, A = 0, mean.shape[1]
    for z in range(len(counts)):
        constant = 0.5 * A * np.log(2 * np.pi) + log_std[z].sum()
        precision = np.exp(-2.0 * log_std[z])
        for i in range(row, row + counts[z]):
            square = 0.0
            for j in range(A):
                square += (action[i, j] - mean[i, j]) ** 2 * precision[j]
            out[i] = -0.5 * square - constant
        row += counts[z]


@numba.njit(cache=True, error_model="numpy")
def through_log_densities(
    gradient: np.ndarray,
    mean: np.ndarray,
    log_std: np.ndarray,
    action: np.ndarray,
    counts: np.ndarray,
    to_mean: np.ndarray,
    to_log_std: np.ndarray,
) -> None:
    """Write the gradient (B,) with respect to mean (B, A), and add that of log_std to zeros (Z, A) in float64.

    d log N / d mean = (a - mean) / std^2 and d log N / d log std = (a - mean)^2 / std^2 - 1.
    """
    row = 0
    for z in range(len(counts)):
        precision = np.exp(-2.0 * log_std[z])
        for i in range(row, row + counts[z]):
            for j in range(mean.shape[1]):
                residual = action[i, j] - mean[i, j]
                to_mean[i, j] = gradient[i] * residual * precision[j]
                to_log_std[z, j] += gradient[i] * (residual * residual * precision[j] - 1.0)
        row += counts[z]


def grouped_gaussian_log_prob(mean: Tensor, log_std: Tensor, action: Tensor, counts: Sequence[int]) -> Tensor:
    """`gaussian_log_prob` of rows in Z groups with a log_std each: (B, A), (Z, A), (B, A), Z counts -> (B,).

    The same number in a tenth of the time; `action` gets no gradient.
    """
    return _GroupedGaussian.apply(mean, log_std, action, counts)


def gaussian_entropy(log_std: Tensor) -> Tensor:
    """Differential entropy of a diagonal Gaussian: (..., A) -> (...)."""
    return log_std.sum(-1) + 0.5 * log_std.shape[-1] * (1 + math.log(2 * math.pi))


def sample_categorical(logits: np.ndarray, uniform: np.ndarray) -> np.ndarray:
    """Inverse-CDF sample: logits (K, Z) and uniform (K,) in [0, 1) -> indices (K,)."""
    out = np.empty(len(logits), np.int64)
    _sample_categorical(logits, uniform, out)
    return out


@numba.njit(cache=True, error_model="numpy")
def _sample_categorical(logits: np.ndarray, uniform: np.ndarray, out: np.ndarray) -> None:
    """Write `sample_categorical` to out (K,)."""
    for i in range(len(logits)):
        weight = np.exp(logits[i] - logits[i].max())
        left = uniform[i] * weight.sum()
        out[i] = 0
        while out[i] < len(weight) - 1 and left >= weight[out[i]]:
            left -= weight[out[i]]
            out[i] += 1


class GaussianPolicy(nn.Module):
    """The flat policy pi(a|s): mean from an MLP, one trainable log-std vector.

    Args:
        filtered: observations pass a running standardisation before the policy, and whoever learns with it, sees them.
        initialisation: "glorot" or "normc", as in `OnPolicyConfig`.
    """

    def __init__(
        self,
        obs_size: int,
        action_size: int,
        hidden_sizes: Sequence[int],
        generator: torch.Generator,
        filtered: bool = False,
        initialisation: str = "glorot",
    ) -> None:
        super().__init__()
        self.filter = ObservationFilter(obs_size) if filtered else None
        self.mean = mlp([obs_size, *hidden_sizes, action_size], generator)
        if initialisation == "normc":
            normalize_columns(self.mean.layers, POLICY_HEAD, generator)
        self.log_std_parameter = nn.Parameter(torch.zeros(action_size))

    @property
    def log_std(self) -> Tensor:
        """(A,) log standard deviation, floored."""
        return self.log_std_parameter.clamp(min=math.log(MIN_STD))

    def log_prob(self, obs: Tensor, action: Tensor) -> Tensor:
        """log pi(a|s): (B, D), (B, A) -> (B,)."""
        return grouped_gaussian_log_prob(self.mean(obs), self.log_std.unsqueeze(0), action, [len(obs)])

    def actor(self) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
        """A function from obs (N, D) and standard normal noise (N, A) to actions (N, A), for the current parameters."""
        mean, std = for_few_rows(self.mean), self.log_std.exp().detach().numpy()
        return lambda obs, noise: mean(obs) + std * noise


class Manager(nn.Module):
    """The higher level pi_h(z|s): a categorical over skills."""

    def __init__(self, obs_size: int, num_skills: int, hidden_sizes: Sequence[int], generator: torch.Generator) -> None:
        super().__init__()
        self.logits = mlp([obs_size, *hidden_sizes, num_skills], generator)

    def actor(self) -> Callable[[np.ndarray], np.ndarray]:
        """A function from what the manager sees (K, D) to logits (K, Z), for the current parameters."""
        return for_few_rows(self.logits)

    def log_probs(self, obs: Tensor) -> Tensor:
        """log pi_h(.|s) of every skill: (B, D) -> (B, Z)."""
        return self.logits(obs).log_softmax(-1)


class SkillPolicy(nn.Module):
    """The lower level pi_l(a|s, z): one network for all skills (paper section 4.1).

    The input is what skills may see (the robot's own observation by default) and, with a random period, the time left
    in the commitment as last entry.
    """

    def __init__(
        self,
        obs_size: int,
        num_skills: int,
        action_size: int,
        hidden_sizes: Sequence[int],
        generator: torch.Generator,
        integration: str = "bilinear",
        log_std_per_skill: bool = False,
    ) -> None:
        super().__init__()
        self.num_skills = num_skills
        self.ego: Ego | None = None  # what skills see of the robot, where it is not all of it
        self.first = SkillLinear(obs_size, num_skills, hidden_sizes[0], integration, generator)
        self.rest = mlp([*hidden_sizes, action_size], generator)
        rows = num_skills if log_std_per_skill else 1
        self.log_std_parameter = nn.Parameter(torch.zeros(rows, action_size))

    def see(self, obs: Tensor) -> Tensor:
        """What skills without a time left see of observations: (..., D), the robot's entries first -> (..., inputs)."""
        return obs[..., : self.first.inputs] if self.ego is None else self.ego(obs)

    def see_array(self, obs: np.ndarray) -> np.ndarray:
        """The same of arrays (N, D)."""
        return obs[:, : self.first.inputs] if self.ego is None else self.ego.of_array(obs)

    def log_std(self) -> Tensor:
        """(Z, A) log standard deviation of every skill, floored."""
        return self.log_std_parameter.clamp(min=math.log(MIN_STD)).expand(self.num_skills, -1)

    def actor(self) -> Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]:
        """A function from obs (N, D), skill (N,) and standard normal noise (N, A) to actions (N, A).

        For the current parameters.
        """
        mean = for_few_grouped_rows(*self.first.effective(), self.rest.layers)
        std = self.log_std()[: len(self.log_std_parameter)].exp().detach().numpy()  # (1 or Z, A)

        def act(obs: np.ndarray, skill: np.ndarray, noise: np.ndarray) -> np.ndarray:
            action = mean(obs, skill)
            action += (std if len(std) == 1 else std[skill]) * noise
            return action

        return act

    def log_prob(self, obs: Tensor, skill: Tensor, action: Tensor) -> Tensor:
        """log pi_l(a|s, z) of rows *sorted by skill*: (B, D), (B,), (B, A) -> (B,)."""
        counts = torch.bincount(skill, minlength=self.num_skills).tolist()
        mean = grouped_layers(obs, counts, *self.first.effective(), self.rest.layers, nn.Tanh)
        return grouped_gaussian_log_prob(mean, self.log_std(), action, counts)

    def log_prob_all(self, obs: Tensor, action: Tensor) -> Tensor:
        """log pi_l(a|s, z) under every skill: (B, D), (B, A) -> (B, Z)."""
        return gaussian_log_prob(self.means(obs), self.log_std(), action.unsqueeze(1))

    def means(self, obs: Tensor) -> Tensor:
        """Mean action of every skill: (B, D) -> (B, Z, A)."""
        rows, counts = obs.repeat(self.num_skills, 1), [len(obs)] * self.num_skills
        mean = grouped_layers(rows, counts, *self.first.effective(), self.rest.layers, nn.Tanh)
        return mean.view(self.num_skills, len(obs), -1).transpose(0, 1)
