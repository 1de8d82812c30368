"""The losses of PPOC's published code (Klissarov et al. 2017), Option-Critic's with `ppoc_faithful`."""

import torch
from torch import Tensor

from baselines.option_critic_advantages import Portion
from baselines.option_critic_config import OptionCriticConfig
from hippo.core.minibatch import minibatches
from hippo.core.options import OptionPolicy
from hippo.core.ppo import clipped_surrogate

PPOC_TERMINATION_STEP = 5e-7  # pposgd_simple.py:412


def improve_as_ppoc(
    config: OptionCriticConfig,
    policy: OptionPolicy,
    optimizer: torch.optim.Optimizer,
    data: Portion,
    generator: torch.Generator,
) -> None:
    """The losses of PPOC's code: option by option, two alternating steps of one Adam that holds all parameters.

    The termination is charged where its option acts rather than where it arrives, and the policy over options is
    pushed at every step by the advantages of actions, with the log-probability of the minibatch's first state only.
    """
    parameters = [p for group in optimizer.param_groups for p in group["params"]]

    def step(loss: Tensor, learning_rate: float) -> None:
        gradients = torch.autograd.grad(loss, parameters, allow_unused=True, materialize_grads=True)
        for parameter, gradient in zip(parameters, gradients, strict=True):
            parameter.grad = gradient  # zeros where the loss does not reach: the moments decay there, too
        optimizer.param_groups[0]["lr"] = learning_rate
        optimizer.step()

    with torch.no_grad():
        old = policy.skills.log_prob(policy.skills.see(data.seen), data.option, data.action)
    for option in range(policy.num_options):
        rows = (data.option == option).nonzero().squeeze(-1)
        size = config.minibatch_size
        parts = len(rows) // size if size else 1
        for part in minibatches(len(rows), parts, config.updates, generator) if len(rows) else ():
            i = rows[part]
            seen, advantage = data.seen[i], data.advantage[i]
            with torch.no_grad():
                q = policy.critic(seen)
                value = (policy.manager.log_probs(seen).exp() * q).sum(-1)
            step(
                (policy.beta(seen)[:, option] * (q[:, option] - value + config.switching_cost)).sum(),
                PPOC_TERMINATION_STEP,
            )
            log_prob = policy.skills.log_prob(policy.skills.see(seen), data.option[i], data.action[i])
            policy_loss = -clipped_surrogate(log_prob, old[i], advantage, config.clip_range).mean()
            critic_loss = (policy.critic(seen)[:, option] - data.returns[i]).square().mean()
            log_pi = policy.manager.log_probs(seen)
            entropy = -(log_pi.exp() * log_pi).sum(-1)
            first = torch.randint(len(i), (), generator=generator)  # the first of the shuffled rows
            choice_loss = -(log_pi[first, option] * advantage + config.manager_entropy_weight * entropy).sum()
            step(policy_loss + critic_loss + choice_loss, config.learning_rate)
