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
