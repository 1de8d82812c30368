"""What each method gets: the committed page is what plans and settings say, and gradient steps are those taken."""

from collections import Counter
from types import SimpleNamespace

import pytest

from baselines import mlsh, option_critic, ppo
from experiments.artefacts import fairness
from experiments.config import compose_run
from hippo import hippo
from hippo.core.optimizers import Adam
from tests.hippo.toy import run


def test_the_committed_page_is_fresh():
    assert fairness.PAGE.read_text() == fairness.page(), "run `python -m experiments.artefacts.fairness`"


def test_what_is_unequal_and_has_no_reason_is_an_error(monkeypatch):
    row = dict.fromkeys(fairness.COLUMNS, "1")
    assert fairness.reasons("hiro", "hiro", row | {"steps": "2"}, row) == (
        "steps: its published budget; verdicts are drawn at its own steps, too"
    )
    with pytest.raises(ValueError, match="hippo_p1: view '2' is not '1', and REASONS has no reason"):
        fairness.reasons("hippo_p1", "hippo", row | {"view": "2"}, row)


SMALL = {"iterations": 7, "batch_size": 120, "horizon": 40, "num_skills": 2}


@pytest.mark.parametrize(
    ("algo", "module", "config", "rates"),
    [
        ("hippo", hippo, hippo.HippoConfig(**SMALL, learning_rate=1e-5), {"": 1e-5}),
        ("hippo", hippo, hippo.HippoConfig(**SMALL, learning_rate=1e-5, minibatch_size=50), {"": 1e-5}),
        ("ppo", ppo, ppo.PPOConfig(iterations=3, batch_size=120, horizon=40, learning_rate=1e-5), {"": 1e-5}),
        (
            "mlsh",
            mlsh,
            mlsh.MLSHConfig(
                **SMALL,
                warmup_iterations=1,
                joint_iterations=2,
                manager_minibatch_size=4,
                skill_minibatches=3,
                manager_learning_rate=1e-5,
                skill_learning_rate=2e-5,
            ),
            {"manager": 1e-5, "skills": 2e-5},
        ),
        (
            "option_critic",
            option_critic,
            option_critic.OptionCriticConfig(**SMALL, learning_rate=1e-5, steps_per_update=50),
            {"options": 1e-5},
        ),
    ],
)
def test_gradient_steps_are_those_that_a_run_takes(algo, module, config, rates, tmp_path, monkeypatch):
    taken, step = Counter(), Adam.step

    def counted(self, *arguments):
        taken[self.param_groups[0]["lr"]] += 1
        return step(self, *arguments)

    monkeypatch.setattr(Adam, "step", counted)
    run(module.train, config, tmp_path)
    steps = fairness.gradient_steps(SimpleNamespace(algo=algo, config=config))
    assert steps == {level: taken[rate] for level, rate in rates.items()}


def test_hiros_steps_follow_its_budget_and_only_what_acts_is_counted():
    run_ = compose_run(["env=ant_gather", "algo=hiro"])
    assert fairness.gradient_steps(run_) == {"lower level": 9_997_500, "manager": 999_750}
    inputs, goals, actions = 47, 13, 8

    def actor(first, last):
        return (first + 1) * 300 + 301 * 300 + 301 * last

    assert fairness.acting_parameters(run_) == actor(inputs + goals, actions) + actor(inputs, goals)
