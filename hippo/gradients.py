"""How good is the approximate hierarchical gradient? Lemma 1, its assumption and Table 2 of the paper, measured.

A segment is the p steps between two decisions. With the skill unobserved, its actions have the probability of Eq. 3,

    exact:        L_k = log sum_j pi_h(j|s_k) prod_t pi_l(a_t|s_t, j)

and Lemma 1 replaces the sum by the term of the skill z_k that was sampled:

    approximate:  L_k = log pi_h(z_k|s_k) + sum_t log pi_l(a_t|s_t, z_k).

Everything is summed in logarithms, so that neither long periods nor many action dimensions underflow (the authors'
code exponentiates first).
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from hippo.core import seeding
from hippo.core.advantages import Baselines, advantages
from hippo.core.checkpoint import Checkpoint
from hippo.core.gae import gae
from hippo.core.hierarchy import Batch, HierarchicalPolicy, collect, restored
from hippo.core.hierarchy_config import HierarchyConfig
from hippo.core.levels import levels
from hippo.core.policies import gaussian_log_prob
from hippo.core.ppo import CHUNK, chunks


@dataclass
class Segments:
    """The steps of a batch grouped by commitment: K segments of R rows, ordered by environment, then time."""

    manager_input: Tensor  # (K, D) what the manager saw at each decision
    skill: Tensor  # (K,) the skill it chose
    trajectory: Tensor  # (K,) index of the episode
    length: Tensor  # (K,) steps
    skill_input: Tensor  # (R, D) what the skills saw at every step
    action: Tensor  # (R, A)
    position: Tensor  # (K,) row of the decision in the flattened, environment-major batch

    @property
    def row_segment(self) -> Tensor:
        """(R,) the segment of every row."""
        return torch.arange(len(self.length)).repeat_interleave(self.length)

    def trajectory_bounds(self) -> list[tuple[int, int]]:
        """First segment and end of every trajectory."""
        ends = (torch.diff(self.trajectory).nonzero().squeeze(-1) + 1).tolist()
        return list(zip([0, *ends], [*ends, len(self.length)], strict=True))

    def part(self, first: int, last: int) -> "Segments":
        """Segments first .. last - 1."""
        offset = torch.cat([torch.zeros(1, dtype=torch.long), self.length.cumsum(0)])
        rows = slice(int(offset[first]), int(offset[last]))
        k = slice(first, last)
        return Segments(
            self.manager_input[k],
            self.skill[k],
            self.trajectory[k],
            self.length[k],
            self.skill_input[rows],
            self.action[rows],
            self.position[k],
        )

    def parts(self) -> Iterator["Segments"]:
        """Pieces of whole segments with about CHUNK rows each."""
        offset, first = self.length.cumsum(0), 0
        while first < len(self.length):
            reached = int(offset[first - 1]) if first else 0
            last = max(first + 1, int(torch.searchsorted(offset, reached + CHUNK, right=True)))
            yield self.part(first, last)
            first = last


def segments(policy: HierarchicalPolicy, batch: Batch) -> Segments:
    """Group a batch by commitment; the end of an episode or of the batch cuts a segment short."""

    def rows(x: Tensor) -> Tensor:  # (T, N, ...) -> (N T, ...), environment-major
        return x.transpose(0, 1).flatten(0, 1)

    obs, time_left = rows(batch.steps.obs[:-1]), rows(batch.time_left[:-1])
    decision = rows(batch.is_decision[:-1]).nonzero().squeeze(-1)
    total = torch.tensor([len(obs)])
    starts = torch.zeros_like(batch.steps.done)  # an episode starts at the top of a column and after every end
    starts[0] = True
    starts[1:] = batch.steps.done[:-1]
    trajectory = rows(starts).long().cumsum(0) - 1
    return Segments(
        policy.manager_input(obs[decision], time_left[decision]),
        rows(batch.skill[:-1])[decision],
        trajectory[decision],
        torch.diff(torch.cat([decision, total])),
        policy.skill_input(obs, time_left),
        rows(batch.steps.action),
        decision,
    )


def exact_log_prob(policy: HierarchicalPolicy, batch: Batch | Segments) -> Tensor:
    """(K,) log-probability of each segment's actions with the skill marginalised (Eq. 3), differentiable."""
    seg = batch if isinstance(batch, Segments) else segments(policy, batch)
    per_step = policy.skills.log_prob_all(seg.skill_input, seg.action)  # (R, Z)
    log_prob = policy.manager.log_probs(seg.manager_input).index_add(0, seg.row_segment, per_step)
    return log_prob.logsumexp(-1)


def approximate_log_prob(policy: HierarchicalPolicy, batch: Batch | Segments) -> Tensor:
    """(K,) log-probability of each segment's actions and its skill, treated as observed (Lemma 1), differentiable."""
    seg = batch if isinstance(batch, Segments) else segments(policy, batch)
    rows = seg.row_segment
    per_step = policy.skills.log_prob_all(seg.skill_input, seg.action)
    own = per_step.gather(1, seg.skill[rows].unsqueeze(1)).squeeze(1)
    choice = policy.manager.log_probs(seg.manager_input).gather(1, seg.skill.unsqueeze(1)).squeeze(1)
    return choice.index_add(0, rows, own)


LOG_PROBS = {"exact": exact_log_prob, "approximate": approximate_log_prob}


def flat_gradient(policy: nn.Module) -> Tensor:
    """All gradients as one float64 vector; a parameter without a gradient counts as zero."""
    return torch.cat(
        [(torch.zeros_like(p) if p.grad is None else p.grad).flatten().double() for p in policy.parameters()]
    )


def segment_gradient(policy: HierarchicalPolicy, kind: str, seg: Segments, weight: Tensor) -> Tensor:
    """Gradient of sum_k weight_k L_k over all parameters, manager and skills; `kind` is a key of LOG_PROBS."""
    policy.zero_grad(set_to_none=True)
    first = 0
    for piece in seg.parts():
        last = first + len(piece.length)
        (LOG_PROBS[kind](policy, piece) * weight[first:last]).sum().backward()
        first = last
    return flat_gradient(policy)


def cosine(a: Tensor, b: Tensor) -> float:
    """Cosine similarity of two vectors."""
    return float(a @ b / (a.norm() * b.norm()))


def cosine_similarities(
    policy: HierarchicalPolicy, batch: Batch, manager_advantage: Tensor, skill_advantage: Tensor
) -> dict[str, float]:
    """Cosine between the exact and the approximate policy gradient, in the definitions the paper leaves open.

    Args:
        manager_advantage, skill_advantage: (T, N).

    Returns:
        `cosine_batch`: whole batch, both gradients weighted by A_k, the manager's advantage at the decision.
        `cosine_trajectory_mean`, `_std`: the same per trajectory.
        `cosine_unweighted_mean`, `_std`: grad log P(tau) per trajectory, no weight.
        `cosine_authors`: whole batch as in the authors' code, whose approximate gradient weighs every step of a skill
        by that step's own advantage instead of A_k.
    """
    seg = segments(policy, batch)
    weight = manager_advantage.transpose(0, 1).flatten()[seg.position].to(seg.action.dtype)
    one = torch.ones_like(weight)
    bounds = seg.trajectory_bounds()
    total = {kind: torch.zeros(1, dtype=torch.float64) for kind in LOG_PROBS}
    weighted, unweighted = [], []
    for first, last in bounds:
        piece = seg.part(first, last)
        gradient = {kind: segment_gradient(policy, kind, piece, weight[first:last]) for kind in LOG_PROBS}
        total = {kind: total[kind] + gradient[kind] for kind in LOG_PROBS}
        weighted.append(cosine(gradient["exact"], gradient["approximate"]))
        plain = [segment_gradient(policy, kind, piece, one[first:last]) for kind in LOG_PROBS]
        unweighted.append(cosine(*plain))

    policy.zero_grad(set_to_none=True)
    for level in levels(policy, batch, manager_advantage, skill_advantage):
        for c in chunks(len(level.advantage)):
            (level.log_prob(c) * level.advantage[c]).sum().backward()
    authors = flat_gradient(policy)
    policy.zero_grad(set_to_none=True)
    weighted_values, unweighted_values = torch.tensor(weighted), torch.tensor(unweighted)
    return {
        "cosine_batch": cosine(total["exact"], total["approximate"]),
        "cosine_trajectory_mean": float(weighted_values.mean()),
        "cosine_trajectory_std": float(weighted_values.std(correction=0)),
        "cosine_unweighted_mean": float(unweighted_values.mean()),
        "cosine_unweighted_std": float(unweighted_values.std(correction=0)),
        "cosine_authors": cosine(total["exact"], authors),
        "trajectories": float(len(bounds)),
    }


def action_probabilities(log_prob: Tensor, per_dimension: Tensor, log_std: Tensor) -> dict[str, Tensor]:
    """pi(a|s, z) of a continuous action under every skill, in each definition that could stand behind Table 2.

    A density has no upper bound of one, and the paper does not say what it calls a probability.

    Args:
        log_prob: (R, Z) joint log-density. per_dimension: (R, Z, A) log-density per action dimension.
        log_std: (Z, A).

    Returns:
        Name -> (R, Z): `density`; `density_over_peak`, divided by its value at the mean; `density_per_dimension`, the
        mean over dimensions of the one-dimensional density; `peak_geometric`, the geometric mean over dimensions of
        the one-dimensional density over its peak; `posterior`, the share of each skill under a uniform manager.
    """
    peak = -log_std - 0.5 * math.log(2 * math.pi)  # (Z, A) log-density at the mean
    return {
        "density": log_prob.exp(),
        "density_over_peak": (log_prob - peak.sum(-1)).exp(),
        "density_per_dimension": per_dimension.exp().mean(-1),
        "peak_geometric": (per_dimension - peak).mean(-1).exp(),
        "posterior": log_prob.softmax(-1),
    }


@torch.no_grad()
def skill_separation(policy: HierarchicalPolicy, batch: Batch) -> dict[str, float]:
    """Own and largest other probability of the actions taken (Table 2, middle and right column).

    Returns:
        Per definition d of `action_probabilities`: `own_d_mean`, `own_d_std` of pi(a|s, z) and `other_d_mean`,
        `other_d_std` of max over z' != z of pi(a|s, z'), which is the epsilon of Lemma 1; over all steps of the batch.
    """
    seg = segments(policy, batch)
    skill = seg.skill[seg.row_segment]
    values: dict[str, list[Tensor]] = {}
    for c in chunks(len(skill)):
        mean = policy.skills.means(seg.skill_input[c])  # (R, Z, A)
        log_std, action = policy.skills.log_std(), seg.action[c].unsqueeze(1)
        per_dimension = gaussian_log_prob(mean.unsqueeze(-1), log_std.unsqueeze(-1), action.unsqueeze(-1))
        own_skill = skill[c].unsqueeze(1)
        for name, p in action_probabilities(per_dimension.sum(-1), per_dimension, log_std).items():
            own = p.gather(1, own_skill).squeeze(1)
            other = p.scatter(1, own_skill, -1.0).amax(1) if policy.num_skills > 1 else torch.zeros_like(own)
            values.setdefault(f"own_{name}", []).append(own)
            values.setdefault(f"other_{name}", []).append(other)
    result: dict[str, float] = {}
    for name, parts in values.items():
        x = torch.cat(parts).double()
        result |= {f"{name}_mean": float(x.mean()), f"{name}_std": float(x.std(correction=0))}
    return result


def gradient_variance(policy: HierarchicalPolicy, batch: Batch, skill_advantage: Tensor) -> float:
    """Total variance (trace of the covariance) of the skills' policy gradient over trajectories.

    One trajectory's estimate is sum_t grad log pi_l(a_t|s_t, z) A_t. Advantages must not be standardised, or what a
    baseline does to their scale is lost.

    Args:
        skill_advantage: (T, N), from the baseline under study.
    """
    seg = segments(policy, batch)
    advantage = skill_advantage.transpose(0, 1).flatten().to(seg.action.dtype)
    gradients, row = [], 0
    for first, last in seg.trajectory_bounds():
        policy.skills.zero_grad(set_to_none=True)
        for piece in seg.part(first, last).parts():
            log_prob = policy.skills.log_prob_all(piece.skill_input, piece.action)
            own = log_prob.gather(1, piece.skill[piece.row_segment].unsqueeze(1)).squeeze(1)
            (own * advantage[row : row + len(own)]).sum().backward()
            row += len(own)
        gradients.append(flat_gradient(policy.skills))
    policy.skills.zero_grad(set_to_none=True)
    return float(torch.stack(gradients).var(0).sum())


def restored_baselines(config: HierarchyConfig, envs: Any, checkpoint: Checkpoint) -> tuple[Baselines, int]:
    """Baselines as a trained run left them, and the iteration that would come next."""
    generator = seeding.torch_generator(0, "overwritten by the checkpoint")
    baselines = Baselines(config, envs.single_observation_space.shape[0], generator)
    return baselines, checkpoint.restore(baselines=baselines)


def baseline_variances(
    policy: HierarchicalPolicy, baselines: Baselines, fitting: Batch, batch: Batch, config: HierarchyConfig
) -> dict[str, float]:
    """`gradient_variance` with no, the single and the skill-conditioned baseline (section 4.2).

    Both baselines are refitted to one batch of the policy and used on another, as in training, but with up to 200
    evaluations, so that what differs is what they see rather than how far the fit got.

    Returns:
        `variance_none`, `variance_single`, `variance_skill`.
    """
    baselines.evaluations = 200
    returns = step_returns(fitting, config)
    baselines.fit(fitting, {"single": returns, "skill": returns})
    result = {}
    for kind in ("none", "single", "skill"):
        value = baselines.predict(kind, batch.steps.obs, batch.time_left, batch.skill)[:-1]
        result[f"variance_{kind}"] = gradient_variance(policy, batch, step_returns(batch, config) - value)
    return result


def step_returns(batch: Batch, config: HierarchyConfig) -> Tensor:
    """(T, N) discounted return from every step to the end of its episode or of the batch."""
    steps, zero = batch.steps, torch.zeros_like(batch.steps.reward)
    return gae(steps.reward, zero, zero, steps.terminated, steps.done, config.gamma, 1.0)


def measure(
    config: HierarchyConfig, make_envs: Callable[[int, str], Any], seed: int, checkpoint: Checkpoint
) -> dict[str, float]:
    """Table 2's quantities on the batch of the next iteration, under the policy that collects it, before its update.

    Args: as `hippo.hippo.train`; the checkpoint is that of a run of ten iterations for the paper's iteration 10.

    Returns:
        `iteration`, the batch's number, and `env_steps` up to and with it; then the quantities of
        `cosine_similarities`, `skill_separation` and `baseline_variances`.
    """
    envs = make_envs(config.num_envs, "training")
    policy = restored(config, envs, checkpoint)
    baselines, iteration = restored_baselines(config, envs, checkpoint)
    batch = collect(policy, envs, config, seed, iteration)
    batch.steps.scale_rewards(baselines.reward_scale, config.gamma, frozen=True)
    estimate = advantages(batch, baselines, config)
    another = collect(policy, envs, config, seed, iteration + 1)
    envs.close()
    return {
        "iteration": iteration,
        "env_steps": (iteration + 1) * batch.steps.num_steps,
        **cosine_similarities(policy, batch, estimate.manager, estimate.skills),
        **skill_separation(policy, batch),
        **baseline_variances(policy, baselines, another, batch, config),
    }
