"""Multilayer perceptrons of this suite, evaluated and differentiated block by block within a processor's caches.

Glorot-uniform weights and zero biases, as in the authors' code. A network is one node of autograd's graph: `_Layers`
takes a few rows at a time through all layers, so that activations are still in the cache when the next layer reads
them, and does the same on the way back. What sums over rows (gradients of weights and biases) is taken over all rows
at once.
"""

import itertools
from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor, nn

Activation = type[nn.Tanh] | type[nn.ReLU]
Arrays = tuple[np.ndarray, ...]
BLOCK = 131072  # entries of the widest activation of the rows that pass through all layers together: 512 kB


def _lambert(depth: int) -> tuple[tuple[np.float32, ...], tuple[np.float32, ...]]:
    """tanh x = x P(x^2) / Q(x^2) by Lambert's continued fraction x / (1 + x^2 / (3 + x^2 / (5 + ...))) of some depth.

    Returns:
        The coefficients of P and Q, lowest power first, scaled to Q(0) = 1.
    """
    above, below = [Fraction(2 * depth - 1)], [Fraction(1)]  # the innermost term, as a quotient of polynomials in x^2
    for term in range(2 * depth - 3, 0, -2):  # term + x^2 below / above
        pairs = itertools.zip_longest([term * c for c in above], [Fraction(0), *below], fillvalue=Fraction(0))
        above, below = [a + b for a, b in pairs], above
    scaled = [tuple(np.float32(float(c / above[0])) for c in polynomial) for polynomial in (below, above)]
    return scaled[0], scaled[1]


P, Q = _lambert(13)  # seven coefficients each: within 4e-7 of tanh, relatively
SATURATED = np.float32(9.0)  # from here on tanh is 1 in single precision


@numba.njit(cache=True, error_model="numpy", fastmath={"contract"})
def _lambert_tanh(x: np.float32) -> np.float32:
    v = min(max(x, -SATURATED), SATURATED)
    s = v * v
    above = P[0] + s * (P[1] + s * (P[2] + s * (P[3] + s * (P[4] + s * (P[5] + s * P[6])))))
    below = Q[0] + s * (Q[1] + s * (Q[2] + s * (Q[3] + s * (Q[4] + s * (Q[5] + s * Q[6])))))
    return min(max(v * above / below, np.float32(-1)), np.float32(1))


@numba.njit(cache=True, error_model="numpy", fastmath={"contract"})
def _activate(y: np.ndarray, bias: np.ndarray, is_tanh: bool) -> None:
    """Put tanh(y + bias), else max(y + bias, 0), in place of y: (B, H), (H,).

    tanh is the fraction in single precision, a sixth of the time of numpy's.
    """
    for i in range(y.shape[0]):
        if not is_tanh:
            for j in range(y.shape[1]):
                value = y[i, j] + bias[j]
                y[i, j] = 0 if value < 0 else value  # NaN stays NaN
        elif y.itemsize == 4:
            for j in range(y.shape[1]):
                y[i, j] = _lambert_tanh(y[i, j] + bias[j])
        else:
            for j in range(y.shape[1]):
                y[i, j] = np.tanh(y[i, j] + bias[j])


@numba.njit(cache=True, error_model="numpy", fastmath={"contract"})
def _through_activation(gradient: np.ndarray, y: np.ndarray, is_tanh: bool) -> None:
    """Put the gradient times the derivative where the activation is y, 1 - y^2 or y > 0, in its place: all (B, H)."""
    for i in range(y.shape[0]):
        if is_tanh:
            for j in range(y.shape[1]):
                gradient[i, j] -= gradient[i, j] * y[i, j] * y[i, j]
        else:
            for j in range(y.shape[1]):
                gradient[i, j] = gradient[i, j] if y[i, j] > 0 else 0


@numba.njit(cache=True, error_model="numpy")
def forward_layers(
    blocks: np.ndarray,
    x: np.ndarray,
    first: np.ndarray,
    first_bias: np.ndarray,
    weights: Arrays,
    biases: Arrays,
    is_tanh: bool,
    kept: Arrays,
    out: np.ndarray,
) -> None:
    """Fill `kept`, what the L hidden layers put out (B, H), and `out` (B, O), a block of rows after the other.

    Args:
        blocks: (K, 3) group, first row, row after the last. x: (B, D). first: (Z, H, D). first_bias: (Z, H).
        weights: L of (outputs, inputs). biases: L of (outputs,).
    """
    for group, start, stop in blocks:
        y = kept[0][start:stop]
        np.dot(x[start:stop], first[group].T, y)
        _activate(y, first_bias[group], is_tanh)
        for layer in range(len(kept) - 1):
            product = kept[layer + 1][start:stop]
            np.dot(y, weights[layer].T, product)
            _activate(product, biases[layer], is_tanh)
            y = product
        product = out[start:stop]
        np.dot(y, weights[-1].T, product)
        product += biases[-1]


@numba.njit(cache=True, error_model="numpy")
def backward_layers(
    blocks: np.ndarray,
    first: np.ndarray,
    weights: Arrays,
    is_tanh: bool,
    kept: Arrays,
    to_products: Arrays,
    to_x: np.ndarray,
) -> None:
    """Fill the gradients with respect to x W^T + b of all layers but the last, which is given, and `to_x` if not empty.

    Args:
        to_products: L + 1 of (B, outputs), the given one at the end. to_x: (B, D) or (0, D).
        The others are those of `forward_layers`.
    """
    for group, start, stop in blocks:
        for layer in range(len(kept) - 1, -1, -1):
            gradient = to_products[layer][start:stop]
            np.dot(to_products[layer + 1][start:stop], weights[layer], gradient)
            _through_activation(gradient, kept[layer][start:stop], is_tanh)
        if len(to_x):
            np.dot(to_products[0][start:stop], first[group], to_x[start:stop])


def _blocks(counts: Sequence[int], width: int) -> np.ndarray:
    """(group, first row, row after the last) of blocks of about BLOCK / width rows of one group each: (K, 3).

    They cover groups of `counts` consecutive rows, and none is tiny: a few rows are multiplied by other routines, which
    round differently.
    """
    blocks, start = [], 0
    for group, count in enumerate(counts):
        pieces = max(1, round(count * width / BLOCK))
        bounds = [start + count * i // pieces for i in range(pieces + 1)]
        if count:
            blocks += [(group, *bound) for bound in itertools.pairwise(bounds)]
        start += count
    return np.array(blocks, np.int64).reshape(-1, 3)


class _Layers(torch.autograd.Function):
    """`grouped_layers` with the parameters in one row: W_1 (Z, H, D), b_1 (Z, H), then W and b of every other layer."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, counts: Sequence[int], activation: Activation, *parameters: Tensor) -> Tensor:
        x, (first, *weights) = x.contiguous(), (w.contiguous() for w in parameters[::2])
        first_bias, *biases = (b.contiguous() for b in parameters[1::2])
        kept = [x.new_empty(len(x), w.shape[1]) for w in weights]  # what every hidden layer puts out
        out = x.new_empty(len(x), len(biases[-1]))
        ctx.blocks, ctx.counts = _blocks(counts, max(w.shape[1] for w in weights)), counts
        ctx.is_tanh = activation is nn.Tanh
        layers = (x.numpy(), first.numpy(), first_bias.numpy(), _numpy(weights), _numpy(biases))
        forward_layers(ctx.blocks, *layers, ctx.is_tanh, _numpy(kept), out.numpy())
        ctx.save_for_backward(x, first, *weights, *kept)
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Any, ...]:
        x, first, *saved = ctx.saved_tensors
        weights, kept = saved[: len(saved) // 2], saved[len(saved) // 2 :]
        to_x = torch.empty_like(x) if ctx.needs_input_grad[0] else x[:0]
        to_products = [*(torch.empty_like(y) for y in kept), gradients[0].contiguous()]  # with respect to x W^T + b
        layers = (first.numpy(), _numpy(weights), ctx.is_tanh, _numpy(kept))
        backward_layers(ctx.blocks, *layers, _numpy(to_products), to_x.numpy())
        # Sums over all rows are torch's: MKL is faster where the first factor is transposed.
        to_first, to_first_bias = torch.empty_like(first), first.new_empty(first.shape[:2])
        groups = zip(to_products[0].split(ctx.counts), x.split(ctx.counts), strict=True)
        for group, (gradient, inputs) in enumerate(groups):
            to_first[group] = (inputs.T @ gradient).T  # twice as fast as gradient.T @ inputs where inputs are few
            to_first_bias[group] = gradient.sum(0)
        others = [part for y, g in zip(kept, to_products[1:], strict=True) for part in (g.T @ y, g.sum(0))]
        return to_x if ctx.needs_input_grad[0] else None, None, None, to_first, to_first_bias, *others


def _numpy(tensors: Sequence[Tensor]) -> Arrays:
    return tuple(t.numpy() for t in tensors)


def grouped_layers(
    x: Tensor,
    counts: Sequence[int],
    first_weight: Tensor,
    first_bias: Tensor,
    rest: Sequence[nn.Linear],
    activation: Activation,
) -> Tensor:
    """A network whose first layer differs between groups of rows: (B, D) -> (B, O).

    Args:
        counts: rows of each of the Z groups, which follow each other in `x`.
        first_weight: (Z, H, D). first_bias: (Z, H).
        rest: the layers after the first, at least one. activation: after every layer but the last.
    """
    others = (parameter for layer in rest for parameter in (layer.weight, layer.bias))
    return _Layers.apply(x, counts, activation, first_weight, first_bias, *others)


class MLP(nn.Sequential):
    """Linear layers and between them an activation, Tanh or ReLU."""

    @property
    def layers(self) -> list[nn.Linear]:
        """The linear layers."""
        return [module for module in self if isinstance(module, nn.Linear)]

    def forward(self, x: Tensor) -> Tensor:
        """(..., D) -> (..., O)."""
        first, *rest = self.layers
        if not rest:
            return first(x)
        rows, activation = x.reshape(-1, x.shape[-1]), nn.Tanh if isinstance(self[1], nn.Tanh) else nn.ReLU
        weight, bias = first.weight.unsqueeze(0), first.bias.unsqueeze(0)
        y = grouped_layers(rows, [len(rows)], weight, bias, rest, activation)
        return y.view(*x.shape[:-1], y.shape[-1])


def mlp(sizes: Sequence[int], generator: torch.Generator, activation: Activation = nn.Tanh) -> MLP:
    """Layers sizes[0] -> ... -> sizes[-1] with `activation` between them and none after the last."""
    modules: list[nn.Module] = []
    for inputs, outputs in itertools.pairwise(sizes):
        modules += [linear(inputs, outputs, generator), activation()]
    return MLP(*modules[:-1])


def linear(inputs: int, outputs: int, generator: torch.Generator) -> nn.Linear:
    """A linear layer with Glorot-uniform weights and zero bias."""
    layer = nn.Linear(inputs, outputs)
    with torch.no_grad():
        nn.init.xavier_uniform_(layer.weight, generator=generator)
        layer.bias.zero_()
    return layer


@torch.no_grad()
def normalize_columns(layers: "Sequence[nn.Linear | SkillLinear]", last: float, generator: torch.Generator) -> None:
    """Draw the layers of a network anew: Gaussian weights of norm one per output, `last` in the last layer; no bias.

    What OpenAI Baselines call normc: a small last layer makes a policy start as pure noise around zero. The weights of
    a skill layer are scaled so that the norm is one, in root mean square, over what a single skill lets through.
    """
    for layer in layers:
        weight, active = torch.empty_like(layer.weight).normal_(generator=generator), 1.0
        if isinstance(layer, SkillLinear):
            active = layer.active_inputs / weight.shape[1]
        scale = (last if layer is layers[-1] else 1.0) / active**0.5
        layer.weight.copy_(scale * weight / weight.norm(dim=1, keepdim=True))
        layer.bias.zero_()


@numba.njit(cache=True, error_model="numpy", fastmath={"contract"})
def _few_rows(x: np.ndarray, weights: Arrays, biases: Arrays) -> np.ndarray:
    """Layers of weights (D, H), biases (H,) and tanh between them, over rows (N, D) -> (N, O)."""
    for layer in range(len(weights) - 1):
        x = np.dot(x, weights[layer])
        _activate(x, biases[layer], True)
    x = np.dot(x, weights[-1])
    x += biases[-1]
    return x


def _arrays(layers: Sequence[nn.Linear]) -> tuple[Arrays, Arrays]:
    """Weights (D, H) and biases (H,) of layers as they are now."""
    weights = tuple(np.ascontiguousarray(layer.weight.detach().numpy().T) for layer in layers)
    return weights, tuple(layer.bias.detach().numpy().copy() for layer in layers)


def for_few_rows(net: MLP) -> Callable[[np.ndarray], np.ndarray]:
    """The function that an MLP with tanh computes now, (N, D) -> (N, O), without the cost of torch's calls."""
    weights, biases = _arrays(net.layers)
    return lambda x: _few_rows(np.ascontiguousarray(x), weights, biases)


@numba.njit(cache=True, error_model="numpy", fastmath={"contract"})
def _few_grouped_rows(
    x: np.ndarray, group: np.ndarray, first: np.ndarray, first_bias: np.ndarray, weights: Arrays, biases: Arrays
) -> np.ndarray:
    """`_few_rows` behind a first layer of the group's own: (N, D), (N,), (Z, D, H), (Z, H) -> (N, O)."""
    hidden = first_bias[group]
    for i in range(len(x)):
        for d in range(x.shape[1]):
            entry, weight = x[i, d], first[group[i], d]
            for h in range(hidden.shape[1]):
                hidden[i, h] += entry * weight[h]
    _activate(hidden, np.zeros_like(first_bias[0]), True)
    return _few_rows(hidden, weights, biases)


def for_few_grouped_rows(
    first_weight: Tensor, first_bias: Tensor, rest: Sequence[nn.Linear]
) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """The function that `grouped_layers` with tanh computes now, rows (N, D) in any order and their groups (N,)."""
    first = first_weight.detach().transpose(1, 2).contiguous().numpy(), first_bias.detach().numpy().copy()
    behind = _arrays(rest)
    return lambda x, group: _few_grouped_rows(np.ascontiguousarray(x), group, *first, *behind)


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

    @property
    def active_inputs(self) -> int:
        """How many of its inputs the one-hot skill lets be other than zero."""
        return self.inputs * (2 if self.integration == "bilinear" else 1) + 1

    def effective(self) -> tuple[Tensor, Tensor]:
        """The weight (Z, H, D) and the bias (Z, H) that the one-hot input leaves for each skill."""
        D, Z = self.inputs, self.num_skills
        weight = self.weight[:, :D].unsqueeze(0)
        if self.integration == "bilinear":
            weight = weight + self.weight[:, D + Z :].view(-1, D, Z).permute(2, 0, 1)
        return weight.expand(Z, -1, -1), self.bias + self.weight[:, D : D + Z].T
