"""Networks in blocks against torch's own layers, in float64, and the layer over a one-hot skill written out."""

import numpy as np
import pytest
import torch
from torch import nn

from hippo.core import networks
from hippo.core.networks import SkillLinear, grouped_layers, mlp


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def plain(net: networks.MLP, activation: type) -> nn.Sequential:
    """The same parameters in torch's own modules."""
    modules = []
    for layer in net.layers:
        copy = nn.Linear(layer.in_features, layer.out_features, dtype=torch.float64)
        copy.load_state_dict(layer.state_dict())
        modules += [copy, nn.Tanh() if activation is nn.Tanh else nn.ReLU()]
    return nn.Sequential(*modules[:-1])


def activated(x: np.ndarray, bias: float, is_tanh: bool = True) -> np.ndarray:
    y = x[:, None].copy()
    networks._activate(y, np.array([bias], x.dtype), is_tanh)
    return y[:, 0]


def test_tanh_is_within_four_units_of_the_seventh_digit_and_saturates_at_one():
    x = np.concatenate([np.linspace(-12, 12, 400_001), [1e-30, -1e-7, 50.0, -np.inf]]).astype(np.float32)
    exact = np.tanh(x.astype(np.float64))
    ours = activated(x, 0.0)
    np.testing.assert_allclose(ours, exact, rtol=4e-7, atol=0)
    assert np.abs(ours).max() == 1.0
    for is_tanh in (True, False):
        assert np.isnan(activated(np.array([np.nan], np.float32), 0.0, is_tanh))
    np.testing.assert_array_equal(activated(np.float32([0.25, -0.5]), 0.75), activated(np.float32([1.0, 0.25]), 0.0))
    above, below = (np.array(c, np.float64)[:6][::-1] for c in (networks.P, networks.Q))  # the fraction cut too early
    assert np.abs(x * np.polyval(above, x * x) / np.polyval(below, x * x) - exact)[np.abs(x) < 9].max() > 1e-4


@pytest.mark.parametrize("activation", [nn.Tanh, nn.ReLU])
@pytest.mark.parametrize("sizes", [(3, 2), (3, 5, 2), (3, 7, 5, 1)])
def test_an_mlp_and_all_its_gradients_are_those_of_torchs_layers(activation, sizes, monkeypatch):
    monkeypatch.setattr(networks, "BLOCK", 20)
    net = mlp(sizes, generator(), activation).double()
    reference = plain(net, activation)
    x = torch.randn(2, 11, 3, generator=generator(1), dtype=torch.float64, requires_grad=True)
    same_x = x.detach().clone().requires_grad_()
    y, same_y = net(x), reference(same_x)
    torch.testing.assert_close(y, same_y, rtol=1e-12, atol=1e-14)
    gradient = torch.randn(y.shape, generator=generator(2), dtype=torch.float64)
    y.backward(gradient)
    same_y.backward(gradient)
    torch.testing.assert_close(x.grad, same_x.grad, rtol=1e-12, atol=1e-14)
    for mine, theirs in zip(net.parameters(), reference.parameters(), strict=True):
        torch.testing.assert_close(mine.grad, theirs.grad, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("integration", ["bilinear", "concatenate"])
@pytest.mark.parametrize("counts", [[2, 1, 3, 1], [0, 7, 0, 0], [3, 0, 0, 4]])
def test_the_skill_layer_is_a_linear_layer_over_the_one_hot_input(integration, counts):
    layer, rest = SkillLinear(3, 4, 5, integration, generator()).double(), nn.Linear(5, 2, dtype=torch.float64)
    x = torch.randn(7, 3, generator=generator(1), dtype=torch.float64)
    skill = torch.arange(4).repeat_interleave(torch.tensor(counts))
    z = nn.functional.one_hot(skill, 4).double()
    product = (x.unsqueeze(2) * z.unsqueeze(1)).flatten(1)  # entry i Z + j is x_i z_j
    inputs = torch.cat([x, z, product] if integration == "bilinear" else [x, z], 1)
    expected = rest(torch.tanh(inputs @ layer.weight.T + layer.bias))
    ours = grouped_layers(x, counts, *layer.effective(), [rest], nn.Tanh)
    torch.testing.assert_close(ours, expected)
    gradient = torch.randn(7, 2, generator=generator(2), dtype=torch.float64)
    parameters = [layer.weight, layer.bias, rest.weight, rest.bias]
    for mine, theirs in zip(
        torch.autograd.grad(ours, parameters, gradient),
        torch.autograd.grad(expected, parameters, gradient),
        strict=True,
    ):
        torch.testing.assert_close(mine, theirs)
    if integration == "bilinear":
        wrong = torch.cat([x, z, (z.unsqueeze(2) * x.unsqueeze(1)).flatten(1)], 1)  # skill-major flattening
        assert not torch.allclose(rest(torch.tanh(wrong @ layer.weight.T + layer.bias)), expected)


def test_an_unknown_integration_is_named():
    with pytest.raises(ValueError, match="integration=sum"):
        SkillLinear(3, 4, 5, "sum", generator())


@pytest.mark.parametrize("rows", [1, 3, 4, 50, 1000])
@pytest.mark.parametrize("sizes", [(17, 32, 32, 1), (64, 64, 6), (17, 256, 64, 3)])
def test_single_precision_is_close_to_float64(rows, sizes):
    """Also of a first weight whose memory is transposed and a bias whose memory is strided."""
    net = mlp(sizes, generator())
    x = torch.randn(rows, sizes[0], generator=generator(), requires_grad=True)
    weight = torch.randn(sizes[0], sizes[1], 3, generator=generator(1))[..., 1].T.unsqueeze(0).requires_grad_()
    bias = torch.randn(sizes[1], 3, generator=generator(2))[:, 1].unsqueeze(0).requires_grad_()
    leaves = [x, weight, bias, *(p for layer in net.layers[1:] for p in layer.parameters())]
    y = grouped_layers(x, [rows], weight, bias, net.layers[1:], nn.Tanh)
    gradient = torch.randn(y.shape, generator=generator(3))
    ours = torch.autograd.grad(y, leaves, gradient)
    exact = [leaf.detach().double().requires_grad_() for leaf in leaves]
    reference = exact[0] @ exact[1][0].T + exact[2]
    for w, b in zip(exact[3::2], exact[4::2], strict=True):
        reference = torch.tanh(reference) @ w.T + b
    torch.testing.assert_close(y.double(), reference, rtol=1e-4, atol=1e-4)
    for mine, theirs in zip(ours, torch.autograd.grad(reference, exact, gradient.double()), strict=True):
        torch.testing.assert_close(mine.double(), theirs, rtol=1e-4, atol=5e-4)


def test_numbers_do_not_depend_on_the_size_of_a_block(monkeypatch):
    policy = mlp([15, 64, 64, 3], generator())
    layer = SkillLinear(15, 6, 64, "bilinear", generator(1))
    x, gradient = torch.randn(5000, 15, generator=generator(2)), torch.randn(5000, 3, generator=generator(3))
    leaves = [layer.weight, layer.bias, *(p for m in policy.layers[1:] for p in m.parameters())]

    def outcome(block):
        monkeypatch.setattr(networks, "BLOCK", block)
        y = grouped_layers(x, [900, 1100, 3, 2000, 997, 0], *layer.effective(), policy.layers[1:], nn.Tanh)
        return [y.detach(), *torch.autograd.grad(y, leaves, gradient)]

    whole = outcome(10**9)
    for block in (300 * 64, 1024 * 64):
        for mine, theirs in zip(outcome(block), whole, strict=True):  # the same bits on the processors tried
            torch.testing.assert_close(mine, theirs, rtol=1e-6, atol=1e-6 * float(theirs.abs().max()))


def test_blocks_cover_every_group_and_none_is_tiny(monkeypatch):
    monkeypatch.setattr(networks, "BLOCK", 800)
    counts = [0, 1, 99, 101, 0, 1234, 150]
    covered = [(group, row) for group, *rows in networks._blocks(counts, 8).tolist() for row in range(*rows)]
    groups = np.repeat(np.arange(len(counts)), counts)
    assert covered == list(zip(groups.tolist(), range(sum(counts)), strict=True))
    for group, start, stop in networks._blocks(counts, 8).tolist():
        assert min(counts[group], 66) <= stop - start <= 150
