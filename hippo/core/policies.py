"""Policies: a flat Gaussian, the manager's categorical and the skill network (paper section 2 and appendix A).

All nets are tanh multilayer perceptrons with Glorot-uniform weights and zero biases, as in the authors' code. Standard
deviations do not depend on the state.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

MIN_STD = 1e-4  # floor of the standard deviation (authors' code)
SAME_BITS_TERMS = 192  # MKL adds up as many terms before it starts a new partial sum


class _Tanh(torch.autograd.Function):
    """tanh by numpy's vectorised routine: on a CPU ten times faster than torch's, and a third of an update's time."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        y = torch.from_numpy(np.tanh(x.detach().numpy()))
        ctx.save_for_backward(y)
        return y

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        (y,), (gradient,) = ctx.saved_tensors, gradients
        return torch.addcmul(gradient, gradient * y, y, value=-1)  # (1 - tanh^2) of the gradient


class Tanh(nn.Module):
    """The hidden activation of all policies."""

    def forward(self, x: Tensor) -> Tensor:
        """Elementwise tanh."""
        return _Tanh.apply(x)


class _Affine(torch.autograd.Function):
    """x W^T + b by oneDNN. The weight's gradient sums over rows and is left to torch's default, MKL."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        ctx.save_for_backward(x, weight)
        return _product(x, weight, bias)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor, Tensor]:
        (x, weight), (gradient,) = ctx.saved_tensors, gradients
        to_x = None
        if ctx.needs_input_grad[0]:
            to_x = _product(gradient, weight.T) if len(weight) <= SAME_BITS_TERMS else gradient @ weight
        return to_x, gradient.T @ x, gradient.sum(0)


def _product(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    # oneDNN misreads a strided bias and crawls through other strides.
    bias = None if bias is None else bias.contiguous()
    return torch.ops.mkldnn._linear_pointwise(x.contiguous(), weight.contiguous(), bias, "none", [], "")


def affine(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """x W^T + b: (B, D), (H, D), (H,) -> (B, H), as `torch.nn.functional.linear` in half its time on AMD's CPUs.

    MKL does not use AVX-512 there and oneDNN does. It is used where both give the same bits (measured on an AMD EPYC,
    family 26): sums of at most 192 terms, at least 4 rows and 16 outputs.
    """
    outputs, inputs = weight.shape
    same_bits = len(x) >= 4 and outputs >= 16 and inputs <= SAME_BITS_TERMS
    if same_bits and x.dtype == torch.float32 and torch.backends.mkldnn.is_available():
        return _Affine.apply(x, weight, bias)
    return torch.addmm(bias, x, weight.T)


class Linear(nn.Linear):
    """A linear layer computed by `affine`."""

    def forward(self, x: Tensor) -> Tensor:
        """(B, D) -> (B, H)."""
        return affine(x, self.weight, self.bias) if x.ndim == 2 else super().forward(x)


def linear(inputs: int, outputs: int, generator: torch.Generator) -> nn.Linear:
    """A linear layer with Glorot-uniform weights and zero bias."""
    layer = Linear(inputs, outputs)
    with torch.no_grad():
        nn.init.xavier_uniform_(layer.weight, generator=generator)
        layer.bias.zero_()
    return layer


def mlp(sizes: Sequence[int], generator: torch.Generator, activation: type[nn.Module] = Tanh) -> nn.Sequential:
    """Layers sizes[0] -> ... -> sizes[-1] with `activation` between them and none after the last."""
    layers: list[nn.Module] = []
    for inputs, outputs in itertools.pairwise(sizes):
        layers += [linear(inputs, outputs, generator), activation()]
    return nn.Sequential(*layers[:-1])


def gaussian_log_prob(mean: Tensor, log_std: Tensor, action: Tensor) -> Tensor:
    """log N(action; mean, diag(exp(log_std)^2)): (..., A) -> (...)."""
    residual = (action - mean) * torch.exp(-log_std)
    constant = 0.5 * action.shape[-1] * math.log(2 * math.pi)
    return -0.5 * residual.square().sum(-1) - log_std.sum(-1) - constant


def gaussian_entropy(log_std: Tensor) -> Tensor:
    """Differential entropy of a diagonal Gaussian: (..., A) -> (...)."""
    return log_std.sum(-1) + 0.5 * log_std.shape[-1] * (1 + math.log(2 * math.pi))


def sample_categorical(logits: np.ndarray, uniform: np.ndarray) -> np.ndarray:
    """Inverse-CDF sample: logits (K, Z) and uniform (K,) in [0, 1) -> indices (K,)."""
    cumulative = np.cumsum(np.exp(logits - logits.max(-1, keepdims=True)), -1)
    return (uniform[:, None] * cumulative[:, -1:] >= cumulative).sum(-1).clip(max=logits.shape[-1] - 1)


def for_few_rows(net: nn.Sequential) -> Callable[[np.ndarray], np.ndarray]:
    """The function that an `mlp` with tanh computes now, in numpy, whose calls cost a third of torch's.

    It shares memory with the parameters' current values and must not outlive them.
    """
    layers = [(m.weight.detach().numpy().T, m.bias.detach().numpy()) for m in net if isinstance(m, nn.Linear)]

    def forward(x: np.ndarray) -> np.ndarray:
        for i, (weight, bias) in enumerate(layers):
            x = np.matmul(np.tanh(x, out=x) if i else x, weight)
            x += bias
        return x

    return forward


class GaussianPolicy(nn.Module):
    """The flat policy pi(a|s): mean from an MLP, one trainable log-std vector."""

    def __init__(
        self, obs_size: int, action_size: int, hidden_sizes: Sequence[int], generator: torch.Generator
    ) -> None:
        super().__init__()
        self.mean = mlp([obs_size, *hidden_sizes, action_size], generator)
        self.log_std_parameter = nn.Parameter(torch.zeros(action_size))

    @property
    def log_std(self) -> Tensor:
        """(A,) log standard deviation, floored."""
        return self.log_std_parameter.clamp(min=math.log(MIN_STD))

    def log_prob(self, obs: Tensor, action: Tensor) -> Tensor:
        """log pi(a|s): (B, D), (B, A) -> (B,)."""
        return gaussian_log_prob(self.mean(obs), self.log_std, action)

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


class SkillLinear(nn.Module):
    """First layer over an input x and a one-hot skill z, either [x, z, x (x) z] ("bilinear") or [x, z] ("concatenate").

    The product is flattened with x major (entry i Z + j is x_i z_j), as in the authors' network. As z is one-hot the
    layer is an ordinary linear layer whose weight depends on the skill, and that is how it is computed.
    """

    def __init__(
        self, inputs: int, num_skills: int, outputs: int, integration: str, generator: torch.Generator
    ) -> None:
        super().__init__()
        if integration not in ("bilinear", "concatenate"):
            raise ValueError(f"integration={integration}: must be one of bilinear, concatenate")
        self.inputs, self.num_skills, self.integration = inputs, num_skills, integration
        width = inputs + num_skills + (inputs * num_skills if integration == "bilinear" else 0)
        layer = linear(width, outputs, generator)
        self.weight, self.bias = layer.weight, layer.bias  # (H, width), (H,)

    def effective(self) -> tuple[Tensor, Tensor]:
        """The weight (Z, D, H) and the bias (Z, H) that the one-hot input leaves for each skill."""
        D, Z = self.inputs, self.num_skills
        weight = self.weight[:, :D].T.unsqueeze(0)  # (1, D, H)
        if self.integration == "bilinear":
            weight = weight + self.weight[:, D + Z :].view(-1, D, Z).permute(2, 1, 0)
        return weight.expand(Z, -1, -1), self.bias + self.weight[:, D : D + Z].T

    def all_skills(self, x: Tensor) -> Tensor:
        """The layer under every skill: (B, D) -> (B, Z, H)."""
        weight, bias = self.effective()
        flat = x @ weight.permute(1, 0, 2).reshape(self.inputs, -1)
        return flat.view(len(x), self.num_skills, -1) + bias

    def grouped(self, x: Tensor, counts: Sequence[int]) -> Tensor:
        """Rows sorted by skill, `counts[z]` of each: (B, D) -> (B, H). One matrix product per skill."""
        weight, bias = self.effective()
        parts = x.split(list(counts))
        return torch.cat([affine(part, weight[z].T, bias[z]) for z, part in enumerate(parts)])


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
        self.first = SkillLinear(obs_size, num_skills, hidden_sizes[0], integration, generator)
        self.after_first = Tanh()
        self.rest = mlp([*hidden_sizes, action_size], generator)
        rows = num_skills if log_std_per_skill else 1
        self.log_std_parameter = nn.Parameter(torch.zeros(rows, action_size))

    def log_std(self) -> Tensor:
        """(Z, A) log standard deviation of every skill, floored."""
        return self.log_std_parameter.clamp(min=math.log(MIN_STD)).expand(self.num_skills, -1)

    def actor(self) -> Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]:
        """A function from obs (N, D), skill (N,) and standard normal noise (N, A) to actions (N, A).

        For the current parameters. The first layer is computed for every skill, as one product, and then selected.
        """
        weight, bias = (x.detach().numpy() for x in self.first.effective())  # (Z, D, H), (Z, H)
        flat = np.ascontiguousarray(weight.transpose(1, 0, 2).reshape(self.first.inputs, -1))
        rest, std = for_few_rows(self.rest), self.log_std().exp().detach().numpy()

        def act(obs: np.ndarray, skill: np.ndarray, noise: np.ndarray) -> np.ndarray:
            hidden = np.matmul(obs, flat).reshape(len(obs), len(bias), -1)[np.arange(len(obs)), skill]
            hidden += bias[skill]
            return rest(np.tanh(hidden, out=hidden)) + std[skill] * noise

        return act

    def log_prob(self, obs: Tensor, skill: Tensor, action: Tensor) -> Tensor:
        """log pi_l(a|s, z) of rows *sorted by skill*: (B, D), (B,), (B, A) -> (B,)."""
        counts = torch.bincount(skill, minlength=self.num_skills).tolist()
        mean = self.rest(self.after_first(self.first.grouped(obs, counts)))
        return gaussian_log_prob(mean, self.log_std()[skill], action)

    def log_prob_all(self, obs: Tensor, action: Tensor) -> Tensor:
        """log pi_l(a|s, z) under every skill: (B, D), (B, A) -> (B, Z)."""
        return gaussian_log_prob(self.means(obs), self.log_std(), action.unsqueeze(1))

    def means(self, obs: Tensor) -> Tensor:
        """Mean action of every skill: (B, D) -> (B, Z, A)."""
        return self.rest(self.after_first(self.first.all_skills(obs)))
