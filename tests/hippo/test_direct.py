"""Gradients written out for small minibatches, against plain torch with autograd, in float64."""

import math

import pytest
import torch
from torch import nn

from hippo.core.direct import Categorical, Gaussian, SquaredError, network_of
from hippo.core.networks import SkillLinear, linear, mlp
from hippo.core.policies import MIN_STD, gaussian_entropy, gaussian_log_prob
from hippo.core.ppo import clipped_surrogate

ROWS, SKILLS = 40, 3
CLIP, ENTROPY = 0.2, 0.05


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(4)


def layers_of(first, generator):
    """A first layer over 4 inputs, of the kind named, and two further ones, 5 -> 6 -> 2."""
    layer = linear(4, 5, generator) if first == "linear" else SkillLinear(4, SKILLS, 5, first, generator)
    layers = [layer, *mlp([5, 6, 2], generator).layers]
    for each in layers:  # biases that are not zero
        nn.init.normal_(each.bias, generator=generator)
    return [each.double() for each in layers]


def plain(layers, x, skill, activation):
    """The network as torch has it, from the one-hot definition of the skill layer."""
    first, *rest = layers
    if isinstance(first, SkillLinear):
        z = nn.functional.one_hot(skill, SKILLS).to(x.dtype)
        inputs = [x, z]
        if first.integration == "bilinear":
            inputs.append((x.unsqueeze(2) * z.unsqueeze(1)).flatten(1))
        y = torch.cat(inputs, 1) @ first.weight.T + first.bias
    else:
        y = first(x)
    for layer in rest:
        y = layer(activation(y))
    return y


def draw(generator):
    x = torch.randn(ROWS, 4, generator=generator, dtype=torch.float64)
    skill = torch.randint(SKILLS - 1, (ROWS,), generator=generator).sort().values  # one skill has no rows
    old, advantage = torch.randn(2, ROWS, generator=generator, dtype=torch.float64)
    return x, skill, old, advantage


def compare(loss, parameters):
    """The gradients that are there already equal autograd's of `loss`."""
    written = [p.grad.clone() for p in parameters]
    for mine, theirs in zip(written, torch.autograd.grad(loss, parameters, retain_graph=True), strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-6, atol=1e-8)  # the floor amplifies rounding


@pytest.mark.parametrize(
    ("first", "per_skill"),
    [("linear", False), ("bilinear", False), ("bilinear", True), ("concatenate", False), ("concatenate", True)],
)
def test_a_gaussians_surrogate_has_autograds_gradient(first, per_skill, generator):
    layers, (x, skill, _, advantage) = layers_of(first, generator), draw(generator)
    log_std = nn.Parameter(torch.tensor([[-0.3, -20.0]], dtype=torch.float64).repeat(SKILLS if per_skill else 1, 1))
    action = plain(layers, x, skill, torch.tanh).detach()
    action[:, 0] += torch.randn(ROWS, generator=generator, dtype=torch.float64)
    action[:, 1] += 1e-5  # where the standard deviation is at its floor

    def log_prob(rows):
        std = log_std.clamp(min=math.log(MIN_STD)).expand(SKILLS, -1)[skill[rows]]
        return gaussian_log_prob(plain(layers, x[rows], skill[rows], torch.tanh), std, action[rows]), std

    rows = torch.arange(0, ROWS, 2)
    now, std = log_prob(rows)
    # Ratios from e^-0.6 to e^0.6: with advantages of both signs every branch of the minimum is taken.
    before = now.detach() + torch.linspace(-0.6, 0.6, len(rows), dtype=torch.float64)
    gaussian = Gaussian(network_of(layers), log_std, x, None if first == "linear" else skill, action)
    kl, clipped, surrogate = gaussian.ascend(rows.numpy(), before.numpy(), advantage[rows].numpy(), CLIP, ENTROPY)
    gain = clipped_surrogate(now, before, advantage[rows], CLIP)
    compare(
        -gain.mean() - ENTROPY * gaussian_entropy(std).mean(), [log_std, *(p for la in layers for p in la.parameters())]
    )
    ratio = (now - before).exp().detach()
    assert kl == pytest.approx(float((ratio - 1 - ratio.log()).sum()))
    assert clipped == int(((ratio - 1).abs() > CLIP).sum())
    assert surrogate == pytest.approx(float(gain.detach().sum()))
    # The wrong variant, a surrogate that is not clipped, has another gradient.
    other = torch.autograd.grad(-((now - before).exp() * advantage[rows]).mean(), [log_std, *layers[1].parameters()])
    assert not torch.allclose(other[1], layers[1].weight.grad, rtol=1e-3)


def test_a_managers_surrogate_has_autograds_gradient(generator):
    layers, (x, _, _, advantage) = layers_of("linear", generator), draw(generator)
    choice = torch.randint(2, (ROWS,), generator=generator)
    rows = torch.arange(0, ROWS, 2)
    log_probs = plain(layers, x[rows], None, torch.tanh).log_softmax(-1)
    now = log_probs.gather(1, choice[rows, None]).squeeze(1)
    before = now.detach() + torch.linspace(-0.6, 0.6, len(rows), dtype=torch.float64)
    manager = Categorical(network_of(layers), x, choice)
    manager.ascend(rows.numpy(), before.numpy(), advantage[rows].numpy(), CLIP, ENTROPY)
    entropy = -(log_probs.exp() * log_probs).sum(-1).mean()
    gain = clipped_surrogate(now, before, advantage[rows], CLIP).mean()
    compare(-gain - ENTROPY * entropy, [p for layer in layers for p in layer.parameters()])


@pytest.mark.parametrize("first", ["linear", "bilinear"])
def test_a_values_squared_error_has_autograds_gradient(first, generator):
    layers, (x, skill, target, _) = layers_of(first, generator), draw(generator)
    layers[-1] = linear(6, 1, generator).double()
    rows = torch.arange(0, ROWS, 2)
    value = SquaredError(network_of(layers, nn.ReLU), x, None if first == "linear" else skill, target)
    value.descend(rows.numpy(), 0.5)
    error = plain(layers, x[rows], skill[rows], torch.relu).squeeze(1) - target[rows]
    compare(0.5 * error.square().mean(), [p for layer in layers for p in layer.parameters()])


def test_a_second_minibatch_overwrites_the_gradients_of_the_first(generator):
    layers, (x, _, target, _) = layers_of("linear", generator), draw(generator)
    layers[-1] = linear(6, 1, generator).double()
    value, rows = SquaredError(network_of(layers, nn.ReLU), x, None, target), torch.arange(10).numpy()
    value.descend(rows, 1.0)
    once = layers[0].weight.grad.clone()
    value.descend(rows, 1.0)
    assert torch.equal(layers[0].weight.grad, once)
