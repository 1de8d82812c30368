"""Option-Critic for continuous control (Bacon et al. 2017; PPOC, Klissarov et al. 2017): a competitor in Fig. 5 and 6.

Options are learnt end to end by four losses: intra-option PPO, a regression of Q(s, o), and the gradients of the
terminations and of the policy over options. By default the latter two are the option-critic's; `ppoc_faithful` has the
losses of PPOC's published code instead. docs/algorithms/option_critic.md derives them and lists all differences.
"""

import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from hippo.core import seeding
from hippo.core.checkpoint import Checkpoint
from hippo.core.gae import gae
from hippo.core.log import RunLog, check_finite
from hippo.core.minibatch import maximize_in_minibatches, minibatches
from hippo.core.networks import normalize_columns
from hippo.core.normalize import standardize
from hippo.core.optimizers import Adam
from hippo.core.options import Acting, Execution, OptionPolicy, Options
from hippo.core.policies import POLICY_HEAD, gaussian_entropy
from hippo.core.ppo import Level, Rows, clipped_surrogate, in_chunks, surrogate_statistics
from hippo.core.rollout import Steps
from hippo.core.settings import MOST_SKILLS, MOST_STEPS, WIDEST, ConfigError, check, setting
from hippo.core.skills import start_from
from hippo.core.value import explained_variance
from hippo.core.view import Ego, check_view

__all__ = ["Acting", "OptionCriticConfig", "restored", "train"]

REVISION = 1  # bumped by every change that alters the metrics of tests/golden

PPOC_TERMINATION_STEP = 5e-7  # pposgd_simple.py:412
MakeEnvs = Callable[[int, str], Any]  # (num_envs, purpose) -> a vector environment that knows its robot_size


@dataclass
class OptionCriticConfig:
    """Every setting; the defaults are those that PPOC was published with, as the paper names none but the options.

    `code` names github.com/mklissa/PPOC.
    """

    iterations: int = setting(dataclasses.MISSING, "training iterations", code="488 of 2048 steps", low=1)
    batch_size: int = setting(
        dataclasses.MISSING,
        "environment steps per iteration",
        paper="Block 50 000, Gather 100 000 (App. A)",
        low=1,
        high=MOST_STEPS,
    )
    horizon: int = setting(
        dataclasses.MISSING, "episode length H in steps", paper="Block 1000, Ant 5000, Snake 8000 (App. A)", low=1
    )
    num_skills: int = setting(6, "number of options", paper="6 skills (App. A)", code="2", low=1, high=MOST_SKILLS)
    ppoc_faithful: bool = setting(
        False,
        "the losses and the one Adam of PPOC's code instead of the option-critic's gradients",
        code="yes (pposgd_simple.py:209-226)",
        ours="no: its termination and policy over options follow no gradient of the return",
    )
    deliberation_cost: float = setting(
        0.0, "cost of a termination, in units of the scaled reward", code="0; 0.1 in the README's example", low=0.0
    )
    termination_bias: float = setting(
        0.0, "initial bias of the terminations' logits; -2.197 makes options last 10 steps", code="0: 2 steps"
    )
    manager_entropy_weight: float = setting(
        0.1, "weight of the entropy of the policy over options", code="0.1 (pposgd_simple.py:224)", low=0.0
    )
    reward_scale: float = setting(
        0.1, "factor on the rewards that are learnt from; not used with one option", code="0.1", above=0.0
    )
    observation_filter: bool = setting(
        True,
        "standardise observations by their running mean and deviation; never with given skills, which it would change",
        code="yes (mlp_policy.py)",
    )
    steps_per_update: int = setting(
        2048,
        "environment steps, of all environments together, between updates; 0: the whole iteration",
        code="2048 (run_mujoco.py)",
        low=0,
    )
    updates: int = setting(10, "passes over the data of an update", code="10 (run_mujoco.py)", low=1)
    minibatch_size: int = setting(
        32, "rows per gradient step; 0: all", code="32 with two options, 64 with one (run_mujoco.py)", low=0
    )
    critic_minibatch_size: int = setting(32, "rows per gradient step of the critic; 0: all", code="32", low=0)
    learning_rate: float = setting(3e-4, "Adam step size of the intra-option policies", code="3e-4", above=0.0)
    critic_learning_rate: float = setting(3e-4, "Adam step size of the critic", code="3e-4", above=0.0)
    manager_learning_rate: float = setting(
        3e-4, "Adam step size of the policy over options", code="3e-4, on a loss 32 times as large", above=0.0
    )
    termination_learning_rate: float = setting(
        2e-4,
        "Adam step size of the terminations",
        code="5e-7 through the Adam of all losses, which in effect makes steps of 2e-4 (pposgd_simple.py:411)",
        above=0.0,
    )
    adam_epsilon: float = setting(1e-5, "Adam's epsilon", code="1e-5", above=0.0)
    clip_range: float = setting(0.2, "clipping parameter epsilon", code="0.2 (run_mujoco.py)", above=0.0)
    gamma: float = setting(0.99, "discount per environment step", code="0.99 (run_mujoco.py)", above=0.0, high=1.0)
    gae_lambda: float = setting(0.95, "GAE lambda", code="0.95 (run_mujoco.py)", low=0.0, high=1.0)
    skill_hidden_sizes: list[int] = setting(
        [64, 64],
        "hidden layers of the intra-option policies",
        paper="2 x 64 (App. A)",
        code="2 x 64",
        low=1,
        high=WIDEST,
    )
    skill_integration: str = setting(
        "bilinear",
        "how the option enters their network",
        code="one linear head per option",
        ours="HiPPO's, so that given skills can be loaded",
        choices=("bilinear", "concatenate"),
    )
    skill_observation: str = setting(
        "robot",
        "what the intra-option policies see: the robot's own observation, the same free of place and heading (ego), "
        "or everything",
        code="everything",
        ours="robot: as HiPPO's skills",
        choices=("robot", "ego", "full"),
    )
    initialisation: str = setting(
        "glorot",
        "initial weights: Glorot-uniform, or normc (norm one per output, 0.01 in the last layer of a policy)",
        code="normc",
        ours="glorot: as all methods",
        choices=("glorot", "normc"),
    )
    log_std_per_skill: bool = setting(
        False,
        "one log-std vector per option instead of a shared one",
        code="per option",
        ours="shared: as in the skills that all methods are given",
    )
    skills: str = setting(
        "",
        "skills file that the intra-option policies start from; empty: from scratch",
        paper="from scratch; given skills in Fig. 6",
    )
    manager_hidden_sizes: list[int] = setting(
        [32, 32], "hidden layers of the policy over options", paper="2 x 32 (manager, App. A)", low=1, high=WIDEST
    )
    termination_hidden_sizes: list[int] = setting(
        [32, 32],
        "hidden layers of the terminations",
        code="a head on the critic's 2 x 64",
        ours="a manager's",
        low=1,
        high=WIDEST,
    )
    critic_hidden_sizes: list[int] = setting([64, 64], "hidden layers of the critic", code="2 x 64", low=1, high=WIDEST)

    def __post_init__(self) -> None:
        check(self)
        if self.batch_size < self.horizon:
            raise ConfigError("batch_size", self.batch_size, f"must be at least one horizon, {self.horizon} steps")
        if self.skill_observation == "ego" and self.observation_filter and not self.skills:
            valid = "turns observations as they are: needs observation_filter=false"
            raise ConfigError("skill_observation", "ego", valid)

    def check_environment(self, robot: str, options: dict[str, Any], layout: Any = None) -> None:
        """Refuse a view that an environment of gym:<id>, with a `layout`, has not."""
        check_view(self.skill_observation, layout)

    @property
    def num_envs(self) -> int:
        """Slots that collect one horizon each; ceil(batch / horizon)."""
        return -(-self.batch_size // self.horizon)

    @property
    def scale(self) -> float:
        """Factor on the rewards; with one option this is PPO, unscaled."""
        return self.reward_scale if self.num_skills > 1 else 1.0

    @property
    def switching_cost(self) -> float:
        """Deliberation cost; with one option nothing is deliberated."""
        return self.deliberation_cost if self.num_skills > 1 else 0.0

    @property
    def steps_between_updates(self) -> int:
        """Steps per environment between updates."""
        return min(-(-self.steps_per_update // self.num_envs), self.horizon) or self.horizon


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


def of_option(x: Tensor, option: Tensor) -> Tensor:
    """The entries of `option` (...): (..., K) -> (...)."""
    return x.gather(-1, option.unsqueeze(-1)).squeeze(-1)


def arrival_value(q: Tensor, value: Tensor, beta: Tensor, cost: float) -> Tensor:
    """U(s', o) = (1 - beta) Q(s', o) + beta (V_Omega(s') - cost): what arriving in s' under o is worth."""
    return (1 - beta) * q + beta * (value - cost)


def termination_loss(beta: Tensor, advantage: Tensor) -> Tensor:
    """Mean of beta(s', o) A with A = Q(s', o) - V_Omega(s') + cost held constant, over the states arrived at.

    Minus its gradient is that of the return (Bacon et al., theorem 2), up to the discounting of the states.
    """
    return (beta * advantage.detach()).mean()


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
    first = checkpoint.restore(**parts)
    log.resume(first)

    for iteration in range(first, config.iterations):
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
            "iteration": iteration,
            "env_steps": (iteration + 1) * steps.num_steps,
            **steps.statistics(),
            **{name: sum(u[name] for u in updates) / len(updates) for name in updates[0]},
            **option_statistics(run.options, config.num_skills),
        }
        log.row(metrics, steps.timing(start, finished - update_seconds, finished))
        checkpoint.record(iteration, **parts)
    envs.close()
