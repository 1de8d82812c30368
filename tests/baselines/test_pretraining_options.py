"""Two settings of pre-training, both off by default: time in V(s, z), advantages standardised skill by skill."""

from types import SimpleNamespace

import pytest
import torch

from baselines import snn
from experiments.config import compose_run
from hippo.core import pretraining
from hippo.core.checkpoint import Checkpoint
from hippo.core.log import RunLog
from hippo.core.ppo import maximize
from tests.baselines.roam import RoamEnv
from tests.hippo.toy import progress


def test_the_share_of_a_path_that_has_passed_worked_by_hand():
    # Four rows, two environments; the second's path ends with its second step, and the next one with the fourth.
    start = torch.tensor([[0, 0], [0, 0], [0, 2], [0, 2]])
    done = torch.tensor([[False, False], [False, True], [False, False], [False, True]])
    passed = pretraining.share_passed(SimpleNamespace(start=start, steps=SimpleNamespace(done=done)))
    assert passed.T.tolist() == [[0, 0.25, 0.5, 0.75, 1.0], [0, 0.25, 0, 0.25, 0]]


class Constant:
    """Pays 1 for every step, so that what is still to come depends on the time alone."""

    parts = {}  # noqa: RUF012

    def reward(self, paths, policy):
        return torch.ones(paths.steps.done.shape, dtype=torch.float64), {}

    def learn(self, paths, seed, iteration):
        pass


def explained(folder, sees_time):
    small = {"horizon": 20, "num_skills": 3, "skill_hidden_sizes": [16, 16], "bootstrap_horizon": False}
    config = snn.SNNConfig(iterations=8, batch_size=400, value_sees_time=sees_time, gae_lambda=1.0, **small)
    envs = RoamEnv(config.num_envs, 0, horizon=config.horizon)
    pretraining.train_skills(config, envs, Constant(), RunLog(folder), 0, Checkpoint(folder))
    return progress(folder)["skill_explained_variance"][-1]


def test_a_value_that_sees_the_time_knows_what_is_still_to_come_and_one_that_does_not_cannot(tmp_path):
    assert explained(tmp_path / "with", True) > 0.95
    assert explained(tmp_path / "without", False) < 0.7


@pytest.mark.parametrize("per_skill", [True, False])
def test_advantages_are_standardised_over_the_steps_of_each_skill_or_over_all(per_skill, tmp_path, monkeypatch):
    config = snn.SNNConfig(
        iterations=1,
        batch_size=400,
        horizon=20,
        num_skills=3,
        skill_hidden_sizes=[16, 16],
        standardize_per_skill=per_skill,
    )
    seen = []

    def watched(levels, *arguments):
        seen.append(levels[0].advantage)
        return maximize(levels, *arguments)

    monkeypatch.setattr(pretraining, "maximize", watched)

    class Unequal(Constant):
        def reward(self, paths, policy):  # skill 2 earns a hundred times what skill 0 does
            torch.manual_seed(0)
            noise = torch.rand(paths.steps.done.shape, dtype=torch.float64)
            return noise * 10.0 ** paths.skill[:-1], {}

    envs = RoamEnv(config.num_envs, 0, horizon=config.horizon)
    counts = []
    collect = pretraining.collect

    def counted(*arguments):
        paths = collect(*arguments)
        counts.extend(torch.bincount(paths.skill[:-1].flatten(), minlength=3).tolist())
        return paths

    monkeypatch.setattr(pretraining, "collect", counted)
    pretraining.train_skills(config, envs, Unequal(), RunLog(tmp_path), 0, Checkpoint(tmp_path))
    parts = seen[0].double().split(counts)
    spreads = [float(part.std(correction=0)) for part in parts]
    means = [float(part.mean()) for part in parts]
    if per_skill:
        assert spreads == pytest.approx([1.0, 1.0, 1.0], abs=1e-4)
        assert means == pytest.approx([0.0, 0.0, 0.0], abs=1e-4)
    else:
        assert spreads[0] < 0.1 * spreads[2]
        assert abs(means[0]) > 0.1


def test_both_are_off_and_so_in_no_id():
    identity = compose_run(["env=ant", "algo=snn", "scale=laptop"]).identity
    assert identity["settings"] == {}
    changed = compose_run(["env=ant", "algo=snn", "scale=laptop", "algo.value_sees_time=true"])
    assert changed.identity["settings"] == {"value_sees_time": True}
