"""Option-Critic for continuous control (Bacon et al. 2017; PPOC, Klissarov et al. 2017): a competitor in Fig. 5 and 6.

Options are learnt end to end by four losses: intra-option PPO, a regression of Q(s, o), and the gradients of the
terminations and of the policy over options. By default the latter two are the option-critic's; `ppoc_faithful` has the
losses of PPOC's published code instead. docs/algorithms/option_critic.md derives them and lists all differences.
Algorithm 1 of Bacon et al., line by line:

    choose o by the policy over options            hippo/core/options.py                  Acting.decide
    choose a by pi(a|s, o), take it                hippo/core/options.py                  Acting.action, Execution.run
    1. options evaluation: the target of Q         option_critic_advantages.py            arrival_value, portion
       and a step of Q towards it                  here                                   improve, critic_loss
    2. options improvement: pi(a|s, o)             here, clipped as PPO's                 improve, level
       beta(s', o)                                 here                                   termination_loss, stop_loss
       policy over options (greedy there)          here, by its gradient                  improve, choice_loss
    if beta terminates in s', choose a new o       hippo/core/options.py                  Acting.decide
    the losses as PPOC has them                    ppoc.py                                improve_as_ppoc
"""

import time
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from baselines.option_critic_advantages import Portion, of_option, portion
from baselines.option_critic_config import OptionCriticConfig
from baselines.ppoc import improve_as_ppoc
from hippo.core import seeding
from hippo.core.checkpoint import Checkpoint
from hippo.core.log import RunLog, check_finite
from hippo.core.minibatch import maximize_in_minibatches, minibatches
from hippo.core.networks import normalize_columns
from hippo.core.optimizers import Adam
from hippo.core.options import Acting, Execution, OptionPolicy, Options
from hippo.core.policies import POLICY_HEAD
from hippo.core.ppo import Level, Rows, clipped_surrogate, in_chunks, surrogate_statistics
from hippo.core.skills import start_from
from hippo.core.training import MakeEnvs, Training
from hippo.core.view import Ego

__all__ = ["Acting", "OptionCriticConfig", "restored", "train"]

REVISION = 1  # bumped by every change that alters the metrics of tests/golden


def make_policy(config: OptionCriticConfig, envs: Any, generator: torch.Generator) -> OptionPolicy:
    """Freshly drawn networks for these environments."""
    obs_size = envs.single_observation_space.shape[0]
    ego = Ego(envs.observation_names[: envs.robot_size]) if config.skill_observation == "ego" else None
    policy = OptionPolicy(
        obs_size,
        {"robot": envs.robot_size, "full": obs_size}[config.skill_observation] if ego is None else ego.size,
        envs.single_action_space.shape[0],
        config.num_skills,
        config.skill_hidden_sizes,
        config.manager_hidden_sizes,
        config.termination_hidden_sizes,
        config.critic_hidden_sizes,
        generator,
        config.skill_integration,
        config.log_std_per_skill,
        config.termination_bias,
    )
    policy.skills.ego = ego
    if config.initialisation == "normc":
        normalize_columns([policy.skills.first, *policy.skills.rest.layers], POLICY_HEAD, generator)
        normalize_columns(policy.manager.logits.layers, POLICY_HEAD, generator)
        normalize_columns(policy.critic.layers, 1.0, generator)
    return policy


def restored(config: OptionCriticConfig, envs: Any, checkpoint: Checkpoint) -> OptionPolicy:
    """The policy of a checkpoint."""
    policy = make_policy(config, envs, seeding.torch_generator(0, "overwritten by the checkpoint"))
    checkpoint.restore(policy=policy)
    return policy


def termination_loss(beta: Tensor, advantage: Tensor) -> Tensor:
    """Mean of beta(s', o) A with A = Q(s', o) - V_Omega(s') + cost held constant, over the states arrived at.

    Minus its gradient is that of the return (Bacon et al., theorem 2), up to the discounting of the states.
    """
    return (beta * advantage.detach()).mean()


def descend(
    loss: Callable[[Tensor], Tensor],
    rows: int,
    optimizer: torch.optim.Optimizer,
    epochs: int,
    size: int,
    generator: torch.Generator,
) -> None:
    """`epochs` passes over `rows` in minibatches of about `size` (0: all), one step down `loss(indices)` for each."""
    for indices in minibatches(rows, rows // size if size else 1, epochs, generator):
        optimizer.zero_grad(set_to_none=True)
        loss(indices).backward()
        optimizer.step()


def improve(
    config: OptionCriticConfig,
    policy: OptionPolicy,
    optimizers: dict[str, torch.optim.Optimizer],
    data: Portion,
    generator: torch.Generator,
) -> None:
    """Every network follows its own gradient with its own optimiser; one option leaves PPO and the critic."""
    rows, size = len(data.option), config.minibatch_size
    epochs, clip_range = config.updates, config.clip_range

    def log_prob(c: Rows) -> Tensor:
        return policy.skills.log_prob(policy.skills.see(data.seen[c]), data.option[c], data.action[c])

    level = Level("skill", log_prob, data.advantage)
    parts = rows // size if size else 1
    maximize_in_minibatches(level, optimizers["skill"], epochs, parts, clip_range, rows, generator)

    def critic_loss(i: Tensor) -> Tensor:
        return (of_option(policy.critic(data.seen[i]), data.option[i]) - data.returns[i]).square().mean()

    descend(critic_loss, rows, optimizers["critic"], epochs, config.critic_minibatch_size, generator)
    if config.num_skills == 1:
        return

    where = data.is_decision
    seen, choice, advantage = data.seen[where], data.option[where], data.choice_advantage[where]
    with torch.no_grad():
        old = of_option(policy.manager.log_probs(seen), choice)

    def choice_loss(i: Tensor) -> Tensor:
        log_pi = policy.manager.log_probs(seen[i])
        entropy = -(log_pi.exp() * log_pi).sum(-1)
        gain = clipped_surrogate(of_option(log_pi, choice[i]), old[i], advantage[i], clip_range)
        return -(gain + config.manager_entropy_weight * entropy).mean()

    def stop_loss(i: Tensor) -> Tensor:
        return termination_loss(of_option(policy.beta(data.arrived[i]), data.arrived_option[i]), data.stop_advantage[i])

    if len(choice):
        descend(choice_loss, len(choice), optimizers["manager"], epochs, size, generator)
    if len(data.stop_advantage):
        descend(stop_loss, len(data.stop_advantage), optimizers["termination"], epochs, size, generator)


@torch.no_grad()
def log_probs(policy: OptionPolicy, data: Portion) -> tuple[Tensor, Tensor]:
    """Log-probabilities of the actions taken (B,), and of the options chosen at decisions."""

    def of_action(c: slice) -> Tensor:
        return policy.skills.log_prob(policy.skills.see(data.seen[c]), data.option[c], data.action[c])

    seen, choice = data.seen[data.is_decision], data.option[data.is_decision]
    return in_chunks(of_action, len(data.option)), of_option(policy.manager.log_probs(seen), choice)


def update(
    config: OptionCriticConfig,
    policy: OptionPolicy,
    optimizers: dict[str, torch.optim.Optimizer],
    data: Portion,
    generator: torch.Generator,
) -> dict[str, float]:
    """Learn from `data`; returns its statistics before, and how far the update went."""
    old_action, old_choice = log_probs(policy, data)
    if config.ppoc_faithful:
        improve_as_ppoc(config, policy, optimizers["all"], data, generator)
    else:
        improve(config, policy, optimizers, data, generator)
    action, choice = log_probs(policy, data)
    kl, clipped = surrogate_statistics(action, old_action, config.clip_range)
    choice_kl, _ = surrogate_statistics(choice, old_choice, config.clip_range)
    surrogate = clipped_surrogate(action, old_action, data.advantage, config.clip_range)
    return {
        "surrogate": float(surrogate.mean()),
        "skill_approx_kl": float(kl / len(action)),
        "skill_clip_fraction": float(clipped / len(action)),
        "manager_approx_kl": float(choice_kl / max(len(choice), 1)),
        **data.statistics,
    }


def make_optimizers(config: OptionCriticConfig, policy: OptionPolicy) -> dict[str, torch.optim.Optimizer]:
    """One Adam per network, or the one of `ppoc_faithful` for all."""
    networks: dict[str, nn.Module] = {
        "skill": policy.skills,
        "critic": policy.critic,
        "manager": policy.manager,
        "termination": policy.termination,
    }
    rates = {
        "skill": config.learning_rate,
        "critic": config.critic_learning_rate,
        "manager": config.manager_learning_rate,
        "termination": config.termination_learning_rate,
    }
    if config.ppoc_faithful:
        networks, rates = {"all": policy}, {"all": config.learning_rate}
    return {
        name: Adam(network.parameters(), lr=rates[name], eps=config.adam_epsilon, fused=True)
        for name, network in networks.items()
    }


def option_statistics(options: Options, num_options: int) -> dict[str, float]:
    """How long options last and how evenly they are used: 1 or the episode's length, and 0, are collapse."""
    option, is_decision = options.option[:-1], options.is_decision[:-1]
    share = torch.bincount(option.flatten(), minlength=num_options) / option.numel()
    return {
        "commitment_mean": float(option.numel() / is_decision.sum()),
        "usage_entropy": float(torch.special.entr(share).sum()),
        **{f"skill_{o}_usage": float(x) for o, x in enumerate(share)},
    }


def train(config: OptionCriticConfig, make_envs: MakeEnvs, log: RunLog, seed: int, checkpoint: Checkpoint) -> None:
    """Train from the newest checkpoint, or from scratch, to `config.iterations`.

    Raises:
        Diverged: an observation, a reward or a parameter is no longer finite.
        SkillsError: the given skills cannot be read or do not fit.
    """
    envs = make_envs(config.num_envs, "training")
    policy = make_policy(config, envs, seeding.torch_generator(seed, "initialisation"))
    start_from(config.skills, policy.skills, envs)
    optimizers = make_optimizers(config, policy)
    parts = {"policy": policy, **{f"{name}_optimizer": optimizer for name, optimizer in optimizers.items()}}
    training = Training(log, checkpoint, parts)

    for iteration in range(training.begin(), config.iterations):
        start, update_seconds = time.perf_counter(), 0.0
        run = Execution(policy, config, envs, seed, iteration)
        steps, generator = run.steps, seeding.torch_generator(seed, "minibatches", iteration)
        updates: list[dict[str, float]] = []
        for begin in range(0, config.horizon, config.steps_between_updates):
            end = min(begin + config.steps_between_updates, config.horizon)
            run.run(begin, end)
            collected = time.perf_counter()
            check_finite(iteration, observations=steps.obs[begin : end + 1], rewards=steps.reward[begin:end])
            data = portion(config, policy, steps, run.options, begin, end)
            updates.append(update(config, policy, optimizers, data, generator))
            check_finite(iteration, parameters=nn.utils.parameters_to_vector(policy.parameters()))
            if config.observation_filter and not config.skills:
                policy.filter.update(steps.obs[begin:end])
            update_seconds += time.perf_counter() - collected
        finished = time.perf_counter()

        metrics = {
            **{name: sum(u[name] for u in updates) / len(updates) for name in updates[0]},
            **option_statistics(run.options, config.num_skills),
        }
        training.record(iteration, steps, (start, finished - update_seconds, finished), metrics)
    envs.close()
