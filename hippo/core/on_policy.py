"""The settings that on-policy learners share: budget, discount and baselines; and how a clipped surrogate is maximised.

The defaults are the paper's and, where it is silent, the authors' code's. What a PPO of today adds (running statistics,
small initial policies, minibatches that train the value functions too) is off unless `protocol=modern` or a setting
asks for it.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import nn

from hippo.core import seeding
from hippo.core.budget import BudgetConfig
from hippo.core.direct import SquaredError
from hippo.core.minibatch import minibatches
from hippo.core.normalize import ObservationFilter
from hippo.core.optimizers import Adam
from hippo.core.ppo import Level, in_chunks, maximize
from hippo.core.settings import WIDEST, ConfigError, setting

ADAM_EPSILON = 1e-5  # of the minibatches' Adam (OpenAI Baselines)


@dataclass
class OnPolicyConfig(BudgetConfig):
    """Discount, baselines and what is done to observations, rewards and initial weights."""

    gamma: float = setting(
        0.999, "discount per environment step", paper="0.999 (App. A)", code="0.99, 0.999 by flag", above=0.0, high=1.0
    )
    gae_lambda: float = setting(
        1.0, "GAE lambda", paper="cites GAE, gives no value", code="1 (hier_batch_polopt.py:55)", low=0.0, high=1.0
    )
    bootstrap_horizon: bool = setting(
        False,
        "whether the end of the horizon bootstraps the value",
        paper="finite-horizon MDP (section 2)",
        code="no (hier_base.py:57)",
    )
    value_hidden_sizes: list[int] = setting(
        [32, 32], "hidden layers of the baselines", paper="2 x 32 (App. A)", low=1, high=WIDEST
    )
    value_iterations: int = setting(
        10,
        "the most loss evaluations that the fit of a baseline may use per iteration",
        code="KL-constrained L-BFGS, up to 20 iterations x 10 penalties",
        ours="bounds the cost of an iteration; 20 explain the next batch no better (docs/performance.md)",
        low=1,
    )
    initialisation: str = setting(
        "glorot",
        "initial weights: Glorot-uniform, or normc (norm one per output, 0.01 in the last layer of a policy)",
        code="glorot (rllab)",
        choices=("glorot", "normc"),
    )
    normalize_observations: bool = setting(
        False, "standardise observations by their running mean and deviation", code="no"
    )
    scale_rewards: bool = setting(
        False, "learn from rewards over the running deviation of the discounted return", code="no"
    )


@dataclass(kw_only=True)
class SurrogateConfig(OnPolicyConfig):
    """How the clipped surrogate is maximised: full-batch steps, or passes in minibatches that train the values too."""

    learning_rate: float = setting(3e-3, "Adam step size", paper="3e-3 (App. A)", above=0.0)
    learning_rate_decay: bool = setting(False, "let the step size fall linearly to zero over the iterations", code="no")
    clip_range: float = setting(0.1, "clipping parameter epsilon", paper="0.1 (App. A)", above=0.0)
    updates: int = setting(
        10, "passes over the batch per iteration", paper="10 gradient updates (App. A)", code="80, 10 by flag", low=1
    )
    minibatch_size: int = setting(0, "environment steps per gradient step; 0: the whole batch", code="0", low=0)
    value_loss_weight: float = setting(
        0.0,
        "weight of the values' squared error in the same minibatches; 0: baselines are fitted after the policy",
        code="0",
        low=0.0,
    )
    entropy_weight: float = setting(0.0, "weight of the policies' entropy, in minibatches", code="0", low=0.0)
    max_gradient_norm: float = setting(
        0.0, "clip the gradient of a minibatch to this norm; 0: do not", code="0", low=0.0
    )
    target_kl: float = setting(
        0.0,
        "no further pass over the batch once a level's mean KL divergence in a pass is above this; 0: all passes",
        code="0",
        low=0.0,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.minibatch_size > self.batch_size:
            raise ConfigError("minibatch_size", self.minibatch_size, f"must be at most the batch, {self.batch_size}")
        for key in ("value_loss_weight", "entropy_weight", "max_gradient_norm", "target_kl"):
            if getattr(self, key) and not self.minibatch_size:
                raise ConfigError(key, getattr(self, key), "needs minibatches: set minibatch_size")

    @property
    def values_in_loop(self) -> bool:
        """Whether the minibatches of the policy train its value functions, too."""
        return self.value_loss_weight > 0


def make_optimizer(config: SurrogateConfig, parameters: Iterable[nn.Parameter]) -> Adam:
    """Adam as `improve` uses it."""
    if config.minibatch_size:
        return Adam(parameters, lr=config.learning_rate, eps=ADAM_EPSILON, fused=True)
    return Adam(parameters, lr=config.learning_rate)


def improve(
    config: SurrogateConfig,
    levels: Sequence[Level],
    critics: Sequence[SquaredError],
    optimizer: torch.optim.Optimizer,
    observation_filter: ObservationFilter | None,
    num_steps: int,
    seed: int,
    iteration: int,
) -> dict[str, float]:
    """Take an iteration's gradient steps on a batch of `num_steps`; returns the metrics of `maximize`.

    None are taken on a batch that was seen through an empty filter: it only fills the statistics.
    """
    for group in optimizer.param_groups:
        group["lr"] = config.learning_rate * (1 - config.learning_rate_decay * iteration / config.iterations)
    passes = 0 if observation_filter is not None and not observation_filter.count else config.updates
    if not config.minibatch_size:
        return maximize(levels, optimizer, passes, config.clip_range, num_steps)
    generator = seeding.torch_generator(seed, "minibatches", iteration)
    return _in_minibatches(config, levels, critics, optimizer, num_steps, passes, generator)


def _in_minibatches(
    config: SurrogateConfig,
    levels: Sequence[Level],
    critics: Sequence[SquaredError],
    optimizer: torch.optim.Optimizer,
    num_steps: int,
    passes: int,
    generator: torch.Generator,
) -> dict[str, float]:
    """`improve` in minibatches: sets of steps that levels and critics share, each learning from the mean over its rows.

    A level whose rows are fewer (`Level.at`) takes part with those that lie in the minibatch. The metrics are means
    over the last pass that was taken.
    """
    parts = max(1, num_steps // config.minibatch_size)
    parameters = [p for group in optimizer.param_groups for p in group["params"]]
    shares = [level.direct() for level in levels if level.direct is not None]
    assert len(shares) == len(levels), "every level of a minibatch has its gradient written out"
    old = [in_chunks(level.log_prob, len(level.advantage)).numpy() for level in levels]
    advantage = [level.advantage.numpy() for level in levels]
    at = [None if level.at is None else level.at.numpy() for level in levels]
    sums, sizes = np.zeros((len(levels), 3)), np.array([len(a) for a in advantage])
    for step, minibatch in enumerate(minibatches(num_steps, parts, passes, generator)):
        if step % parts == 0:
            if config.target_kl and (sums[:, 0] > config.target_kl * sizes).any():
                break
            sums[:] = 0  # of this pass: KL, clipped, surrogate
        rows = minibatch.numpy()
        for i, share in enumerate(shares):
            own = rows if at[i] is None else at[i][rows]  # type: ignore[index]
            own = own[own >= 0]
            sums[i] += share.ascend(own, old[i][own], advantage[i][own], config.clip_range, config.entropy_weight)
        for critic in critics:
            critic.descend(rows, config.value_loss_weight)
        if config.max_gradient_norm:
            nn.utils.clip_grad_norm_(parameters, config.max_gradient_norm)
        optimizer.step()
    metrics: dict[str, float] = {}
    for level, (kl, clipped, _), size in zip(levels, sums, sizes, strict=True):
        metrics |= {f"{level.name}_approx_kl": kl / size, f"{level.name}_clip_fraction": clipped / size}
    return metrics | {"surrogate": float((sums[:, 2] / sizes).sum())}
