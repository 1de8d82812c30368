"""Advantages of both levels and the baselines they come from (paper section 4.2, Lemma 2)."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from hippo.core.direct import SquaredError, network_of
from hippo.core.gae import gae, segment_gae
from hippo.core.hierarchy import Batch, with_time
from hippo.core.hierarchy_config import HierarchyConfig
from hippo.core.levels import rows_by_skill
from hippo.core.normalize import RewardScale, standardize
from hippo.core.value import ValueFunction, explained_variance


class Baselines(nn.Module):
    """V(s) and V(s, z, time left); a baseline of either kind leaves the expected gradient unchanged (Lemma 2).

    Args:
        in_loop: an optimiser trains them in the minibatches of the policy, `fit` does not.
    """

    def __init__(
        self, config: HierarchyConfig, obs_size: int, generator: torch.Generator, in_loop: bool = False
    ) -> None:
        super().__init__()
        self.evaluations = config.value_iterations
        sizes, initialisation = config.value_hidden_sizes, config.initialisation
        self.single = ValueFunction(obs_size, sizes, generator, 0, initialisation, in_loop)
        self.skill = ValueFunction(obs_size + 1, sizes, generator, config.num_skills, initialisation, in_loop)
        self.reward_scale = RewardScale() if config.scale_rewards else None

    def inputs(self, kind: str, obs: Tensor, time_left: Tensor, skill: Tensor) -> tuple[Tensor, Tensor | None]:
        """What the baseline `kind` sees: its rows and, for the skill-conditioned one, their skills."""
        return (with_time(obs, time_left), skill) if kind == "skill" else (obs, None)

    def predict(self, kind: str, obs: Tensor, time_left: Tensor, skill: Tensor) -> Tensor:
        """Values (...) of the baseline `kind`: "skill", "single" or "none", which is zero."""
        if kind == "none":
            return torch.zeros(time_left.shape, dtype=torch.float64)
        return getattr(self, kind).predict(*self.inputs(kind, obs, time_left, skill))

    def critics(self, batch: Batch, returns: dict[str, Tensor]) -> list[SquaredError]:
        """The baselines in use over the rows that `levels` has, sorted by skill."""
        rows = rows_by_skill(batch)
        seen = [x[:-1].flatten(0, 1)[rows] for x in (batch.steps.obs, batch.time_left, batch.skill)]
        result = []
        for kind, target in returns.items():
            network = network_of(getattr(self, kind).layers, nn.ReLU)
            result.append(SquaredError(network, *self.inputs(kind, *seen), target.flatten()[rows].to(seen[0].dtype)))
        return result

    def fit(self, batch: Batch, returns: dict[str, Tensor]) -> None:
        """Refit the baselines in use to this batch, for the next iteration."""
        used = batch.used
        for kind, target in returns.items():
            x, skill = self.inputs(kind, batch.steps.obs[:-1][used], batch.time_left[:-1][used], batch.skill[:-1][used])
            getattr(self, kind).fit(x, target[used], self.evaluations, skill)


@dataclass
class Advantages:
    """What the two levels learn from, and what the baselines are to be fitted to."""

    manager: Tensor  # (T, N) standardised; read at decisions
    skills: Tensor  # (T, N) standardised
    returns: dict[str, Tensor]  # per baseline in use, (T, N): its lambda-returns
    explained_variance: dict[str, float]  # per baseline in use: of its prediction before it saw this batch


def advantages(batch: Batch, baselines: Baselines, config: HierarchyConfig) -> Advantages:
    """Advantages of both levels, from the baselines as fitted to the *previous* iteration's batch.

    At a segment's end the next skill value is that of the newly drawn (z, time left), which is what follows there. With
    `bootstrap_horizon`, a segment that ends exactly at the horizon counts as renewed with the same skill. Both
    advantages are standardised over all steps, though the manager's is only used at decisions (authors' code).
    """
    steps, used = batch.steps, batch.used
    # A step whose successor is not used ends its episode: what truncate_to_period drops does not exist.
    ends = used & ~torch.cat([used[1:], torch.ones_like(used[:1])]) | ~used
    reward, terminated, done = steps.scaled_reward * used, steps.terminated | ends, steps.done | ends
    final_obs, step, env = steps.final()
    value, next_value, advantage = {}, {}, {}
    for kind in sorted({config.manager_baseline, config.skill_baseline}):
        value[kind] = baselines.predict(kind, steps.obs, batch.time_left, batch.skill)
        final_value = baselines.predict(kind, final_obs, batch.time_left[step, env], batch.skill[step, env])
        next_value[kind] = value[kind][1:].index_put((step, env), final_value)
        advantage[kind] = gae(
            reward, value[kind][:-1], next_value[kind], terminated, done, config.gamma, config.gae_lambda
        )

    manager, learnt = advantage[config.manager_baseline], used
    if config.manager_advantage == "smdp":
        kind, learnt = config.manager_baseline, used & batch.is_decision[:-1]
        manager = segment_gae(
            reward,
            value[kind][:-1],
            next_value[kind],
            terminated,
            done,
            batch.is_decision[:-1],
            config.gamma,
            config.gae_lambda,
        )
    returns = {kind: advantage[kind] + value[kind][:-1] for kind in value if kind != "none"}
    return Advantages(
        masked_standardize(manager, learnt),
        masked_standardize(advantage[config.skill_baseline], used),
        returns,
        {kind: explained_variance(value[kind][:-1][used], target[used]) for kind, target in returns.items()},
    )


def masked_standardize(x: Tensor, mask: Tensor) -> Tensor:
    """Standardise the entries of `x` where `mask` holds, by their own statistics; zero elsewhere."""
    return torch.zeros_like(x).masked_scatter_(mask, standardize(x[mask]))
