"""Gradients of small minibatches written out, for learners that take thousands of tiny steps per iteration.

A gradient step on 256 rows costs autograd three times what the arithmetic costs. Here a network's forward and backward
pass, and what a loss sends back into it, are called one after the other; `tests/hippo/test_direct.py` holds each
against plain torch. Every object overwrites the gradients of its own parameters; an optimiser then steps as always.
"""

from collections.abc import Sequence

import numba
import numpy as np
import torch
from torch import Tensor, nn

from hippo.core.networks import Activation, Arrays, SkillLinear, backward_layers, forward_layers
from hippo.core.policies import MIN_STD, log_densities, through_log_densities


class Network:
    """The network that `grouped_layers` evaluates, with its gradient in `.grad` of the parameters after `backward`."""

    def __init__(self, first: nn.Linear | SkillLinear, rest: Sequence[nn.Linear], activation: Activation) -> None:
        self.first, self.is_tanh = first, activation is nn.Tanh
        self.num_groups = first.num_skills if isinstance(first, SkillLinear) else 1
        self._weights, self._biases = _arrays(layer.weight for layer in rest), _arrays(layer.bias for layer in rest)
        self._own = _arrays([first.weight, first.bias])
        self._to_own = _gradients([first.weight, first.bias])
        self._to_weights = _gradients(layer.weight for layer in rest)
        self._to_biases = _gradients(layer.bias for layer in rest)
        D, H, Z = self._inputs(), len(self._own[1]), self.num_groups
        self._effective = np.empty((Z, H, D), self._own[0].dtype), np.empty((Z, H), self._own[0].dtype)
        self._to_effective = tuple(np.empty_like(x) for x in self._effective)
        self._widths = [w.shape[1] for w in self._weights]

    def _inputs(self) -> int:
        return self.first.inputs if isinstance(self.first, SkillLinear) else self.first.in_features

    def forward(self, x: np.ndarray, group: np.ndarray | None = None) -> np.ndarray:
        """Rows (B, D), sorted by their group (B,) where there are several -> (B, O)."""
        self._x = x
        self.counts = np.array([len(x)]) if group is None else np.bincount(group, minlength=self.num_groups)
        stop = self.counts.cumsum()
        blocks = np.stack([np.arange(self.num_groups), stop - self.counts, stop], 1)
        self._blocks = blocks[self.counts > 0]
        weight, bias = self._own
        first, first_bias = self._effective
        _spread(weight, bias, first, first_bias)
        self._kept = tuple(np.empty((len(x), width), x.dtype) for width in self._widths)
        out = np.empty((len(x), len(self._biases[-1])), x.dtype)
        forward_layers(self._blocks, x, first, first_bias, self._weights, self._biases, self.is_tanh, self._kept, out)
        return out

    def backward(self, gradient: np.ndarray) -> None:
        """Write the gradients of all parameters, given that of the last `forward`'s output (B, O)."""
        to_products = (*(np.empty_like(y) for y in self._kept), gradient)
        first, (to_first, to_first_bias), (to_weight, to_bias) = self._effective[0], self._to_effective, self._to_own
        backward_layers(self._blocks, first, self._weights, self.is_tanh, self._kept, to_products, self._x[:0])
        sums = (to_first, to_first_bias, self._to_weights, self._to_biases)
        _sum_over_rows(self._blocks, self._x, self._kept, to_products, *sums)
        _gather(to_first, to_first_bias, to_weight, to_bias)


def network_of(layers: Sequence[nn.Linear | SkillLinear], activation: Activation = nn.Tanh) -> Network:
    """The network of these layers, of which only the first may be a skill layer."""
    first, *rest = layers
    return Network(first, rest, activation)  # type: ignore[arg-type]


def _arrays(tensors: object) -> Arrays:
    return tuple(t.detach().numpy() for t in tensors)  # type: ignore[attr-defined]


def _gradients(parameters: object) -> Arrays:
    """Zeroed gradients of parameters, as arrays on the same memory."""
    result = []
    for p in parameters:  # type: ignore[attr-defined]
        p.grad = torch.zeros_like(p)
        result.append(p.grad.numpy())
    return tuple(result)


@numba.njit(cache=True, error_model="numpy")
def _spread(weight: np.ndarray, bias: np.ndarray, first: np.ndarray, first_bias: np.ndarray) -> None:
    """Write `SkillLinear.effective` of weight (H, D [+ Z + D Z]) and bias (H,) to (Z, H, D) and (Z, H)."""
    Z, H, D = first.shape
    is_plain, is_bilinear = weight.shape[1] == D, weight.shape[1] > D + Z
    for z in range(Z):
        for h in range(H):
            first_bias[z, h] = bias[h] + (0 if is_plain else weight[h, D + z])
            for d in range(D):
                first[z, h, d] = weight[h, d] + (weight[h, D + Z + d * Z + z] if is_bilinear else 0)


@numba.njit(cache=True, error_model="numpy")
def _gather(to_first: np.ndarray, to_first_bias: np.ndarray, to_weight: np.ndarray, to_bias: np.ndarray) -> None:
    """Write the gradients of what `_spread` reads, given those of what it writes."""
    Z, H, D = to_first.shape
    is_plain, is_bilinear = to_weight.shape[1] == D, to_weight.shape[1] > D + Z
    to_weight[:, :D] = 0
    to_bias[:] = 0
    for z in range(Z):
        for h in range(H):
            to_bias[h] += to_first_bias[z, h]
            if not is_plain:
                to_weight[h, D + z] = to_first_bias[z, h]
            for d in range(D):
                to_weight[h, d] += to_first[z, h, d]
                if is_bilinear:
                    to_weight[h, D + Z + d * Z + z] = to_first[z, h, d]


@numba.njit(cache=True, error_model="numpy")
def _sum_over_rows(
    blocks: np.ndarray,
    x: np.ndarray,
    kept: Arrays,
    to_products: Arrays,
    to_first: np.ndarray,
    to_first_bias: np.ndarray,
    to_weights: Arrays,
    to_biases: Arrays,
) -> None:
    """Write gradients of weights and biases, given those of the layers' products; shapes as in networks.py."""
    to_first[:] = 0
    to_first_bias[:] = 0
    for group, start, stop in blocks:
        gradient = to_products[0][start:stop]
        np.dot(gradient.T, x[start:stop], to_first[group])
        _add_rows(gradient, to_first_bias[group])
    for layer in range(len(kept)):
        gradient, bias = to_products[layer + 1], to_biases[layer]
        np.dot(gradient.T, kept[layer], to_weights[layer])
        bias[:] = 0
        _add_rows(gradient, bias)


@numba.njit(cache=True, error_model="numpy")
def _add_rows(x: np.ndarray, out: np.ndarray) -> None:
    """Add the rows of x (B, H) to out (H,)."""
    for i in range(x.shape[0]):
        for j in range(x.shape[1]):
            out[j] += x[i, j]


@numba.njit(cache=True, error_model="numpy")
def _through_surrogate(
    log_prob: np.ndarray, old: np.ndarray, advantage: np.ndarray, clip_range: float, gradient: np.ndarray
) -> tuple[float, float, float]:
    """Write the gradient (B,) of minus the mean of `clipped_surrogate` with respect to log_prob (B,).

    Returns:
        Sums over the rows of the KL estimate (w - 1) - log w, of |w - 1| > eps, and of the surrogate.
    """
    kl, clipped, surrogate = 0.0, 0.0, 0.0
    for i in range(len(log_prob)):
        # In float64, where what is not clipped is exactly itself: else rounding drops rows from the gradient.
        log_ratio = np.float64(log_prob[i]) - old[i]
        ratio = np.exp(log_ratio)
        bounded = min(max(ratio, 1 - clip_range), 1 + clip_range)
        kl += ratio - 1 - log_ratio
        clipped += abs(ratio - 1) > clip_range
        surrogate += min(ratio * advantage[i], bounded * advantage[i])
        follows = ratio * advantage[i] <= bounded * advantage[i]  # else the bound holds, which is constant
        gradient[i] = -ratio * advantage[i] / len(log_prob) if follows else 0
    return kl, clipped, surrogate


@numba.njit(cache=True, error_model="numpy")
def _log_softmax(logits: np.ndarray) -> None:
    """Put the log-probabilities in place of logits (B, Z)."""
    for i in range(len(logits)):
        logits[i] -= logits[i].max()
        logits[i] -= np.log(np.exp(logits[i]).sum())


@numba.njit(cache=True, error_model="numpy")
def _through_choice(
    log_probs: np.ndarray, choice: np.ndarray, gradient: np.ndarray, entropy_weight: float, to_logits: np.ndarray
) -> None:
    """Write the gradient (B, Z) of a loss that has `gradient` (B,) for log p[choice], minus the mean entropy's."""
    for i in range(len(choice)):
        entropy = 0.0
        for z in range(log_probs.shape[1]):
            entropy -= np.exp(log_probs[i, z]) * log_probs[i, z]
        for z in range(log_probs.shape[1]):
            p = np.exp(log_probs[i, z])
            of_entropy = -p * (log_probs[i, z] + entropy) / len(choice)
            to_logits[i, z] = gradient[i] * ((z == choice[i]) - p) - entropy_weight * of_entropy


class Gaussian:
    """A diagonal Gaussian's clipped surrogate over rows of a batch: x (B, D), skill (B,) or None, action (B, A)."""

    def __init__(
        self, network: Network, log_std: nn.Parameter, x: Tensor, skill: Tensor | None, action: Tensor
    ) -> None:
        self.network, self.parameter = network, log_std
        self.x, self.action = x.numpy(), action.numpy()
        self.skill = None if skill is None else skill.numpy()
        self._log_std, (self._to_log_std,) = log_std.detach().numpy(), _gradients([log_std])

    def ascend(
        self, rows: np.ndarray, old: np.ndarray, advantage: np.ndarray, clip_range: float, entropy_weight: float
    ) -> tuple[float, float, float]:
        """Write the gradient of minus the mean surrogate over `rows` (K,); old and advantage are theirs (K,).

        Returns:
            As `_through_surrogate`.
        """
        action, floor = self.action[rows], np.log(MIN_STD)
        mean = self.network.forward(self.x[rows], None if self.skill is None else self.skill[rows])
        log_std = np.maximum(self._log_std, floor).reshape(-1, action.shape[1])
        # Groups with a log-std of their own, or all rows together.
        counts = self.network.counts if len(log_std) > 1 else np.array([len(rows)])
        log_prob, gradient = np.empty(len(rows), mean.dtype), np.empty(len(rows), mean.dtype)
        log_densities(mean, log_std, action, counts, log_prob)
        sums = _through_surrogate(log_prob, old, advantage, clip_range, gradient)
        to_mean, to_log_std = np.empty_like(mean), np.zeros(log_std.shape)
        through_log_densities(gradient, mean, log_std, action, counts, to_mean, to_log_std)
        self.network.backward(to_mean)
        share = (counts / len(rows))[:, None]  # of the mean entropy that every log-std has
        to_log_std = (to_log_std - entropy_weight * share) * (log_std > floor)
        self._to_log_std[...] = to_log_std.reshape(self._to_log_std.shape)
        return sums


class Categorical:
    """A manager's clipped surrogate over its decisions: what it saw (B, D) and what it chose (B,)."""

    def __init__(self, network: Network, x: Tensor, choice: Tensor) -> None:
        self.network, self.x, self.choice = network, x.numpy(), choice.numpy()

    def ascend(
        self, rows: np.ndarray, old: np.ndarray, advantage: np.ndarray, clip_range: float, entropy_weight: float
    ) -> tuple[float, float, float]:
        """As `Gaussian.ascend`."""
        choice, log_probs = self.choice[rows], self.network.forward(self.x[rows])
        _log_softmax(log_probs)
        log_prob, gradient = log_probs[np.arange(len(rows)), choice], np.empty(len(rows), log_probs.dtype)
        sums = _through_surrogate(log_prob, old, advantage, clip_range, gradient)
        to_logits = np.empty_like(log_probs)
        _through_choice(log_probs, choice, gradient, entropy_weight, to_logits)
        self.network.backward(to_logits)
        return sums


class SquaredError:
    """A value function's mean squared error over rows of a batch: x (B, D), skill (B,) or None, target (B,)."""

    def __init__(self, network: Network, x: Tensor, skill: Tensor | None, target: Tensor) -> None:
        self.network, self.x, self.target = network, x.numpy(), target.numpy()
        self.skill = None if skill is None else skill.numpy()

    def descend(self, rows: np.ndarray, weight: float) -> None:
        """Write the gradient of `weight` times the mean squared error over `rows` (K,)."""
        value = self.network.forward(self.x[rows], None if self.skill is None else self.skill[rows])
        error = value - self.target[rows, None]
        self.network.backward((2 * weight / len(rows)) * error)
