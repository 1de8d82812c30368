"""What SNN4HRL and DIAYN share: one skill per path, exact resumption, and skills that a hierarchy takes as they are."""

import numpy as np
import pytest
import torch

from baselines import diayn, snn
from hippo.core import hierarchy
from hippo.core.checkpoint import Checkpoint, load
from hippo.core.policies import SkillPolicy
from hippo.core.pretraining import collect
from hippo.core.settings import ConfigError
from hippo.core.skills import load_skills, save_skills
from hippo.hippo import HippoConfig
from tests.baselines.roam import RoamEnv, make_envs, roam
from tests.hippo.toy import progress

SMALL = {"iterations": 4, "batch_size": 200, "horizon": 20, "num_skills": 3, "skill_hidden_sizes": [16, 16]}
METHODS = {"snn": (snn, snn.SNNConfig), "diayn": (diayn, diayn.DIAYNConfig)}
methods = pytest.mark.parametrize("name", METHODS)


def a_policy(num_skills=3):
    return SkillPolicy(3, num_skills, 2, [16, 16], torch.Generator().manual_seed(0))


def test_a_skill_is_kept_to_the_end_of_its_path_and_drawn_uniformly_for_the_next():
    config = snn.SNNConfig(iterations=1, batch_size=16000, horizon=40, num_skills=4)
    paths = collect(a_policy(4), RoamEnv(400, 0, horizon=40, death_rate=0.05), config, 0, 0)
    done, skill = paths.steps.done, paths.skill
    assert bool(done[:-1].any())
    assert torch.equal(skill[1:][~done], skill[:-1][~done])
    after_end = (skill[1:] != skill[:-1])[done].double().mean()
    assert abs(float(after_end) - 3 / 4) < 0.05  # another one in 3 of 4 cases
    usage = torch.bincount(torch.cat([skill[0], skill[1:][done]]), minlength=4).double()
    entropy = -(usage / usage.sum() * (usage / usage.sum()).log()).sum()
    assert abs(float(entropy) - np.log(4)) < 0.01


def test_what_follows_the_last_step_of_a_path_is_its_own_last_state_not_the_next_paths_first():
    config = snn.SNNConfig(iterations=1, batch_size=2000, horizon=40, num_skills=3)
    paths = collect(a_policy(), RoamEnv(50, 0, horizon=40, death_rate=0.1), config, 0, 0)
    steps = paths.steps
    velocity = steps.action.clamp(-1, 1)
    assert torch.equal(paths.next_obs[..., 1:], velocity)
    assert not torch.equal(steps.obs[1:, :, 1:], velocity)  # rows after an end hold the new path's first state
    torch.testing.assert_close(
        paths.next_position[..., :2], paths.position[:-1, :, :2] + 0.1 * velocity.double(), rtol=0, atol=1e-12
    )
    begun = paths.position.gather(0, paths.start.unsqueeze(-1).expand(-1, -1, 3))
    assert not begun.any()  # every path starts in the origin
    assert bool(
        (paths.start[1:][steps.done[:-1]] == torch.arange(1, 40).unsqueeze(1).expand(-1, 50)[steps.done[:-1]]).all()
    )


@methods
def test_the_same_seed_gives_the_same_bytes_and_another_seed_does_not(name, tmp_path):
    module, config = METHODS[name]
    for folder, seed in (("a", 0), ("b", 0), ("c", 1)):
        roam(module.train, config(**SMALL), tmp_path / folder, seed, death_rate=0.02)
    a, b, c = ((tmp_path / folder / "progress.csv").read_bytes() for folder in "abc")
    assert a == b
    assert a != c


@methods
def test_an_interrupted_run_ends_at_the_same_bytes(name, tmp_path):
    module, config = METHODS[name]
    roam(module.train, config(**SMALL), tmp_path / "whole", death_rate=0.02)
    for iterations in (2, 4):
        roam(module.train, config(**SMALL | {"iterations": iterations}), tmp_path / "cut", death_rate=0.02)
    for file in ("progress.csv", "checkpoint.pt"):
        assert (tmp_path / "cut" / file).read_bytes() == (tmp_path / "whole" / file).read_bytes()


@methods
@pytest.mark.parametrize("period_max", [5, 8])
def test_the_trained_skills_are_the_hierarchys_own_network_and_load_from_their_file(name, period_max, tmp_path):
    module, config = METHODS[name]
    roam(module.train, config(**SMALL), tmp_path)
    policy, metadata = module.skills(config(**SMALL), make_envs(config(**SMALL)), Checkpoint(tmp_path))
    trained = load(tmp_path / "checkpoint.pt")["policy"]
    assert all(torch.equal(tensor, trained[key]) for key, tensor in policy.state_dict().items())
    assert metadata["env_steps"] == 4 * 200
    save_skills(tmp_path / "skills.pt", policy, metadata | {"run_id": "0123456789ab"})
    settings = {key: SMALL[key] for key in ("num_skills", "skill_hidden_sizes")}
    hippo = HippoConfig(iterations=1, batch_size=20, horizon=20, period_min=5, period_max=period_max, **settings)
    given = hierarchy.HierarchicalPolicy(hippo, 5, 3, 2, torch.Generator().manual_seed(1)).skills
    load_skills(tmp_path / "skills.pt", given, "roamer", "paper")
    assert torch.equal(given.log_std(), policy.log_std())
    obs = torch.randn(10, 3, generator=torch.Generator().manual_seed(2))
    seen = torch.cat([obs, torch.rand(10, 1)], 1) if period_max > 5 else obs
    torch.testing.assert_close(given.means(seen), policy.means(obs), rtol=1e-6, atol=1e-7)


@methods
def test_a_batch_shorter_than_a_path_is_refused(name):
    with pytest.raises(ConfigError, match="batch_size=19: must be at least one horizon, 20 steps"):
        METHODS[name][1](iterations=1, batch_size=19, horizon=20)


def test_skills_that_cannot_be_told_apart_learn_to_be_told_apart_by_either_method(tmp_path):
    settings = SMALL | {"iterations": 40, "batch_size": 2000}
    roam(snn.train, snn.SNNConfig(**settings), tmp_path / "snn")
    information = progress(tmp_path / "snn")["mutual_information"]
    assert information[-1] > max(0.7, information[0] + 0.3)  # of at most log 3 = 1.10
    roam(diayn.train, diayn.DIAYNConfig(**settings, discriminator_epochs=4), tmp_path / "diayn")
    accuracy = progress(tmp_path / "diayn")["discriminator_accuracy"]
    assert accuracy[0] < 0.5
    assert accuracy[-1] > 0.8
