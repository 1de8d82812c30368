"""What `protocol=modern` adds: running statistics, small initial policies, minibatches that train values, too."""

import copy

import numpy as np
import pytest
import torch
from torch import nn

from baselines import ppo
from experiments.config import compose_run
from experiments.evaluate import main as evaluate_main
from hippo import gradients, hippo
from hippo.core import seeding
from hippo.core.acting import rollout
from hippo.core.advantages import Baselines, advantages
from hippo.core.checkpoint import Checkpoint, CheckpointError, load, save
from hippo.core.hierarchy import HierarchicalPolicy, collect, restored
from hippo.core.levels import levels, rows_by_skill
from hippo.core.minibatch import minibatches
from hippo.core.networks import SkillLinear, mlp, normalize_columns
from hippo.core.normalize import ObservationFilter, RewardScale, RunningMoments
from hippo.core.on_policy import improve, make_optimizer
from hippo.core.policies import gaussian_entropy
from hippo.core.settings import ConfigError
from tests.hippo.test_training import MODERN
from tests.hippo.toy import TargetEnv, progress, run

BUDGET = {"iterations": 3, "batch_size": 400, "horizon": 20}


def hippo_config(**settings):
    return hippo.HippoConfig(**BUDGET | MODERN | {"num_skills": 3, "period_min": 2, "period_max": 6} | settings)


def ppo_config(**settings):
    return ppo.PPOConfig(**BUDGET | MODERN | {"hidden_sizes": [32, 32]} | settings)


# --- running statistics -----------------------------------------------------------------------------------------------


def test_running_moments_are_those_of_everything_seen_in_whatever_portions():
    x = torch.randn(1000, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 40 + 1e4
    moments = RunningMoments(3)
    for part in x.split([10, 700, 290]):
        moments.update(part.view(5, -1, 3))
    torch.testing.assert_close(moments.mean, x.mean(0), rtol=1e-12, atol=0)
    torch.testing.assert_close(moments.variance, x.var(0, correction=0), rtol=1e-9, atol=0)


def test_the_filter_is_exactly_the_identity_until_it_has_seen_something():
    x = torch.tensor([[1e6, -7.0, 0.3]])
    observation_filter = ObservationFilter(3)
    assert torch.equal(observation_filter(x), x)
    assert np.array_equal(observation_filter.actor()(x.numpy()), x.numpy())


def test_the_filter_has_the_mean_and_deviation_of_everything_seen_and_clips_at_five():
    x = torch.randn(1000, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([1.0, 40.0, 1e-3]) + 7
    observation_filter = ObservationFilter(3)
    observation_filter.update(x)
    y = observation_filter(x)
    assert float(y[:, 0].std()) == pytest.approx(1, abs=0.01)
    assert float(y[:, 2].std()) < 0.02  # a nearly constant entry is not blown up
    assert float(observation_filter(torch.full((1, 3), 1e5)).max()) == 5
    torch.testing.assert_close(torch.from_numpy(observation_filter.actor()(x.numpy())), y)


def test_rewards_are_divided_by_the_deviation_of_discounted_sums_that_start_anew_with_every_episode():
    reward = torch.tensor([[1.0, 0.0], [0.0, 2.0], [3.0, 0.0], [0.0, 1.0]], dtype=torch.float64)
    done = torch.tensor([[False, False], [True, False], [False, False], [True, True]])
    # By hand, gamma = 1/2. First column: 1, 1/2 | 3, 3/2; second: 0, 2, 1, 3/2.
    sums = np.array([1, 0.5, 3, 1.5, 0, 2, 1, 1.5])
    scale = RewardScale()
    scale.take_in(reward, done, 0.5)
    torch.testing.assert_close(scale(reward), reward / (sums.std() + 1e-8))
    carried_over = RewardScale()  # the wrong variant: sums that go on over the episodes' ends
    carried_over.take_in(reward, torch.zeros_like(done), 0.5)
    assert abs(float(carried_over.variance) / float(scale.variance) - 1) > 0.01
    assert float(scale(torch.tensor([1e9]))) == 10


def test_rewards_that_are_all_zero_stay_zero():
    scale, reward = RewardScale(), torch.zeros(5, 2, dtype=torch.float64)
    scale.take_in(reward, torch.zeros(5, 2, dtype=torch.bool), 0.9)
    assert torch.equal(scale(reward), reward)


@pytest.mark.parametrize(("learner", "config"), [(hippo, hippo_config()), (ppo, ppo_config())])
def test_a_restored_acts_as_the_one_in_memory_and_acting_leaves_its_statistics_alone(learner, config, tmp_path):
    run(learner.train, config, tmp_path)
    before = (tmp_path / "checkpoint.pt").read_bytes()
    state = load(tmp_path / "checkpoint.pt")["policy"]
    assert float(state["filter.count"]) == 3 * 400
    # What acted in memory: the same networks, with the statistics written out by hand.
    envs = TargetEnv(5, 3)
    steps = rollout(learner, config, envs, 1, Checkpoint(tmp_path), greedy=True)
    scale = state["filter.variance"].sqrt().clamp(min=0.1)
    seen = ((steps.obs.double() - state["filter.mean"]) / scale).clamp(-5, 5)
    view = learner.restored(config, envs, Checkpoint(tmp_path)).filter
    torch.testing.assert_close(view(steps.obs).double(), seen, rtol=1e-5, atol=1e-5)
    again = rollout(learner, config, TargetEnv(5, 3), 1, Checkpoint(tmp_path), greedy=True)
    assert torch.equal(again.action, steps.action)
    assert (tmp_path / "checkpoint.pt").read_bytes() == before
    # The wrong variant, statistics that go on being updated, would be seen in the actions.
    state["filter.mean"] += 0.1
    (tmp_path / "wrong").mkdir()
    save(tmp_path / "wrong" / "checkpoint.pt", load(tmp_path / "checkpoint.pt") | {"policy": state})
    wrong = rollout(learner, config, TargetEnv(5, 3), 1, Checkpoint(tmp_path / "wrong"), greedy=True)
    assert not torch.equal(wrong.action, steps.action)


@pytest.mark.parametrize(("learner", "config"), [(hippo, hippo_config()), (ppo, ppo_config())])
def test_the_returns_that_are_logged_are_those_of_the_environment(learner, config, tmp_path):
    run(learner.train, config, tmp_path)
    logged = progress(tmp_path)["return_mean"]
    assert (logged < -20).all()  # in the environment's units: a fresh policy gets about -33
    state = load(tmp_path / "checkpoint.pt")
    where = state["baselines"] if learner is hippo else state["reward_scale"]
    variance = where["reward_scale.variance" if learner is hippo else "variance"]
    assert logged[0] / float(variance.sqrt()) > -10  # the wrong variant, scaled rewards, would be seen


def test_a_measurement_scales_rewards_as_training_did_and_leaves_the_scale_alone(tmp_path):
    config = hippo_config()
    run(hippo.train, config, tmp_path)
    baselines, iteration = gradients.restored_baselines(config, TargetEnv(1, 0), Checkpoint(tmp_path))
    assert iteration == 3
    policy = restored(config, TargetEnv(1, 0), Checkpoint(tmp_path))
    steps = collect(policy, TargetEnv(20, 0), config, 0, iteration).steps
    variance = float(load(tmp_path / "checkpoint.pt")["baselines"]["reward_scale.variance"])
    steps.scale_rewards(baselines.reward_scale, config.gamma, frozen=True)
    torch.testing.assert_close(steps.scaled_reward, (steps.reward / variance**0.5).clamp(-10, 10))
    assert float(baselines.reward_scale.variance) == variance
    measured = gradients.measure(config, lambda n, _: TargetEnv(n, 0), 0, Checkpoint(tmp_path))
    assert all(np.isfinite(value) for value in measured.values())


def test_the_first_batch_is_not_learnt_from_but_fills_the_statistics(tmp_path):
    config = ppo_config(iterations=1)
    run(ppo.train, config, tmp_path)
    fresh = ppo.make_policy(config, TargetEnv(1, 0), torch.Generator())
    state = load(tmp_path / "checkpoint.pt")["policy"]
    assert state["filter.count"] == 400
    assert torch.equal(state["log_std_parameter"], fresh.log_std_parameter.detach())
    assert progress(tmp_path)["policy_approx_kl"][0] == 0


# --- initial weights --------------------------------------------------------------------------------------------------


def test_normc_gives_every_output_the_norm_one_and_the_last_layer_a_hundredth():
    generator = torch.Generator().manual_seed(0)
    net = mlp([7, 64, 64, 3], generator)
    normalize_columns(net.layers, 0.01, generator)
    for layer, norm in zip(net.layers, (1, 1, 0.01), strict=True):
        torch.testing.assert_close(layer.weight.norm(dim=1), torch.full((layer.out_features,), float(norm)))
        assert not layer.bias.any()


def test_a_skill_layer_lets_a_norm_of_one_through_for_every_skill():
    generator = torch.Generator().manual_seed(0)
    layer = SkillLinear(20, 6, 500, "bilinear", generator)
    normalize_columns([layer, nn.Linear(500, 2)], 0.01, generator)
    weight, bias = (x.detach() for x in layer.effective())
    norms = torch.cat([weight, bias.unsqueeze(-1)], -1).square().sum(-1)  # (Z, H)
    assert float(norms.mean().sqrt()) == pytest.approx(1, abs=0.01)


# --- minibatches ------------------------------------------------------------------------------------------------------


def test_minibatch_steps_equal_torchs_own_autograd_and_adam_in_float64():
    """Both levels and both baselines of a hierarchy, against a plain loop over what `levels` defines by autograd."""
    config = hippo_config(updates=2, entropy_weight=0.01, max_gradient_norm=0.3)

    def make():
        generator = torch.Generator().manual_seed(0)
        policy = HierarchicalPolicy(config, 2, 2, 2, generator)
        baselines = Baselines(config, 2, generator, in_loop=True)
        batch = collect(policy, TargetEnv(20, 0, death_rate=0.02), config, 0, 0)
        batch.steps.scale_rewards(baselines.reward_scale, config.gamma)
        estimate = advantages(batch, baselines, config)
        policy.double(), baselines.double()
        batch.steps.obs, batch.steps.action, batch.time_left = (
            x.double() for x in (batch.steps.obs, batch.steps.action, batch.time_left)
        )
        parameters = [*policy.parameters(), *baselines.parameters()]
        return policy, baselines, batch, estimate, parameters

    policy, baselines, batch, estimate, ours = make()
    objective = levels(policy, batch, estimate.manager, estimate.skills)
    critics = baselines.critics(batch, estimate.returns)
    improve(config, objective, critics, make_optimizer(config, ours), None, 400, 0, 0)

    def plain(epochs=2, clip=0.2, norm=0.3, entropy=0.01):
        policy, baselines, batch, estimate, parameters = make()
        manager, skill = levels(policy, batch, estimate.manager, estimate.skills)
        rows_of = rows_by_skill(batch)
        obs, time_left, active = (
            x[:-1].flatten(0, 1)[rows_of] for x in (batch.steps.obs, batch.time_left, batch.skill)
        )
        where = batch.is_decision[:-1].flatten()
        seen = policy.manager_input(batch.steps.obs[:-1].flatten(0, 1), batch.time_left[:-1].flatten())[where]
        adam = torch.optim.Adam(parameters, lr=config.learning_rate, eps=1e-5)
        with torch.no_grad():
            old = [level.log_prob(slice(None)) for level in (manager, skill)]
        generator = seeding.torch_generator(0, "minibatches", 0)
        for rows in minibatches(400, 8, epochs, generator):
            decided = manager.at[rows][manager.at[rows] >= 0]
            loss = -entropy * gaussian_entropy(policy.skills.log_std()[0])
            log_probs = policy.manager.log_probs(seen[decided])
            loss = loss + entropy * (log_probs.exp() * log_probs).sum(-1).mean()
            for level, before, own in ((manager, old[0], decided), (skill, old[1], rows)):
                ratio = (level.log_prob(own) - before[own]).exp()
                loss = (
                    loss
                    - torch.min(
                        ratio * level.advantage[own], ratio.clamp(1 - clip, 1 + clip) * level.advantage[own]
                    ).mean()
                )
            for kind, target in estimate.returns.items():
                x = baselines.inputs(kind, obs[rows], time_left[rows], active[rows])
                error = getattr(baselines, kind).output(*x) - target.flatten()[rows_of][rows]
                loss = loss + 0.5 * error.square().mean()
            adam.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(parameters, norm)
            adam.step()
        return parameters

    for mine, theirs in zip(ours, plain(), strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-7, atol=1e-9)
    for wrong in ({"epochs": 1}, {"clip": 0.1}, {"norm": 10.0}, {"entropy": 0.0}):
        assert any(not torch.allclose(a, b, rtol=1e-4) for a, b in zip(ours, plain(**wrong), strict=True))


def test_passes_stop_where_the_policy_has_gone_far_enough(tmp_path):
    def trained(name, **settings):
        run(hippo.train, hippo_config(**settings), tmp_path / name)
        return (tmp_path / name / "progress.csv").read_bytes()

    one, all_five = trained("one", updates=1), trained("all five", updates=5)
    assert trained("stopped", updates=5, target_kl=1e-12) == one  # every pass goes further than that
    assert trained("never", updates=5, target_kl=1e9) == all_five != one
    with pytest.raises(ConfigError, match=r"target_kl=0\.1: needs minibatches"):
        hippo_config(target_kl=0.1, minibatch_size=0, value_loss_weight=0.0, max_gradient_norm=0.0)


def test_a_minibatch_holds_the_steps_of_the_skills_and_the_decisions_made_in_them():
    config = hippo_config()
    policy = HierarchicalPolicy(config, 2, 2, 2, torch.Generator().manual_seed(0))
    batch = collect(policy, TargetEnv(20, 0, death_rate=0.02), config, 0, 0)
    # An advantage that names its step: row t N + n.
    name = torch.arange(400, dtype=torch.float64).view(20, 20)
    manager, skill = levels(policy, batch, name, name)
    rows = rows_by_skill(batch)
    assert torch.equal(skill.advantage.long(), rows)
    assert bool((batch.skill[:-1].flatten()[rows].diff() >= 0).all())
    is_decision = batch.is_decision[:-1].flatten()[rows]
    assert torch.equal(manager.at >= 0, is_decision)
    assert torch.equal(manager.advantage[manager.at[is_decision]].long(), rows[is_decision])


def test_values_trained_in_the_loop_are_never_fitted_and_predict_what_the_optimiser_made(tmp_path):
    config = hippo_config()
    generator = torch.Generator().manual_seed(0)
    policy = HierarchicalPolicy(config, 2, 2, 2, generator)
    baselines = Baselines(config, 2, generator, in_loop=True)
    optimizer = make_optimizer(config, [*policy.parameters(), *baselines.parameters()])
    before = copy.deepcopy(baselines.state_dict())
    batch = collect(policy, TargetEnv(20, 0), config, 0, 0)
    batch.steps.scale_rewards(baselines.reward_scale, config.gamma)
    estimate = advantages(batch, baselines, config)
    objective = levels(policy, batch, estimate.manager, estimate.skills)

    def errors():
        columns = [x[:-1] for x in (batch.steps.obs, batch.time_left, batch.skill)]
        return [
            float((baselines.predict(kind, *columns) - target).square().mean())
            for kind, target in estimate.returns.items()
        ]

    first = errors()
    improve(config, objective, baselines.critics(batch, estimate.returns), optimizer, None, 400, 0, 0)
    assert all(now < 0.9 * then for now, then in zip(errors(), first, strict=True))
    for name in ("single.inputs.mean", "skill.inputs.mean", "skill.target.scale"):
        assert torch.equal(baselines.state_dict()[name], before[name])


# --- bad input --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["protocol=moden"], "protocol=moden: did you mean modern? valid: modern, paper"),
        (["protocol=modern", "algo.minibatch_size=9000", "scale=laptop"], "algo.minibatch_size=9000: must be at most"),
        (["algo.value_loss_weight=0.5"], "algo.value_loss_weight=0.5: needs minibatches: set minibatch_size"),
        (["algo.max_gradient_norm=0.5"], "algo.max_gradient_norm=0.5: needs minibatches: set minibatch_size"),
        (["protocol=modern", "algo.skills=pretrained"], "algo.skills=pretrained: is a file of skills that see"),
    ],
)
def test_what_does_not_go_together_is_refused_by_name(overrides, message):
    with pytest.raises(ConfigError) as error:
        compose_run(overrides)
    assert str(error.value).startswith(message)


def test_a_checkpoint_without_its_statistics_or_of_the_other_protocol_is_refused_in_one_line(tmp_path, capsys):
    config = hippo_config()
    run(hippo.train, config, tmp_path)
    content = load(tmp_path / "checkpoint.pt")
    without = {key: value for key, value in content["policy"].items() if not key.startswith("filter.")}
    save(tmp_path / "checkpoint.pt", content | {"policy": without})
    with pytest.raises(CheckpointError, match=r"not of this run's settings: policy: .*filter\.count"):
        restored(config, TargetEnv(1, 0), Checkpoint(tmp_path))
    save(tmp_path / "checkpoint.pt", content)
    paper = hippo.HippoConfig(**BUDGET, num_skills=3, period_min=2, period_max=6)
    with pytest.raises(CheckpointError, match=r"not of this run's settings: policy: .*filter\.count"):
        restored(paper, TargetEnv(1, 0), Checkpoint(tmp_path))
    made = compose_run(["protocol=modern", "scale=smoke", f"runs_dir={tmp_path}"])
    made.folder.mkdir()
    (made.folder / "config.yaml").write_text(made.to_yaml())
    save(made.folder / "checkpoint.pt", content)
    assert evaluate_main([str(made.folder)]) == 2
    printed = capsys.readouterr().err
    assert printed.count("\n") == 1
    assert "not of this run's settings" in printed


# --- the protocol -----------------------------------------------------------------------------------------------------


def test_the_protocol_sets_every_learner_alike_and_is_part_of_the_identity():
    shared = ("initialisation", "normalize_observations", "scale_rewards", "gae_lambda", "bootstrap_horizon")
    modern = {algo: compose_run([f"algo={algo}", "protocol=modern"]) for algo in ("hippo", "ppo", "hier_vpg", "mlsh")}
    assert len({tuple(getattr(r.config, key) for key in shared) for r in modern.values()}) == 1
    assert all(r.identity["protocol"] == "modern" for r in modern.values())
    assert {r.config.iterations * r.config.batch_size for r in modern.values()} == {50_000_000}
    paper = compose_run(["algo=ppo"])
    assert "protocol" not in paper.identity
    assert compose_run(["algo=hiro", "protocol=modern"]).run_id == compose_run(["algo=hiro"]).run_id
    assert compose_run(["algo=ppo", "protocol=modern", "algo.gae_lambda=0.9"]).config.gae_lambda == 0.9
