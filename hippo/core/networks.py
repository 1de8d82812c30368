"""Multilayer perceptrons of this suite, evaluated and differentiated block by block within a processor's caches.

Glorot-uniform weights and zero biases, as in the authors' code. A network is one node of autograd's graph: `_Layers`
takes a few rows at a time through all layers, so that activations are still in the cache when the next layer reads
them, and does the same on the way back. What sums over rows (gradients of weights and biases) is taken over all rows
at once.
"""

import itertools
from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor, nn

BLOCK = 131072  # entries of the widest activation of the rows that pass through all layers together: 512 kB
SAME_BITS_TERMS = 192  # MKL adds up as many terms before it starts a new partial sum
# MKL leaves AVX-512 unused on AMD's processors, where oneDNN takes half its time; with AVX2 MKL is the faster one.
ONEDNN_IS_FASTER = torch.backends.mkldnn.is_available() and torch.backends.cpu.get_cpu_capability() == "AVX512"


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
def _tanh(x: np.ndarray, out: np.ndarray) -> None:
    """Write tanh of x (n,) to out (n,), other memory; single precision by the fraction, in a sixth of numpy's time."""
    if x.itemsize == 4:
        for i in range(len(x)):
            out[i] = _lambert_tanh(x[i])
    else:
        for i in range(len(x)):
            out[i] = np.tanh(x[i])


@numba.njit(cache=True, error_model="numpy", fastmath={"contract"})
def _tanh_in_place(x: np.ndarray) -> None:
    """`_tanh` into its argument; a kernel of its own, because loops over memory that may overlap are not vectorised."""
    if x.itemsize == 4:
        for i in range(len(x)):
            x[i] = _lambert_tanh(x[i])
    else:
        for i in range(len(x)):
            x[i] = np.tanh(x[i])


@numba.njit(cache=True, error_model="numpy", fastmath={"contract"})
def _through_tanh(gradient: np.ndarray, y: np.ndarray, out: np.ndarray) -> None:
    """Write gradient (1 - y^2) to out; all (n,)."""
    for i in range(len(y)):
        out[i] = gradient[i] - gradient[i] * y[i] * y[i]


class Tanh(nn.Tanh):
    """The hidden activation of all policies."""

    @staticmethod
    def apply_to(x: Tensor, out: Tensor) -> None:
        """tanh(x), written into `out`."""
        _tanh(x.view(-1).numpy(), out.view(-1).numpy())

    @staticmethod
    def backward_to(gradient: Tensor, y: Tensor, out: Tensor) -> None:
        """Times 1 - y^2, the derivative at the output y; written into `out`."""
        _through_tanh(gradient.view(-1).numpy(), y.view(-1).numpy(), out.view(-1).numpy())


class ReLU(nn.ReLU):
    """The hidden activation of value functions."""

    @staticmethod
    def apply_to(x: Tensor, out: Tensor) -> None:
        """max(x, 0), written into `out`."""
        torch.clamp(x, min=0, out=out)

    @staticmethod
    def backward_to(gradient: Tensor, y: Tensor, out: Tensor) -> None:
        """Times 1 where the output y is positive, else 0; written into `out`."""
        torch.ops.aten.threshold_backward.grad_input(gradient, y, 0, grad_input=out)


Activation = type[Tanh] | type[ReLU]


def _by_onednn(weight: Tensor) -> bool:
    """Whether oneDNN multiplies by this weight (H, D): where both give the same bits and it is faster.

    The same bits: sums of at most 192 terms, at least 16 outputs (measured on AMD EPYCs of families 25 and 26).
    """
    outputs, inputs = weight.shape
    return ONEDNN_IS_FASTER and outputs >= 16 and inputs <= SAME_BITS_TERMS and weight.dtype == torch.float32


def _affine(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """x W^T + b: (B, D), (H, D), (H,) -> (B, H). The weight must be contiguous, which oneDNN takes for granted."""
    if len(x) >= 4 and _by_onednn(weight):
        return torch.ops.mkldnn._linear_pointwise(x, weight, bias, "none", [], "")
    return torch.addmm(bias, x, weight.T)


def _to_input(gradient: Tensor, weight: Tensor, transposed: Tensor) -> Tensor:
    """The gradient with respect to the input of `_affine`: (B, H), (H, D), its contiguous transpose -> (B, D)."""
    if len(gradient) >= 4 and len(weight) <= SAME_BITS_TERMS and _by_onednn(weight):
        return torch.ops.mkldnn._linear_pointwise(gradient, transposed, None, "none", [], "")
    return gradient @ weight


def _blocks(counts: Sequence[int], width: int) -> Iterator[tuple[int, slice]]:
    """(group, rows) of blocks of about BLOCK / width rows that cover groups of `counts` consecutive rows; none is tiny.

    A few rows are multiplied by other routines, which round differently.
    """
    start = 0
    for group, count in enumerate(counts):
        pieces = max(1, round(count * width / BLOCK))
        bounds = [start + count * i // pieces for i in range(pieces + 1)]
        if count:
            yield from ((group, slice(*bound)) for bound in itertools.pairwise(bounds))
        start += count


class _Layers(torch.autograd.Function):
    """`grouped_layers` with the parameters in one row: W_1 (Z, H, D), b_1 (Z, H), then W and b of every other layer."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, counts: Sequence[int], activation: Activation, *parameters: Tensor) -> Tensor:
        x, (first, *weights) = x.contiguous(), (w.contiguous() for w in parameters[::2])
        first_bias, *biases = (b.contiguous() for b in parameters[1::2])
        kept = [x.new_empty(len(x), w.shape[1]) for w in weights]  # what every hidden layer puts out
        for group, rows in _blocks(counts, max(w.shape[1] for w in weights)):
            layers = [(first[group], first_bias[group]), *zip(weights, biases, strict=True)]
            y = x[rows]
            for (weight, bias), hidden in zip(layers, kept, strict=False):  # all but the last layer
                product, y = _affine(y, weight, bias), hidden[rows]
                activation.apply_to(product, y)
        ctx.save_for_backward(x, first, *weights, *kept)
        ctx.counts, ctx.activation = counts, activation
        # Over all rows at once: the rounding of narrow products depends on how many rows they have.
        return _affine(kept[-1], weights[-1], biases[-1])

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Any, ...]:
        x, first, *saved = ctx.saved_tensors
        weights, kept = saved[: len(saved) // 2], saved[len(saved) // 2 :]
        transposed, first_transposed = [w.T.contiguous() for w in weights], first.transpose(1, 2).contiguous()
        to_x = torch.empty_like(x) if ctx.needs_input_grad[0] else None
        to_products = [*(torch.empty_like(y) for y in kept), gradients[0].contiguous()]  # what `_affine` returned
        for group, rows in _blocks(ctx.counts, max(y.shape[1] for y in kept)):
            gradient = to_products[-1][rows]
            for weight, flipped, y, out in reversed([*zip(weights, transposed, kept, to_products[:-1], strict=True)]):
                to_y, gradient = _to_input(gradient, weight, flipped), out[rows]
                ctx.activation.backward_to(to_y, y[rows], gradient)
            if to_x is not None:
                to_x[rows] = _to_input(gradient, first[group], first_transposed[group])
        to_first, to_first_bias = torch.empty_like(first), first.new_empty(first.shape[:2])
        groups = zip(to_products[0].split(ctx.counts), x.split(ctx.counts), strict=True)
        for group, (gradient, inputs) in enumerate(groups):
            to_first[group] = (inputs.T @ gradient).T  # twice as fast as gradient.T @ inputs where inputs are few
            to_first_bias[group] = gradient.sum(0)
        others = [part for y, g in zip(kept, to_products[1:], strict=True) for part in (g.T @ y, g.sum(0))]
        return to_x, None, None, to_first, to_first_bias, *others


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
        rows, activation = x.reshape(-1, x.shape[-1]), Tanh if isinstance(self[1], Tanh) else ReLU
        weight, bias = first.weight.unsqueeze(0), first.bias.unsqueeze(0)
        y = grouped_layers(rows, [len(rows)], weight, bias, rest, activation)
        return y.view(*x.shape[:-1], y.shape[-1])


def mlp(sizes: Sequence[int], generator: torch.Generator, activation: Activation = Tanh) -> MLP:
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


@numba.njit(cache=True, error_model="numpy", fastmath={"contract"})
def _few_rows(x: np.ndarray, weights: tuple[np.ndarray, ...], biases: tuple[np.ndarray, ...]) -> np.ndarray:
    """Layers of weights (D, H), biases (H,) and tanh between them, over rows (N, D) -> (N, O)."""
    for layer in range(len(weights)):
        if layer:
            _tanh_in_place(x.reshape(-1))
        x = np.dot(x, weights[layer])
        x += biases[layer]
    return x


def _arrays(layers: Sequence[nn.Linear]) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
    """Weights (D, H) and biases (H,) of layers as they are now."""
    weights = tuple(np.ascontiguousarray(layer.weight.detach().numpy().T) for layer in layers)
    return weights, tuple(layer.bias.detach().numpy().copy() for layer in layers)


def for_few_rows(net: MLP) -> Callable[[np.ndarray], np.ndarray]:
    """The function that an MLP with tanh computes now, (N, D) -> (N, O), without the cost of torch's calls."""
    weights, biases = _arrays(net.layers)
    return lambda x: _few_rows(np.ascontiguousarray(x), weights, biases)


@numba.njit(cache=True, error_model="numpy", fastmath={"contract"})
def _grouped_layer(x: np.ndarray, group: np.ndarray, weight: np.ndarray, bias: np.ndarray, out: np.ndarray) -> None:
    """Write x_i W_z + b_z for the group z of every row to out (N, H): x (N, D), group (N,), (Z, D, H), (Z, H)."""
    for i in range(len(x)):
        z = group[i]
        out[i] = bias[z]
        for d in range(x.shape[1]):
            for h in range(out.shape[1]):
                out[i, h] += x[i, d] * weight[z, d, h]


def for_few_grouped_rows(
    first_weight: Tensor, first_bias: Tensor, rest: Sequence[nn.Linear]
) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """The function that `grouped_layers` with tanh computes now, rows (N, D) in any order and their groups (N,)."""
    weights, biases = _arrays(rest)
    weight, bias = first_weight.detach().transpose(1, 2).contiguous().numpy(), first_bias.detach().numpy().copy()

    def forward(x: np.ndarray, group: np.ndarray) -> np.ndarray:
        hidden = np.empty((len(x), bias.shape[1]), x.dtype)
        _grouped_layer(np.ascontiguousarray(x), group, weight, bias, hidden)
        _tanh_in_place(hidden.reshape(-1))
        return _few_rows(hidden, weights, biases)

    return forward


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
        """The weight (Z, H, D) and the bias (Z, H) that the one-hot input leaves for each skill."""
        D, Z = self.inputs, self.num_skills
        weight = self.weight[:, :D].unsqueeze(0)
        if self.integration == "bilinear":
            weight = weight + self.weight[:, D + Z :].view(-1, D, Z).permute(2, 0, 1)
        return weight.expand(Z, -1, -1), self.bias + self.weight[:, D : D + Z].T
