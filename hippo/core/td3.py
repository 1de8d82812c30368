"""TD3 (Fujimoto, van Hoof and Meger 2018) as HIRO's code has it, for either level of a hierarchy.

Its critics see the action twice, in the first and in the second layer; its loss is Huber's; its target actions get
clipped noise and are not clipped back into the box. Source: tensorflow/models, research/efficient-hrl (agents/).
"""

import itertools
import math
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import smooth_l1_loss

from hippo.core.optimizers import Adam


def _uniform(shape: tuple[int, ...], bound: float, generator: torch.Generator) -> nn.Parameter:
    return nn.Parameter((2 * torch.rand(shape, generator=generator) - 1) * bound)


LAST_LAYER = 0.003  # bound of the last layers' initial weights


class Actor(nn.Module):
    """mu(x) = half range * tanh(net(x)), (B, D) -> (B, A)."""

    half_range: Tensor

    def __init__(
        self, inputs: int, half_range: Tensor, hidden_sizes: Sequence[int], generator: torch.Generator
    ) -> None:
        super().__init__()
        self.register_buffer("half_range", half_range.clone())
        sizes = [inputs, *hidden_sizes, len(half_range)]
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in itertools.pairwise(sizes))
        for i, layer in enumerate(self.layers):
            bound = LAST_LAYER if i == len(hidden_sizes) else 1 / math.sqrt(sizes[i])
            layer.weight = _uniform((sizes[i + 1], sizes[i]), bound, generator)
            layer.bias = _uniform((sizes[i + 1],), bound, generator)

    def forward(self, x: Tensor) -> Tensor:
        return self._of_first(self.layers[0](x))

    def of_shifted(self, x: Tensor, shifts: Tensor) -> Iterator[Tensor]:
        """mu of x (B, c, D) with each of M shifts (B, M, k) added to its last k entries: M times (B, c, A).

        The first layer is linear: of all shifts together it is one product for x and one for the shifts. One at a time,
        since the rows of one fit a core's cache.
        """
        first = self.layers[0]
        assert isinstance(first, nn.Linear)
        of_x, of_shift = first(x), shifts @ first.weight[:, -shifts.shape[-1] :].T
        for i in range(shifts.shape[1]):
            yield self._of_first((of_x + of_shift[:, i : i + 1]).flatten(0, 1)).unflatten(0, x.shape[:2])

    def _of_first(self, hidden: Tensor) -> Tensor:
        """Actions from what the first layer puts out, which is overwritten."""
        for layer in self.layers[1:]:
            hidden = layer(hidden.relu_())
        return self.half_range * torch.tanh(hidden)


class TwinCritics(nn.Module):
    """Q_1(x, a) and Q_2(x, a), computed together: (B, D), (B, A) -> (2, B)."""

    def __init__(self, inputs: int, actions: int, hidden_sizes: Sequence[int], generator: torch.Generator) -> None:
        super().__init__()
        first, second = hidden_sizes
        fan_in = (inputs + actions, first + actions, second)
        bounds = (1 / math.sqrt(fan_in[0]), 1 / math.sqrt(fan_in[1]), LAST_LAYER)
        shapes = zip(fan_in, (first, second, 1), bounds, strict=True)
        layers = [
            (_uniform((2, a, b), bound, generator), _uniform((2, 1, b), bound, generator)) for a, b, bound in shapes
        ]
        self.weights = nn.ParameterList([weight for weight, _ in layers])
        self.biases = nn.ParameterList([bias for _, bias in layers])

    def forward(self, x: Tensor, action: Tensor, count: int = 2) -> Tensor:
        """Values of the first `count` critics."""
        (w1, w2, w3), (b1, b2, b3) = ([p[:count] for p in group] for group in (self.weights, self.biases))
        repeated = action.expand(count, *action.shape)
        inputs = torch.cat([x, action], -1).expand(count, -1, -1)
        hidden = torch.baddbmm(b1, inputs, w1).relu_()
        hidden = torch.baddbmm(b2, torch.cat([hidden, repeated], -1), w2).relu_()
        return torch.baddbmm(b3, hidden, w3).squeeze(-1)


class TD3(nn.Module):
    """Actor, two critics, their targets and their Adams.

    Args:
        half_range: (A,) actions are in +- this. unit: (A,) what target noise 0.2, clipped at 0.5, is measured in.
        delay: critic updates per update of the actor and of the targets. tau: how far targets then move.
    """

    unit: Tensor
    updates: Tensor

    def __init__(
        self,
        inputs: int,
        half_range: Tensor,
        unit: Tensor,
        hidden_sizes: Sequence[int],
        generator: torch.Generator,
        *,
        actor_learning_rate: float,
        critic_learning_rate: float,
        gamma: float,
        tau: float,
        delay: int,
        target_noise: float,
        target_noise_clip: float,
    ) -> None:
        super().__init__()
        self.actor = Actor(inputs, half_range, hidden_sizes, generator)
        self.critics = TwinCritics(inputs, len(half_range), hidden_sizes, generator)
        self.target_actor = Actor(inputs, half_range, hidden_sizes, generator)
        self.target_critics = TwinCritics(inputs, len(half_range), hidden_sizes, generator)
        self.target_actor.load_state_dict(self.actor.state_dict())
        self.target_critics.load_state_dict(self.critics.state_dict())
        self.register_buffer("unit", unit.clone())
        self.register_buffer("updates", torch.tensor(0))
        self.gamma, self.tau, self.delay = gamma, tau, delay
        self.target_noise, self.target_noise_clip = target_noise, target_noise_clip
        self.actor_optimizer = Adam(self.actor.parameters(), lr=actor_learning_rate, fused=True)
        self.critic_optimizer = Adam(self.critics.parameters(), lr=critic_learning_rate, fused=True)

    @torch.no_grad()
    def target(self, reward: Tensor, next_x: Tensor, continues: Tensor, generator: torch.Generator) -> Tensor:
        """y = r + gamma continues min_j Q'_j(x', mu'(x') + noise), (B,)."""
        action = self.target_actor(next_x)
        noise = (torch.randn(action.shape, generator=generator) * self.target_noise).clamp_(
            -self.target_noise_clip, self.target_noise_clip
        )
        value = self.target_critics(next_x, action + noise * self.unit).amin(0)
        return reward + self.gamma * continues * value

    def update(
        self, x: Tensor, action: Tensor, reward: Tensor, next_x: Tensor, continues: Tensor, generator: torch.Generator
    ) -> Tensor:
        """One step of the critics, and every `delay`-th time of the actor and the targets, on a batch of B transitions.

        Args:
            x, next_x: (B, D). action: (B, A). reward, continues: (B,); continues is 0 where nothing follows.

        Returns:
            (2,) the critics' summed Huber loss and their mean value.
        """
        y = self.target(reward, next_x, continues, generator)
        value = self.critics(x, action)
        loss = 2 * smooth_l1_loss(value, y.expand_as(value))  # summed over the two, averaged over the batch
        self.critic_optimizer.zero_grad(set_to_none=True)
        loss.backward()
        self.critic_optimizer.step()
        self.updates += 1
        if int(self.updates) % self.delay == 0:
            self._update_actor(x)
            self._move_targets()
        return torch.stack([loss.detach(), value.detach().mean()])

    def _update_actor(self, x: Tensor) -> None:
        for p in self.critics.parameters():
            p.requires_grad_(False)  # only the way through them is needed
        loss = -self.critics(x, self.actor(x), 1).mean()
        self.actor_optimizer.zero_grad(set_to_none=True)
        loss.backward()
        self.actor_optimizer.step()
        for p in self.critics.parameters():
            p.requires_grad_(True)

    @torch.no_grad()
    def _move_targets(self) -> None:
        pairs = ((self.target_actor, self.actor), (self.target_critics, self.critics))
        for target, online in pairs:
            torch._foreach_lerp_(list(target.parameters()), list(online.parameters()), self.tau)

    def optimizers(self, prefix: str) -> dict[str, torch.optim.Optimizer]:
        """The two Adams by the names that a checkpoint gives them."""
        return {f"{prefix}_actor_optimizer": self.actor_optimizer, f"{prefix}_critic_optimizer": self.critic_optimizer}
