"""Skills files: what is loaded is bit-equal to what was saved, and what does not fit is refused by name."""

import pytest
import torch

from baselines import hier_vpg
from hippo import hippo
from hippo.core import checkpoint, seeding
from hippo.core.checkpoint import Checkpoint, load
from hippo.core.hierarchy import HierarchicalPolicy
from hippo.core.optimizers import Adam
from hippo.core.policies import SkillPolicy
from hippo.core.skills import METADATA, SkillsError, load_skills, network_of, policy_of, read_skills, save_skills
from tests.hippo.toy import run

ABOUT = {
    "robot": "toy",
    "observation": "paper",
    "env": "toy",
    "algo": "snn",
    "run_id": "0123456789ab",
    "env_steps": 1000,
    "physics": "paper",
}


def network(seed=0, obs_size=5, num_skills=3, action_size=2, hidden_sizes=(8, 6), **options):
    policy = SkillPolicy(
        obs_size, num_skills, action_size, list(hidden_sizes), torch.Generator().manual_seed(seed), **options
    )
    with torch.no_grad():
        policy.log_std_parameter.normal_(generator=torch.Generator().manual_seed(seed + 1))
        policy.first.bias.normal_(generator=torch.Generator().manual_seed(seed + 2))
    return policy


@pytest.fixture
def file(tmp_path):
    save_skills(tmp_path / "skills.pt", network(), ABOUT)
    return tmp_path / "skills.pt"


@pytest.mark.parametrize("integration", ["bilinear", "concatenate"])
@pytest.mark.parametrize("per_skill", [False, True])
def test_means_and_log_std_of_every_skill_are_bit_equal_after_loading(integration, per_skill, tmp_path):
    options = {"integration": integration, "log_std_per_skill": per_skill}
    source, target = network(0, **options), network(7, **options)
    save_skills(tmp_path / "s.pt", source, ABOUT)
    obs = torch.randn(50, 5, generator=torch.Generator().manual_seed(3))
    assert not torch.equal(target.means(obs), source.means(obs))
    metadata = load_skills(tmp_path / "s.pt", target, "toy", "paper")
    assert torch.equal(target.means(obs), source.means(obs))
    assert torch.equal(target.log_std(), source.log_std())
    assert metadata == ABOUT | network_of(source) | {"obs_size": 5}
    assert set(metadata) == set(METADATA)
    again, _ = policy_of(tmp_path / "s.pt")
    assert torch.equal(again.means(obs), source.means(obs))


@pytest.mark.parametrize("integration", ["bilinear", "concatenate"])
def test_a_policy_that_sees_the_time_left_has_the_same_outputs_whatever_the_time(integration, tmp_path):
    source = network(0, integration=integration).double()
    target = network(7, obs_size=6, integration=integration).double()
    save_skills(tmp_path / "s.pt", source, ABOUT)
    obs = torch.randn(50, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(3))

    def means(time_left):
        return target.means(torch.cat([obs, torch.full((50, 1), time_left, dtype=torch.float64)], 1))

    assert not torch.allclose(means(0.1), means(1.0))  # before: the time matters
    load_skills(tmp_path / "s.pt", target, "toy", "paper")
    for time_left in (0.1, 1.0):
        torch.testing.assert_close(means(time_left), source.means(obs), rtol=1e-13, atol=1e-13)
    assert torch.equal(means(0.1), means(1.0))
    # The new weights are learnt like any other.
    means(0.5).square().sum().backward()
    assert (target.first.weight.grad[:, 5] != 0).any()


def test_zero_columns_appended_at_the_end_would_have_changed_the_outputs(tmp_path):
    source, target = network(0).double(), network(7, obs_size=6).double()
    wrong = torch.cat([source.first.weight, torch.zeros(8, 4, dtype=torch.float64)], 1)
    target.load_state_dict(source.state_dict() | {"first.weight": wrong})
    obs = torch.randn(9, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    seen = torch.cat([obs, torch.ones(9, 1, dtype=torch.float64)], 1)
    assert not torch.allclose(target.means(seen), source.means(obs))


@pytest.mark.parametrize(
    ("wanted", "robot", "observation", "message"),
    [
        ({}, "ant", "paper", "its robot is toy, the policy's ant"),
        ({}, "toy", "ego", "its observation is paper, the policy's ego"),
        ({"num_skills": 2}, "toy", "paper", "its num_skills is 3, the policy's 2"),
        ({"num_skills": 4}, "toy", "paper", "its num_skills is 3, the policy's 4"),
        ({"hidden_sizes": (8, 7)}, "toy", "paper", r"its hidden_sizes is \[8, 6\], the policy's \[8, 7\]"),
        ({"hidden_sizes": (8,)}, "toy", "paper", r"its hidden_sizes is \[8, 6\], the policy's \[8\]"),
        ({"integration": "concatenate"}, "toy", "paper", "its integration is bilinear, the policy's concatenate"),
        ({"log_std_per_skill": True}, "toy", "paper", "its log_std_per_skill is False, the policy's True"),
        ({"action_size": 3}, "toy", "paper", "its action_size is 2, the policy's 3"),
        ({"obs_size": 4}, "toy", "paper", "its obs_size is 5, the policy's 4"),
        ({"obs_size": 7}, "toy", "paper", "its obs_size is 5, the policy's 7"),
    ],
)
def test_skills_that_do_not_fit_are_refused_by_name_and_the_policy_stays(wanted, robot, observation, message, file):
    target = network(7, **wanted)
    before = {name: tensor.clone() for name, tensor in target.state_dict().items()}
    with pytest.raises(SkillsError, match=message):
        load_skills(file, target, robot, observation)
    for name, tensor in target.state_dict().items():
        assert torch.equal(tensor, before[name])


def test_damaged_missing_and_foreign_files_are_refused_by_name(file, tmp_path):
    content = file.read_bytes()
    altered = bytearray(content)
    altered[len(altered) // 2] ^= 1
    checkpoint.save(tmp_path / "foreign.pt", {"iteration": 3})
    for name, data, message in (
        ("cut.pt", content[: len(content) // 2], "does not match its digest"),
        ("stump.pt", content[:20], "cut short"),
        ("altered.pt", bytes(altered), "does not match its digest"),
        ("foreign.pt", (tmp_path / "foreign.pt").read_bytes(), "not a skills file, it has no 'metadata'"),
        ("missing.pt", None, "No such file"),
    ):
        if data is not None:
            (tmp_path / name).write_bytes(data)
        with pytest.raises(SkillsError, match=message) as error:
            read_skills(tmp_path / name)
        assert str(error.value).startswith(f"skills={tmp_path / name}: ")


def test_metadata_without_an_entry_is_not_written(tmp_path):
    with pytest.raises(SkillsError, match="run_id: missing"):
        save_skills(tmp_path / "s.pt", network(), {k: v for k, v in ABOUT.items() if k != "run_id"})
    assert not list(tmp_path.iterdir())


SMALL = {"iterations": 1, "batch_size": 200, "horizon": 20, "num_skills": 3}
ALGORITHMS = {"hippo": (hippo.train, hippo.HippoConfig), "hier_vpg": (hier_vpg.train, hier_vpg.HierVPGConfig)}


@pytest.mark.parametrize("name", ALGORITHMS)
@pytest.mark.parametrize("period_max", [5, 8])
def test_training_starts_from_the_skills_of_the_file(name, period_max, tmp_path, monkeypatch):
    source = network(0, obs_size=2, hidden_sizes=(64, 64))
    save_skills(tmp_path / "s.pt", source, ABOUT)
    train, config = ALGORITHMS[name]
    monkeypatch.setattr(Adam, "step", lambda self, *arguments: None)  # what training starts from
    settings = {"period_min": 5, "period_max": period_max, "skills": str(tmp_path / "s.pt")}
    run(train, config(**SMALL, **settings), tmp_path / "run")
    tensors = load(tmp_path / "run/checkpoint.pt")["policy"]
    assert torch.equal(tensors["skills.log_std_parameter"], source.log_std_parameter)
    weight, time_columns = tensors["skills.first.weight"], period_max > 5
    assert torch.equal(weight[:, :2], source.first.weight[:, :2])
    assert weight.shape[1] == source.first.weight.shape[1] + 4 * time_columns
    # The manager is the one that would have been drawn without the file.
    fresh = HierarchicalPolicy(
        config(**SMALL, **settings | {"skills": ""}), 2, 2, 2, seeding.torch_generator(0, "initialisation")
    )
    assert torch.equal(tensors["manager.logits.0.weight"], fresh.manager.logits[0].weight)


def test_a_resumed_run_keeps_what_it_learnt_instead_of_the_file(tmp_path):
    save_skills(tmp_path / "s.pt", network(0, obs_size=2, hidden_sizes=(64, 64)), ABOUT)
    given = {"skills": str(tmp_path / "s.pt")}
    run(hippo.train, hippo.HippoConfig(**SMALL | {"iterations": 2}, **given), tmp_path / "whole")
    for iterations in (1, 2):
        run(hippo.train, hippo.HippoConfig(**SMALL | {"iterations": iterations}, **given), tmp_path / "resumed")
    whole, resumed = ((tmp_path / folder / "checkpoint.pt").read_bytes() for folder in ("whole", "resumed"))
    assert whole == resumed


def test_training_refuses_skills_of_another_robot(tmp_path):
    save_skills(tmp_path / "s.pt", network(0, obs_size=2, hidden_sizes=(64, 64)), ABOUT | {"robot": "ant"})
    with pytest.raises(SkillsError, match="its robot is ant, the policy's toy"):
        run(hippo.train, hippo.HippoConfig(**SMALL, skills=str(tmp_path / "s.pt")), tmp_path / "run")
    assert Checkpoint(tmp_path / "run").load() is None


@pytest.mark.parametrize("frozen", ["manager", "skill"])
def test_given_skills_that_are_frozen_stay_the_files_and_the_other_level_moves(frozen, tmp_path):
    source = network(0, obs_size=2, hidden_sizes=(64, 64))
    save_skills(tmp_path / "s.pt", source, ABOUT)
    flags = {"train_manager": frozen != "manager", "train_skills": frozen != "skill"}
    settings = SMALL | {"iterations": 3, "period_min": 5, "period_max": 5, "skills": str(tmp_path / "s.pt")} | flags
    run(hippo.train, hippo.HippoConfig(**settings), tmp_path / "run")
    tensors = load(tmp_path / "run/checkpoint.pt")["policy"]
    same = [torch.equal(tensors[f"skills.{name}"], tensor) for name, tensor in source.state_dict().items()]
    assert all(same) if frozen == "skill" else not any(same)
