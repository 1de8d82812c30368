"""What both levels of a hierarchy are trained on, and how they behaved in a batch."""

from collections.abc import Sequence

import torch
from torch import Tensor

from hippo.core.direct import Categorical, Gaussian, network_of
from hippo.core.hierarchy import Batch, HierarchicalPolicy
from hippo.core.policies import gaussian_entropy
from hippo.core.ppo import Level, Rows


def rows_by_skill(batch: Batch) -> Tensor:
    """Which of the flattened (T N) steps are learnt from, sorted by skill as the skill network wants."""
    used = batch.used.flatten().nonzero().squeeze(-1)
    return used[batch.skill[:-1].flatten()[used].argsort(stable=True)]


def levels(
    policy: HierarchicalPolicy,
    batch: Batch,
    manager_advantage: Tensor,
    skill_advantage: Tensor,
    trained: Sequence[str] = ("manager", "skill"),
) -> list[Level]:
    """Log-probabilities and advantages of both levels: the manager at its decisions, the skills at every step.

    Rows of the skills are sorted by skill; `at` says which of them hold a decision, and which.

    Args:
        manager_advantage, skill_advantage: (T, N). trained: the levels to return.
    """
    result = []
    obs, skill, time_left = (x[:-1].flatten(0, 1) for x in (batch.steps.obs, batch.skill, batch.time_left))
    rows = rows_by_skill(batch)
    if "manager" in trained:
        where = (batch.is_decision[:-1] & batch.used).flatten()
        manager_input, choice = policy.manager_input(obs[where], time_left[where]), skill[where].unsqueeze(-1)
        decision = torch.where(where, where.cumsum(0) - 1, -1)[rows]

        def manager_log_prob(c: Rows) -> Tensor:
            return policy.manager.log_probs(manager_input[c]).gather(-1, choice[c]).squeeze(-1)

        def manager_direct() -> Categorical:
            return Categorical(network_of(policy.manager.logits.layers), manager_input, choice.squeeze(-1))

        advantage = manager_advantage.flatten()[where].to(obs.dtype)
        result.append(Level("manager", manager_log_prob, advantage, manager_direct, decision))
    if "skill" in trained:
        skill_input, active = policy.skill_input(obs[rows], time_left[rows]), skill[rows]
        action = batch.steps.action.flatten(0, 1)[rows]

        def skill_log_prob(c: Rows) -> Tensor:
            return policy.skills.log_prob(skill_input[c], active[c], action[c])

        def skill_direct() -> Gaussian:
            network = network_of([policy.skills.first, *policy.skills.rest.layers])
            return Gaussian(network, policy.skills.log_std_parameter, skill_input, active, action)

        advantage = skill_advantage.flatten()[rows].to(obs.dtype)
        result.append(Level("skill", skill_log_prob, advantage, skill_direct))
    return result


@torch.no_grad()
def policy_statistics(policy: HierarchicalPolicy, batch: Batch) -> dict[str, float]:
    """How the hierarchy behaved in a batch: entropies, commitment length, action noise, use of every skill."""
    skill, is_decision = batch.skill[:-1], batch.is_decision[:-1]
    usage = torch.bincount(skill.flatten(), minlength=policy.num_skills) / skill.numel()
    decided = policy.manager_input(batch.steps.obs[:-1][is_decision], batch.time_left[:-1][is_decision])
    log_probs = policy.manager.log_probs(decided)
    log_std = policy.skills.log_std()
    return {
        "manager_entropy": float(-(log_probs.exp() * log_probs).sum(-1).mean()),
        "skill_entropy": float(usage @ gaussian_entropy(log_std)),
        "action_std": float(log_std.exp().mean()),
        "commitment_mean": float(skill.numel() / is_decision.sum()),
        **{f"skill_{z}_usage": float(share) for z, share in enumerate(usage)},
    }
