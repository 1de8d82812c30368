"""Option-Critic: the fact sheet's golden numbers and invariants O1..O9, and each known bug of the published code."""

import copy
import dataclasses

import numpy as np
import pytest
import torch

from baselines import option_critic as oc
from baselines.option_critic_advantages import arrival_value
from hippo.core.acting import rollout
from hippo.core.checkpoint import Checkpoint, load
from hippo.core.gae import gae
from hippo.core.minibatch import minibatches
from hippo.core.normalize import standardize
from hippo.core.options import Options
from hippo.core.policies import GaussianPolicy
from hippo.core.ppo import Level, maximize
from hippo.core.settings import ConfigError
from hippo.core.skills import SkillsError
from tests.hippo.toy import TargetEnv, given_skills, progress, run

NETWORKS = ("skills", "critic", "manager", "termination")
ALWAYS, NEVER = 60.0, -60.0  # a termination bias with which options end at once, or not before their episode


def config_of(**settings):
    small = {"iterations": 1, "batch_size": 200, "horizon": 20, "num_skills": 3, "steps_per_update": 0}
    return oc.OptionCriticConfig(**(small | settings))


def experience(config, seed=0, death_rate=0.0, policy=None):
    """A fresh policy, and what it did for one horizon."""
    envs = TargetEnv(config.num_envs, seed, horizon=config.horizon, death_rate=death_rate)
    policy = policy or oc.make_policy(config, envs, torch.Generator().manual_seed(seed))
    execution = oc.Execution(policy, config, envs, seed, 0)
    execution.run(0, config.horizon)
    return policy, execution.steps, execution.options


def learn(config, policy, data, seed=0):
    oc.update(config, policy, oc.make_optimizers(config, policy), data, torch.Generator().manual_seed(seed))


def moved(policy, before):
    now = policy.state_dict()
    return {n for n in NETWORKS if any(not torch.equal(now[k], before[k]) for k in now if k.startswith(f"{n}."))}


# --- O6: values and the gradient of the termination -------------------------------------------------------------------


def fixed_point(beta, gamma=0.9):
    """Q of one state where option 0 earns 1 and option 1 nothing, under a uniform policy over options."""
    q, reward = torch.zeros(2, dtype=torch.float64), torch.tensor([1.0, 0.0], dtype=torch.float64)
    for _ in range(2000):
        q = reward + gamma * arrival_value(q, q.mean(), beta, 0.0)
    return q


@pytest.mark.parametrize(
    ("beta", "expected"),
    [((0.5, 0.5), (5.9091, 4.0909)), ((0, 0), (10, 0)), ((1, 1), (5.5, 4.5)), ((0, 1), (10, 8.1818))],
)
def test_o6_the_critics_fixed_points_are_those_worked_by_hand(beta, expected):
    q = fixed_point(torch.tensor(beta, dtype=torch.float64))
    torch.testing.assert_close(q, torch.tensor(expected, dtype=torch.float64), atol=1e-4, rtol=0)


def test_o6_the_termination_losss_gradient_is_the_finite_difference_of_the_value_with_its_sign():
    # From either option with probability 1/2 and beta = 1/2, the option in force is uniform at all times, so the states
    # arrived at weigh sum_t gamma^(t+1) / 2 = 4.5 per option.
    beta = torch.full((2,), 0.5, dtype=torch.float64)
    difference = []
    for option in range(2):
        step = torch.zeros(2, dtype=torch.float64)
        step[option] = 1e-5
        difference.append((fixed_point(beta + step).mean() - fixed_point(beta - step).mean()) / 2e-5)
    assert difference[0] == pytest.approx(-4.0909, abs=1e-4)
    assert difference[1] == pytest.approx(4.0909, abs=1e-4)
    q = fixed_point(beta)
    variable = beta.clone().requires_grad_()
    # The loss is a mean over the two arrivals.
    (2 * 4.5 * oc.termination_loss(variable, q - q.mean())).backward()
    torch.testing.assert_close(-variable.grad, torch.stack(difference), atol=1e-4, rtol=0)


def test_o6_with_lambda_one_the_expected_deltas_add_up_to_the_return_minus_the_deliberation():
    # Options that end at every step, a critic of zero: each arrival but the last costs 0.3.
    config = config_of(deliberation_cost=0.3, termination_bias=ALWAYS, gamma=1.0, gae_lambda=1.0, reward_scale=0.1)
    assert_charged(config, death_rate=0.0)


# --- O1: one option is PPO --------------------------------------------------------------------------------------------


def flat_copy(policy, hidden):
    """The flat policy that computes what option 0 computes."""
    flat = GaussianPolicy(2, 2, hidden, torch.Generator().manual_seed(9))
    weight, bias = policy.skills.first.effective()
    with torch.no_grad():
        flat.mean[0].weight.copy_(weight[0])
        flat.mean[0].bias.copy_(bias[0])
        for i in (2, 4):
            flat.mean[i].weight.copy_(policy.skills.rest[i - 2].weight)
            flat.mean[i].bias.copy_(policy.skills.rest[i - 2].bias)
    return flat


def test_o1_with_one_option_the_update_is_flat_ppos_on_the_same_batch():
    # `concatenate` with one option has two biases, and Adam moves each: the one of the option is frozen to compare.
    config = config_of(
        num_skills=1,
        skill_integration="concatenate",
        minibatch_size=0,
        deliberation_cost=0.5,
        skill_hidden_sizes=[16, 16],
        adam_epsilon=1e-8,
    )
    policy, steps, options = experience(config, death_rate=0.02)
    policy.skills.first.weight.register_hook(lambda g: g * torch.tensor([1.0, 1.0, 0.0]))
    flat = flat_copy(policy, [16, 16])
    data = oc.portion(config, policy, steps, options, 0, 20)

    with torch.no_grad():
        value = policy.critic(steps.obs).squeeze(-1).double()
    done = steps.done
    advantage = gae(steps.reward, value[:-1], value[1:], done, done, config.gamma, config.gae_lambda)
    torch.testing.assert_close(data.advantage, standardize(advantage.flatten()).float())  # unscaled, nothing charged
    torch.testing.assert_close(data.returns, (advantage + value[:-1]).flatten().float())

    before = copy.deepcopy(policy.state_dict())
    obs, action = steps.obs[:-1].flatten(0, 1), steps.action.flatten(0, 1)
    level = Level("policy", lambda c: flat.log_prob(obs[c], action[c]), standardize(advantage.flatten()).float())
    optimizer = torch.optim.Adam(flat.parameters(), lr=config.learning_rate)
    maximize([level], optimizer, config.updates, config.clip_range, len(obs))
    learn(config, policy, data)
    reference = flat_copy(policy, [16, 16])
    for mine, theirs in zip(reference.mean.parameters(), flat.mean.parameters(), strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(policy.skills.log_std_parameter[0], flat.log_std_parameter, rtol=1e-4, atol=1e-6)
    assert moved(policy, before) == {"skills", "critic"}


def test_o1_with_one_option_ppocs_losses_leave_termination_and_choice_alone_too():
    config = config_of(num_skills=1, ppoc_faithful=True, deliberation_cost=0.5)
    policy, steps, options = experience(config)
    before = copy.deepcopy(policy.state_dict())
    learn(config, policy, oc.portion(config, policy, steps, options, 0, 20))
    assert moved(policy, before) == {"skills", "critic"}


# --- O2, O8: call-and-return ------------------------------------------------------------------------------------------


def test_o2_options_that_never_end_last_an_episode_and_are_valued_by_plain_gae():
    config = config_of(termination_bias=NEVER)
    policy, steps, options = experience(config, death_rate=0.05)
    assert torch.equal(options.is_decision[1:], steps.done)
    data = oc.portion(config, policy, steps, options, 0, 20)
    with torch.no_grad():
        q = policy.critic(steps.obs).double()
    now, later = oc.of_option(q[:-1], options.option[:-1]), oc.of_option(q[1:], options.option[:-1])
    expected = now + gae(0.1 * steps.reward, now, later, steps.done, steps.done, config.gamma, config.gae_lambda)
    order = options.option[:-1].flatten().argsort(stable=True)
    torch.testing.assert_close(data.returns, expected.flatten()[order].float())
    assert oc.option_statistics(options, 3)["commitment_mean"] > 5


def test_o2_options_that_always_end_are_chosen_anew_at_every_step():
    config = config_of(termination_bias=ALWAYS)
    _, _, options = experience(config)
    assert bool(options.is_decision.all())
    assert oc.option_statistics(options, 3)["commitment_mean"] == 1  # the collapse that the metric shows


def test_options_are_chosen_and_ended_with_the_probabilities_that_the_networks_give():
    config = config_of(batch_size=40000, termination_bias=-1.0)
    policy, steps, options = experience(config)
    with torch.no_grad():
        pi, beta = policy.manager.log_probs(steps.obs).exp(), policy.beta(steps.obs)
    decided = options.is_decision
    frequency = torch.nn.functional.one_hot(options.option[decided], 3).float().mean(0)
    torch.testing.assert_close(frequency, pi[decided].mean(0), atol=0.02, rtol=0)
    arrived = ~options.begins[1:]
    ended = decided[1:][arrived].float().mean()
    torch.testing.assert_close(ended, oc.of_option(beta[1:], options.option[:-1])[arrived].mean(), atol=0.012, rtol=0)
    kept = ~decided[1:]
    assert torch.equal(options.option[1:][kept], options.option[:-1][kept])


def test_o8_nothing_is_learnt_about_ending_an_option_where_its_episode_ended():
    config = config_of()
    policy, steps, options = experience(config, death_rate=0.1)
    data = oc.portion(config, policy, steps, options, 0, 20)
    going_on = ~steps.done
    assert len(data.stop_advantage) == int(going_on.sum()) < 200
    # The state arrived at with the option that brought it there, not the departed one and not the new option.
    torch.testing.assert_close(data.arrived, steps.obs[1:][going_on])
    assert torch.equal(data.arrived_option, options.option[:-1][going_on])
    assert not torch.equal(data.arrived_option, options.option[1:][going_on])
    with torch.no_grad():
        q, pi = policy.critic(steps.obs).double(), policy.manager.log_probs(steps.obs).exp().double()
    excess = oc.of_option(q[1:], options.option[:-1]) - (pi * q).sum(-1)[1:]
    torch.testing.assert_close(data.stop_advantage, excess[going_on].float())


def test_portions_of_a_horizon_without_updates_in_between_are_the_horizon_at_once():
    config = config_of()
    policy, steps, options = experience(config, death_rate=0.05)
    envs = TargetEnv(config.num_envs, 0, horizon=20, death_rate=0.05)
    execution = oc.Execution(policy, config, envs, 0, 0)
    for first, last in ((0, 7), (7, 8), (8, 20)):
        execution.run(first, last)
    assert torch.equal(execution.steps.action, steps.action)
    for name in ("option", "is_decision", "begins"):
        assert torch.equal(getattr(execution.options, name), getattr(options, name))


def test_greedy_execution_repeats_itself_and_ends_options_above_one_half(tmp_path):
    config = config_of(batch_size=400)
    run(oc.train, config, tmp_path)
    returns = [
        rollout(oc, config, TargetEnv(4, 5), seed, Checkpoint(tmp_path), greedy=True).reward.sum() for seed in (1, 1)
    ]
    assert returns[0] == returns[1]
    policy = oc.make_policy(config, TargetEnv(4, 5), torch.Generator().manual_seed(0))
    execution = oc.Execution(policy, config, TargetEnv(4, 5), 0, 0, greedy=True)
    execution.run(0, 20)
    with torch.no_grad():
        beta = oc.of_option(policy.beta(execution.steps.obs)[1:], execution.options.option[:-1])
    assert torch.equal(execution.options.is_decision[1:], (beta > 0.5) | execution.options.begins[1:])


# --- O3, O4, O5: what each loss does ----------------------------------------------------------------------------------


def mean_beta(policy, data):
    with torch.no_grad():
        return float(oc.of_option(policy.beta(data.arrived), data.arrived_option).mean())


def test_o3_a_deliberation_cost_makes_options_longer():
    changes = []
    for cost in (0.0, 5.0):
        config = config_of(deliberation_cost=cost)
        policy, steps, options = experience(config)
        data = oc.portion(config, policy, steps, options, 0, 20)
        before = mean_beta(policy, data)
        learn(config, policy, data)
        changes.append(mean_beta(policy, data) - before)
    assert changes[1] < -0.01
    assert changes[1] < changes[0]


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_o3_options_worth_less_than_the_choice_end_sooner_and_others_later(sign):
    config = config_of()
    policy, steps, options = experience(config)
    data = oc.portion(config, policy, steps, options, 0, 20)
    data = dataclasses.replace(data, stop_advantage=torch.full_like(data.stop_advantage, sign))
    before = mean_beta(policy, data)
    learn(config, policy, data)
    assert (mean_beta(policy, data) - before) * sign < -0.01


def test_o4_every_loss_moves_its_own_network_only():
    config = config_of()
    policy, steps, options = experience(config)
    data = oc.portion(config, policy, steps, options, 0, 20)
    for name, network in (("skill", "skills"), *((n, n) for n in NETWORKS[1:])):
        fresh = copy.deepcopy(policy)
        optimizers = oc.make_optimizers(config, fresh)
        for other, optimizer in optimizers.items():
            if other != name:
                optimizer.param_groups[0]["lr"] = 0.0
        oc.update(config, fresh, optimizers, data, torch.Generator().manual_seed(0))
        assert moved(fresh, policy.state_dict()) == {network}


def test_o4_the_termination_loss_holds_its_advantage_constant():
    config = config_of()
    policy, steps, _ = experience(config)
    seen = steps.obs[:-1].flatten(0, 1)
    option = torch.zeros(len(seen), dtype=torch.long)

    def gradient_of_the_critic(loss):
        policy.zero_grad()
        loss.backward()
        gradient = policy.critic[0].weight.grad
        return 0.0 if gradient is None else float(gradient.abs().sum())

    beta = oc.of_option(policy.beta(seen), option)
    q = policy.critic(seen)
    assert gradient_of_the_critic(oc.termination_loss(beta, q[:, 0] - q.mean(-1))) == 0
    beta, q = oc.of_option(policy.beta(seen), option), policy.critic(seen)
    assert gradient_of_the_critic((beta * (q[:, 0] - q.mean(-1))).mean()) > 0  # the wrong variant


def assert_charged(config, death_rate):
    """With a critic of zero, gamma = lambda = 1: the cost is in the returns once per termination, never at an end."""
    policy, steps, options = experience(config, death_rate=death_rate)
    with torch.no_grad():
        for parameter in policy.critic.parameters():
            parameter.zero_()
    free = oc.portion(dataclasses.replace(config, deliberation_cost=0.0), policy, steps, options, 0, config.horizon)
    charged = oc.portion(config, policy, steps, options, 0, config.horizon)
    stops = (options.is_decision & ~options.begins)[1:]  # on arrival; beginnings of episodes are none
    expected = torch.zeros_like(steps.reward)
    for n in range(expected.shape[1]):
        total = 0.0
        for t in reversed(range(config.horizon)):
            total = config.deliberation_cost * float(stops[t, n]) + (0.0 if steps.done[t, n] else total)
            expected[t, n] = total
    order = options.option[:-1].flatten().argsort(stable=True)
    torch.testing.assert_close(free.returns - charged.returns, expected.flatten()[order].float(), atol=1e-4, rtol=1e-4)
    assert expected.max() > 0
    return stops


@pytest.mark.parametrize("ppoc_faithful", [False, True])
def test_o5_a_termination_is_charged_once_and_the_end_of_an_episode_is_not(ppoc_faithful):
    config = config_of(
        deliberation_cost=0.3, termination_bias=ALWAYS, gamma=1.0, gae_lambda=1.0, ppoc_faithful=ppoc_faithful
    )
    assert_charged(config, death_rate=0.1)


def test_o5_ppocs_losses_charge_the_terminations_that_were_drawn():
    config = config_of(deliberation_cost=0.3, gamma=1.0, gae_lambda=1.0, ppoc_faithful=True)
    stops = assert_charged(config, death_rate=0.1)
    assert 0.3 < stops.float().mean() < 0.7


def test_o5_the_logged_return_has_neither_the_cost_nor_the_scale_in_it(tmp_path):
    logged = []
    for i, settings in enumerate(({}, {"deliberation_cost": 3.0}, {"reward_scale": 1.0}, {"ppoc_faithful": True})):
        run(oc.train, config_of(**settings), tmp_path / str(i))
        logged.append(progress(tmp_path / str(i))["return_mean"][0])
    assert len(set(logged)) == 1
    assert -60 < logged[0] < -20  # 20 (1 - 2 - 2/3) = -33, not a tenth of it


# --- O7: the gradient of the policy over options ----------------------------------------------------------------------


def test_o7_the_policy_over_options_follows_the_enumerated_gradient_of_a_two_state_bandit():
    generator = torch.Generator().manual_seed(0)
    config = config_of(
        num_skills=2, manager_entropy_weight=0.0, minibatch_size=0, updates=1, manager_hidden_sizes=[4], batch_size=200
    )
    policy = oc.make_policy(config, TargetEnv(10, 0), generator)
    worth = torch.tensor([[1.0, 3.0], [2.0, -1.0]])  # of option o in state s
    samples = 100_000
    state = torch.randint(2, (samples,), generator=generator)
    seen = torch.nn.functional.one_hot(state, 2).float()
    with torch.no_grad():
        pi = policy.manager.log_probs(torch.eye(2)).exp()
    option = (torch.rand(samples, generator=generator) < pi[state, 1]).long()
    returns = worth[state, option] + torch.randn(samples, generator=generator)

    def gradient(advantage):
        order = option.argsort(stable=True)
        data = oc.Portion(
            seen=seen[order],
            action=torch.zeros(samples, 2),
            option=option[order],
            advantage=torch.zeros(samples),
            returns=torch.zeros(samples),
            choice_advantage=advantage[order],
            is_decision=torch.ones(samples, dtype=torch.bool),
            arrived=seen[:1],
            arrived_option=option[:1],
            stop_advantage=torch.zeros(1),
            statistics={},
        )
        fresh = copy.deepcopy(policy)
        optimizers = oc.make_optimizers(config, fresh)
        optimizers["manager"] = torch.optim.SGD(fresh.manager.parameters(), lr=1.0)
        before = torch.nn.utils.parameters_to_vector(fresh.manager.parameters()).detach().clone()
        oc.improve(config, fresh, optimizers, data, generator)
        return torch.nn.utils.parameters_to_vector(fresh.manager.parameters()).detach() - before

    log_pi = policy.manager.log_probs(torch.eye(2))
    value = (log_pi.exp() * worth).sum(-1)
    exact = torch.cat([g.flatten() for g in torch.autograd.grad(value.mean(), policy.manager.parameters())])
    with torch.no_grad():
        baseline = value[state]
    estimate = gradient(returns - baseline)
    torch.testing.assert_close(estimate, exact, atol=0.02, rtol=0)
    assert exact.abs().max() > 0.15
    # The published code's advantage, with the baseline Q(s, o) that depends on the choice: nothing is left of it.
    assert gradient(returns - worth[state, option]).abs().max() < 0.02


def test_o7_the_advantage_of_a_choice_is_its_return_minus_the_value_of_choosing():
    config = config_of()
    policy, steps, options = experience(config, death_rate=0.05)
    data = oc.portion(config, policy, steps, options, 0, 20)
    with torch.no_grad():
        value = (policy.manager.log_probs(data.seen).exp() * policy.critic(data.seen)).sum(-1)
    torch.testing.assert_close(data.choice_advantage, standardize(data.returns - value), rtol=1e-3, atol=1e-4)


def test_the_policy_over_options_learns_from_decisions_only():
    # The published code pushes it at every step.
    config = config_of(termination_bias=-2.0)
    policy, steps, options = experience(config)
    data = oc.portion(config, policy, steps, options, 0, 20)
    idle = ~data.is_decision
    assert idle.any()
    other = dataclasses.replace(data, choice_advantage=torch.where(idle, 100.0, data.choice_advantage))
    results = []
    for portion in (data, other):
        fresh = copy.deepcopy(policy)
        learn(config, fresh, portion)
        results.append(fresh.manager.state_dict())
    assert all(torch.equal(results[0][k], results[1][k]) for k in results[0])


# --- O9 and the published code's other bugs ---------------------------------------------------------------------------


def test_o9_collapse_to_one_option_and_to_one_step_shows_in_the_metrics():
    option = torch.zeros(21, 4, dtype=torch.long)
    always = torch.ones(21, 4, dtype=torch.bool)
    collapsed = oc.option_statistics(Options(option, always, always), 3)
    assert collapsed["commitment_mean"] == 1
    assert collapsed["usage_entropy"] == 0
    assert collapsed["skill_0_usage"] == 1
    even = oc.option_statistics(Options(torch.arange(84).view(21, 4) % 2, always, always), 2)
    assert even["usage_entropy"] == pytest.approx(np.log(2))


def test_the_terminations_step_size_is_what_it_says_unlike_ppocs():
    # PPOC's 5e-7 goes through an Adam whose other steps, 3e-4 each, also move the termination by its stale moments.
    sizes = []
    for settings in ({"termination_learning_rate": 5e-7}, {"ppoc_faithful": True}):
        config = config_of(minibatch_size=0, critic_minibatch_size=0, **settings)
        policy, steps, options = experience(config)
        before = policy.termination[0].weight.detach().clone()
        learn(config, policy, oc.portion(config, policy, steps, options, 0, 20))
        gradient_steps = config.updates * (1 if not config.ppoc_faithful else 3)
        sizes.append(float((policy.termination[0].weight - before).abs().max().detach()) / gradient_steps)
    assert sizes[0] < 1e-6
    assert sizes[1] > 1e-5


def test_ppocs_losses_are_as_published():
    # One pass, one minibatch, all rows of option 0: the first moments of Adam after its two steps are
    # 0.1 (0.9 g_termination + g_rest) with the gradients of the formulas below.
    config = config_of(num_skills=2, ppoc_faithful=True, updates=1, minibatch_size=0, deliberation_cost=0.2)
    policy, steps, options = experience(config)
    with torch.no_grad():
        policy.manager.logits[-1].bias[0] = 1.0
    options.option.zero_()
    data = oc.portion(config, policy, steps, options, 0, 20)
    reference = copy.deepcopy(policy)
    optimizers = oc.make_optimizers(config, policy)
    oc.improve_as_ppoc(config, policy, optimizers["all"], data, torch.Generator().manual_seed(3))
    generator = torch.Generator().manual_seed(3)
    (rows,) = minibatches(200, 1, 1, generator)
    first = int(torch.randint(200, (), generator=generator))

    x, advantage = data.seen[rows], data.advantage[rows]
    with torch.no_grad():
        q, p = reference.critic(x), reference.manager.logits(x).softmax(-1)
        excess = q[:, 0] - (p * q).sum(-1) + 0.2
    (torch.sigmoid(reference.termination(x)[:, 0]) * excess).sum().backward()
    termination = [parameter.grad.clone() for parameter in reference.termination.parameters()]
    reference.zero_grad()
    log_p = reference.manager.logits(x).log_softmax(-1)
    choice = -sum(log_p[first, 0] * a for a in advantage) + 0.1 * (log_p.exp() * log_p).sum()
    value = (reference.critic(x)[:, 0] - data.returns[rows]).square().mean()
    ratio = reference.skills.log_prob(x[:, :2], data.option[rows], data.action[rows])
    action = -((ratio - ratio.detach()).exp() * advantage).mean()
    (choice + value + action).backward()
    state = optimizers["all"].state
    for mine, theirs in zip(policy.termination.parameters(), termination, strict=True):
        torch.testing.assert_close(state[mine]["exp_avg"], 0.09 * theirs, rtol=1e-3, atol=1e-6)
    for name in ("skills", "critic", "manager"):
        for mine, theirs in zip(getattr(policy, name).parameters(), getattr(reference, name).parameters(), strict=True):
            torch.testing.assert_close(state[mine]["exp_avg"], 0.1 * theirs.grad, rtol=1e-3, atol=1e-5)


def test_a_constant_advantage_is_no_division_by_zero():
    config = config_of()
    policy, steps, options = experience(config)
    steps.reward.zero_()
    with torch.no_grad():
        for parameter in policy.critic.parameters():
            parameter.zero_()
    data = oc.portion(config, policy, steps, options, 0, 20)
    assert bool((data.advantage == 0).all())
    learn(config, policy, data)
    assert all(bool(torch.isfinite(p).all()) for p in policy.parameters())


def test_an_option_without_steps_in_a_portion_is_no_problem():
    for ppoc_faithful in (False, True):
        config = config_of(ppoc_faithful=ppoc_faithful)
        policy, steps, options = experience(config)
        options.option.clamp_(max=1)
        options.option[0, 0] = 2  # one step of option 2, far below PPOC's least number
        data = oc.portion(config, policy, steps, options, 0, 20)
        before = copy.deepcopy(policy.state_dict())
        learn(config, policy, data)
        assert moved(policy, before) == set(NETWORKS)
        assert all(bool(torch.isfinite(p).all()) for p in policy.parameters())


# --- given skills -----------------------------------------------------------------------------------------------------


def test_a_run_starts_from_given_skills_bit_by_bit_with_observations_as_they_are(tmp_path, monkeypatch):
    state = given_skills(tmp_path / "skills.pt")
    monkeypatch.setattr(oc, "update", lambda *_: {})
    for name, settings in (("given", {"skills": str(tmp_path / "skills.pt")}), ("scratch", {})):
        run(oc.train, config_of(**settings), tmp_path / name)
    given, scratch = (load(tmp_path / name / "checkpoint.pt")["policy"] for name in ("given", "scratch"))
    assert all(torch.equal(given[f"skills.{name}"], value) for name, value in state.items())
    assert not torch.equal(scratch["skills.first.weight"], state["first.weight"])
    assert (given["filter.count"], scratch["filter.count"]) == (0, 200)  # a filter would change what the skills compute


def test_given_skills_of_another_shape_are_refused_by_name(tmp_path):
    given_skills(tmp_path / "skills.pt")
    for settings, message in (
        ({"num_skills": 6}, "its num_skills is 3, the policy's 6"),
        ({"log_std_per_skill": True}, "its log_std_per_skill is False, the policy's True"),
    ):
        with pytest.raises(SkillsError, match=message):
            run(oc.train, config_of(skills=str(tmp_path / "skills.pt"), **settings), tmp_path / "wrong")


# --- settings ---------------------------------------------------------------------------------------------------------


def test_an_update_follows_every_2048_steps_of_all_environments(tmp_path):
    assert oc.OptionCriticConfig(1, 50_000, 1000).steps_between_updates == 41  # 50 environments: 2050 steps
    assert oc.OptionCriticConfig(1, 100_000, 5000).steps_between_updates == 103  # 20 environments: 2060 steps
    assert oc.OptionCriticConfig(1, 1000, 1000).steps_between_updates == 1000
    assert oc.OptionCriticConfig(1, 1000, 1000, steps_per_update=0).steps_between_updates == 1000
    config = config_of(steps_per_update=70, minibatch_size=0)  # portions of 7 steps: 7, 7 and 6
    run(oc.train, config, tmp_path)
    state = load(tmp_path / "checkpoint.pt")["skill_optimizer"]["state"]
    assert state[0]["step"].item() == 3 * config.updates


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"num_skills": 0}, "num_skills=0: must be at least 1"),
        ({"batch_size": 10}, "batch_size=10: must be at least one horizon, 20 steps"),
        ({"deliberation_cost": -0.1}, "deliberation_cost=-0.1: must be at least 0.0"),
        ({"skill_integration": "heads"}, "skill_integration=heads: must be one of bilinear, concatenate"),
    ],
)
def test_settings_that_cannot_work_are_refused_by_name(settings, message):
    with pytest.raises(ConfigError, match=f"^{message}$"):
        config_of(**settings)
