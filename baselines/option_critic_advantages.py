"""What an update of Option-Critic learns from: values, arrivals and advantages of a portion of the steps."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from baselines.option_critic_config import OptionCriticConfig
from hippo.core.gae import gae
from hippo.core.normalize import standardize
from hippo.core.options import OptionPolicy, Options
from hippo.core.policies import gaussian_entropy
from hippo.core.ppo import in_chunks
from hippo.core.rollout import Steps
from hippo.core.value import explained_variance


def of_option(x: Tensor, option: Tensor) -> Tensor:
    """The entries of `option` (...): (..., K) -> (...)."""
    return x.gather(-1, option.unsqueeze(-1)).squeeze(-1)


def arrival_value(q: Tensor, value: Tensor, beta: Tensor, cost: float) -> Tensor:
    """U(s', o) = (1 - beta) Q(s', o) + beta (V_Omega(s') - cost): what arriving in s' under o is worth."""
    return (1 - beta) * q + beta * (value - cost)


@dataclass
class Portion:
    """What one update learns from: rows are (step, environment) pairs, B of them, sorted by option."""

    seen: Tensor  # (B, D) filtered observations
    action: Tensor  # (B, A)
    option: Tensor  # (B,) ascending
    advantage: Tensor  # (B,) standardised, of the action
    returns: Tensor  # (B,) target of Q(s, o)
    choice_advantage: Tensor  # (B,) of the choice of the option; standardised over all rows
    is_decision: Tensor  # (B,) bool
    arrived: Tensor  # (E, D) filtered observations of the E states arrived at under a running option
    arrived_option: Tensor  # (E,) that option
    stop_advantage: Tensor  # (E,) Q - V_Omega + cost there
    statistics: dict[str, float]


@torch.no_grad()
def portion(
    config: OptionCriticConfig, policy: OptionPolicy, steps: Steps, options: Options, first: int, last: int
) -> Portion:
    """Values and advantages of the steps first .. last - 1."""
    obs, done = steps.obs[first : last + 1], steps.done[first:last]
    option, decision = options.option[first : last + 1], options.is_decision[first : last + 1]
    shape, cost = obs.shape[:2], config.switching_cost
    seen = policy.filter(obs).flatten(0, 1)

    def everywhere(net: Callable[[Tensor], Tensor]) -> Tensor:
        return in_chunks(lambda c: net(seen[c]), len(seen)).double().view(*shape, -1)

    q, log_pi, beta = everywhere(policy.critic), everywhere(policy.manager.log_probs), everywhere(policy.beta)
    value = (log_pi.exp() * q).sum(-1)
    q_now = of_option(q[:-1], option[:-1])
    # The state that follows a step, with the option of that step: where the termination decides.
    q_after, beta_after = of_option(q[1:], option[:-1]), of_option(beta[1:], option[:-1])
    reward = config.scale * steps.reward[first:last]
    if config.ppoc_faithful:
        stopped = decision[1:] & ~options.begins[first + 1 : last + 1]
        reward = reward - cost * stopped
        next_value = of_option(q[1:], option[1:])
    else:
        next_value = arrival_value(q_after, value[1:], beta_after, cost)
    advantage = gae(reward, q_now, next_value, done, done, config.gamma, config.gae_lambda)
    returns = advantage + q_now

    order = option[:-1].flatten().argsort(stable=True)

    def rows(x: Tensor) -> Tensor:
        return x.flatten(0, 1)[order]

    going_on = ~done
    share = torch.bincount(option[:-1].flatten(), minlength=policy.num_options) / order.numel()
    log_std, stop = policy.skills.log_std(), beta_after[going_on]
    stop = stop if len(stop) else torch.zeros(1)  # every episode ended with its one step here
    statistics = {
        "explained_variance": explained_variance(q_now, returns),
        "manager_entropy": float(-(log_pi[:-1].exp() * log_pi[:-1]).sum(-1).mean()),
        "skill_entropy": float(share @ gaussian_entropy(log_std)),
        "action_std": float(log_std.exp().mean()),
        "termination_probability": float(stop.mean()),
        "termination_below_tenth": float((stop < 0.1).double().mean()),
        "termination_above_nine_tenths": float((stop > 0.9).double().mean()),
    }
    return Portion(
        rows(seen.view(*shape, -1)[:-1]),
        rows(steps.action[first:last]),
        rows(option[:-1]),
        standardize(rows(advantage)).to(obs.dtype),
        rows(returns).to(obs.dtype),
        standardize(rows(returns - value[:-1])).to(obs.dtype),
        rows(decision[:-1]),
        seen.view(*shape, -1)[1:][going_on],
        option[:-1][going_on],
        (q_after - value[1:] + cost)[going_on].to(obs.dtype),
        statistics,
    )
