"""Lemma 1 and Lemma 2 of the paper, checked: exact against enumeration, the error's order, unbiased baselines."""

import itertools
import math

import pytest
import torch

from hippo import gradients, hippo
from hippo.core.checkpoint import Checkpoint
from hippo.core.hierarchy import HierarchicalPolicy, collect
from hippo.hippo import HippoConfig
from tests.hippo.toy import TargetEnv, run


def hierarchy(num_skills=3, horizon=12, num_envs=4, death_rate=0.1, spread=1.0, size=2, **settings):
    """A float64 policy whose skills differ, and a batch that it collected."""
    settings = {"period_min": 2, "period_max": 4, **settings}
    config = HippoConfig(
        iterations=1, batch_size=horizon * num_envs, horizon=horizon, num_skills=num_skills, **settings
    )
    policy = HierarchicalPolicy(config, size, size, size, torch.Generator().manual_seed(0))
    with torch.no_grad():
        policy.skills.first.weight[:, size + 1 :] *= spread
        policy.skills.rest[-1].weight.mul_(spread)
    batch = collect(policy, TargetEnv(num_envs, 0, horizon=horizon, death_rate=death_rate, size=size), config, 0, 0)
    return policy.double(), doubled(batch)


def doubled(batch):
    batch.steps.obs, batch.steps.action = batch.steps.obs.double(), batch.steps.action.double()
    batch.time_left = batch.time_left.double()
    return batch


def test_exact_log_prob_equals_brute_force_enumeration_of_the_mixture():
    policy, batch = hierarchy()
    obs, action = batch.steps.obs, batch.steps.action
    expected, observed = [], []
    for n in range(4):
        starts = batch.is_decision[:-1, n].nonzero().squeeze(-1).tolist()
        for start, end in zip(starts, [*starts[1:], 12], strict=True):
            manager = policy.manager.logits(policy.manager_input(obs[start, n], batch.time_left[start, n])).softmax(-1)
            terms = []
            for z in range(3):
                product = float(manager[z])
                for t in range(start, end):
                    x = policy.skill_input(obs[t, n], batch.time_left[t, n]).unsqueeze(0)
                    mean = policy.skills.means(x)[0, z]
                    for d in range(2):
                        product *= math.exp(-0.5 * float(action[t, n, d] - mean[d]) ** 2) / math.sqrt(2 * math.pi)
                terms.append(product)
            expected.append(math.log(sum(terms)))
            observed.append(math.log(terms[int(batch.skill[start, n])]))
    exact, approximate = (f(policy, batch).tolist() for f in gradients.LOG_PROBS.values())
    assert exact == pytest.approx(expected, abs=1e-10)
    assert approximate == pytest.approx(observed, abs=1e-10)
    assert max(e - a for e, a in zip(exact, approximate, strict=True)) > 0.1  # they do differ here


@pytest.mark.parametrize("period", [1, 7, 15])
def test_eight_action_dimensions_and_long_periods_do_not_underflow(period):
    policy, batch = hierarchy(num_skills=6, size=8, horizon=30, spread=30.0, period_min=period, period_max=period)
    exact = gradients.exact_log_prob(policy, batch)
    assert bool(torch.isfinite(exact).all())
    if period == 15:
        assert float(exact.min().exp()) < 1e-40  # what the authors' float32 would have to hold
    gradient = gradients.segment_gradient(policy, "exact", gradients.segments(policy, batch), torch.ones(len(exact)))
    assert bool(torch.isfinite(gradient).all())


def test_exact_equals_approximate_when_skills_have_disjoint_support():
    policy, batch = hierarchy(spread=1.0)
    with torch.no_grad():  # skills 50 standard deviations apart, and the actions taken follow their own skill
        policy.skills.first.weight.zero_()
        policy.skills.first.weight[0, 3:6] = torch.tensor([-3.0, 0.0, 3.0])
        for layer in policy.skills.rest[::2]:
            layer.weight.zero_()
        policy.skills.rest[0].weight[0, 0] = 1.0
        policy.skills.rest[2].weight[:, 0] = 100.0
    centre = 100 * math.tanh(math.tanh(3.0))
    own_mean = torch.tensor([-centre, 0.0, centre], dtype=torch.float64)[batch.skill[:-1]].unsqueeze(-1)
    batch.steps.action = own_mean + torch.randn(12, 4, 2, dtype=torch.float64)
    exact, approximate = (f(policy, batch) for f in gradients.LOG_PROBS.values())
    torch.testing.assert_close(exact, approximate, rtol=0, atol=1e-12)
    similarity = gradients.cosine_similarities(policy, batch, batch.steps.reward, batch.steps.reward)
    assert similarity["cosine_batch"] == pytest.approx(1.0, abs=1e-12)
    assert similarity["cosine_unweighted_mean"] == pytest.approx(1.0, abs=1e-12)


def test_with_one_skill_the_two_gradients_are_the_same_and_with_alike_skills_they_are_not():
    for num_skills, same in ((1, True), (4, False)):
        policy, batch = hierarchy(num_skills=num_skills)
        similarity = gradients.cosine_similarities(policy, batch, batch.steps.reward, batch.steps.reward)
        assert (similarity["cosine_batch"] > 1 - 1e-9) is same
        assert similarity["trajectories"] == float(batch.steps.done[:-1].sum() + 4)


def test_per_trajectory_gradients_sum_to_the_whole_batchs_in_pieces_of_any_size(monkeypatch):
    policy, batch = hierarchy()
    seg = gradients.segments(policy, batch)
    weight = torch.randn(len(seg.length), dtype=torch.float64)
    whole = gradients.segment_gradient(policy, "exact", seg, weight)
    monkeypatch.setattr(gradients, "CHUNK", 5)
    assert len(list(seg.parts())) > 5
    torch.testing.assert_close(gradients.segment_gradient(policy, "exact", seg, weight), whole)
    # Autograd in one piece, without our bookkeeping.
    policy.zero_grad()
    (gradients.exact_log_prob(policy, batch) * weight).sum().backward()
    torch.testing.assert_close(gradients.flat_gradient(policy), whole)


def error_of_the_gradient(log_prob_other, log_prob_own, parameter, period):
    """|grad exact - grad approximate| for one segment of `period` equal steps under two skills, uniform manager."""
    own, other = period * log_prob_own(parameter), period * log_prob_other(parameter)
    exact = torch.logaddexp(own, other) - math.log(2.0)
    approximate = own - math.log(2.0)
    (difference,) = torch.autograd.grad(exact - approximate, parameter)
    return float(difference.abs())


@pytest.mark.parametrize("period", [2, 5, 10])
def test_the_order_of_lemma_1s_error_depends_on_the_parametrisation(period):
    # Own probability 1/2 without a parameter; the other skill's probability of the action is epsilon.
    own = lambda _: torch.tensor(math.log(0.5), dtype=torch.float64)  # noqa: E731
    forms = {
        "linear": (lambda e: e, lambda x: x.log(), period - 1),  # pi = theta: the paper's bound eps^(p - 1) is met
        "softmax": (lambda e: math.log(e / (1 - e)), torch.nn.functional.logsigmoid, period),
        "gaussian": (lambda e: math.sqrt(-2 * math.log(e)), lambda x: -0.5 * x.square(), period),
    }
    for name, (inverse, log_prob, order) in forms.items():
        errors = []
        epsilons = (1e-3, 1e-4)
        for epsilon in epsilons:
            parameter = torch.tensor(float(inverse(epsilon)), dtype=torch.float64, requires_grad=True)
            assert float(log_prob(parameter)) == pytest.approx(math.log(epsilon), rel=1e-9)
            errors.append(error_of_the_gradient(log_prob, own, parameter, period))
        slope = (math.log(errors[0]) - math.log(errors[1])) / (math.log(epsilons[0]) - math.log(epsilons[1]))
        # The Gaussian's score grows like sqrt(-2 log epsilon), which bends the slope a little.
        assert slope == pytest.approx(order, abs=0.1 if name == "gaussian" else 0.02), name


def test_the_papers_example_of_the_neglected_factor_is_a_slip():
    # Section 5.5 puts epsilon^(p-1) = 10^-10 for epsilon 0.1 and p = 10; it is 10^-9.
    assert math.isclose(0.1 ** (10 - 1), 1e-9)
    assert not math.isclose(0.1 ** (10 - 1), 1e-10)
    # What counts is (epsilon / own)^p: with Table 2's Ant, random skills, (0.13 / 0.31)^10.
    assert math.isclose((0.13 / 0.31) ** 10, 1.7e-4, rel_tol=0.03)


# --- Lemma 2 on a small MDP: two states, two actions, two skills, one commitment of p = 2 steps, enumerated exactly.


def enumerated(baseline_low, baseline_high):
    """E[sum_k grad log pi_h b_h + sum_t grad log pi_l b_l] over every trajectory, by autograd in float64."""
    generator = torch.Generator().manual_seed(3)
    manager = torch.randn(2, 2, generator=generator, dtype=torch.float64, requires_grad=True)  # (S, Z)
    skills = torch.randn(2, 2, 2, generator=generator, dtype=torch.float64, requires_grad=True)  # (S, Z, A)
    follow = torch.rand(2, 2, generator=generator, dtype=torch.float64)  # P(s' = 1 | s, a)
    log_h, log_l = manager.log_softmax(-1), skills.log_softmax(-1)
    expectation = torch.zeros((), dtype=torch.float64)
    mass = 0.0
    for s0, z, a0, s1, a1 in itertools.product(range(2), repeat=5):
        transition = follow[s0, a0] if s1 == 1 else 1 - follow[s0, a0]
        probability = (0.5 * log_h[s0, z].exp() * log_l[s0, z, a0].exp() * transition * log_l[s1, z, a1].exp()).detach()
        mass += float(probability)
        score = log_h[s0, z] * baseline_high(s0, z)
        score = score + log_l[s0, z, a0] * baseline_low(s0, z, a0) + log_l[s1, z, a1] * baseline_low(s1, z, a1)
        expectation = expectation + probability * score
    assert mass == pytest.approx(1.0, abs=1e-12)
    grads = torch.autograd.grad(expectation, (manager, skills))
    return torch.cat([g.flatten() for g in grads])


def test_both_baselines_leave_the_expected_gradient_unchanged():
    table = torch.tensor([[3.0, -7.0], [11.0, 0.5]], dtype=torch.float64)
    gradient = enumerated(lambda s, z, a: table[s, z], lambda s, z: table[s, 0])
    torch.testing.assert_close(gradient, torch.zeros_like(gradient), rtol=0, atol=1e-14)


def test_a_baseline_that_sees_the_action_or_a_managers_that_sees_its_skill_biases_it():
    assert enumerated(lambda s, z, a: 1.0 + a, lambda s, z: 0.0).abs().max() > 0.01
    assert enumerated(lambda s, z, a: 0.0, lambda s, z: 1.0 + z).abs().max() > 0.01


def test_the_definitions_of_an_actions_probability_worked_by_hand():
    # One step, two skills, A = 2, sigma 1; the action is at skill 0's mean and (1, 1) from skill 1's.
    per_dimension = torch.tensor([[[0.0, 0.0], [-0.5, -0.5]]], dtype=torch.float64) - 0.5 * math.log(2 * math.pi)
    p = gradients.action_probabilities(per_dimension.sum(-1), per_dimension, torch.zeros(2, 2, dtype=torch.float64))
    peak = 1 / math.sqrt(2 * math.pi)
    expected = {
        "density": (peak**2, peak**2 * math.exp(-1)),
        "density_over_peak": (1.0, math.exp(-1)),
        "density_per_dimension": (peak, peak * math.exp(-0.5)),
        "peak_geometric": (1.0, math.exp(-0.5)),
        "posterior": (1 / (1 + math.exp(-1)), math.exp(-1) / (1 + math.exp(-1))),
    }
    assert set(p) == set(expected)
    for name, values in expected.items():
        assert p[name][0].tolist() == pytest.approx(values, abs=1e-12), name


def test_own_probabilities_have_their_closed_form_means():
    # For an action drawn from its own skill, sigma 1, A dimensions: density over peak 2^(-A/2), per dimension 0.2821.
    for size, over_peak in ((4, 0.25), (8, 0.0625)):
        policy, batch = hierarchy(size=size, horizon=400, num_envs=10, death_rate=0.0)
        out = gradients.skill_separation(policy, batch)
        assert out["own_density_over_peak_mean"] == pytest.approx(over_peak, rel=0.06)
        assert out["own_density_per_dimension_mean"] == pytest.approx(0.2821, rel=0.01)
        assert out["other_density_per_dimension_mean"] < out["own_density_per_dimension_mean"] * 1.2


def test_gradient_variance_is_that_of_the_trajectories_estimates_and_a_good_baseline_lowers_it():
    policy, batch = hierarchy(death_rate=0.0, num_envs=40)
    reward = batch.steps.reward
    togo = reward.flip(0).cumsum(0).flip(0)
    raw = gradients.gradient_variance(policy, batch, togo)
    estimates = []
    for n in range(40):
        policy.zero_grad()
        for t in range(12):
            x = policy.skill_input(batch.steps.obs[t, n], batch.time_left[t, n]).unsqueeze(0)
            log_prob = policy.skills.log_prob(x, batch.skill[t, n].unsqueeze(0), batch.steps.action[t, n].unsqueeze(0))
            (log_prob.sum() * togo[t, n]).backward()
        estimates.append(gradients.flat_gradient(policy.skills))
    assert raw == pytest.approx(float(torch.stack(estimates).var(0).sum()), rel=1e-9)
    assert gradients.gradient_variance(policy, batch, togo - togo.mean(1, keepdim=True)) < 0.7 * raw


def test_a_trained_run_is_measured_on_its_next_batch_before_any_update(tmp_path):
    config = HippoConfig(iterations=2, batch_size=200, horizon=20, num_skills=3, period_min=5, period_max=5)
    run(hippo.train, config, tmp_path)
    before = (tmp_path / "checkpoint.pt").read_bytes()
    make_envs = lambda num_envs, purpose: TargetEnv(num_envs, 0)  # noqa: E731
    first = gradients.measure(config, make_envs, 0, Checkpoint(tmp_path))
    assert first == gradients.measure(config, make_envs, 0, Checkpoint(tmp_path))
    assert (tmp_path / "checkpoint.pt").read_bytes() == before
    assert first["iteration"] == 2
    assert -1 <= first["cosine_batch"] <= 1
    assert first["trajectories"] == 10
    # No baseline: the variance of the plain returns' gradient on that batch.
    policy = HierarchicalPolicy(config, 2, 2, 2, torch.Generator())
    Checkpoint(tmp_path).restore(policy=policy)
    batch = collect(policy, TargetEnv(10, 0), config, 0, 2)
    returns = gradients.step_returns(batch, config)
    assert first["variance_none"] == pytest.approx(gradients.gradient_variance(policy, batch, returns), rel=1e-6)
    assert len({first[f"variance_{kind}"] for kind in ("none", "single", "skill")}) == 3
