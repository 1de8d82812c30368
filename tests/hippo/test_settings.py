"""Config fields reject what cannot work and name it; random streams are independent of each other."""

import numpy as np
import pytest
import torch

from baselines.ppo import PPOConfig
from hippo.core import seeding
from hippo.core.settings import ConfigError
from hippo.hippo import HippoConfig

BUDGET = {"iterations": 1, "batch_size": 100, "horizon": 50}


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("learning_rate", -1.0),
        ("learning_rate", 0.0),
        ("learning_rate", float("nan")),
        ("clip_range", 0.0),
        ("gamma", 1.5),
        ("gae_lambda", -0.1),
        ("num_skills", 0),
        ("period_min", 0),
        ("skill_baseline", "double"),
        ("manager_baseline", "skill"),
        ("skill_hidden_sizes", [64, 0]),
        ("skill_hidden_sizes", []),
        ("minibatch_size", 101),
        ("iterations", 0),
        ("batch_size", 49),
        ("period_min", 16),
        ("truncate_to_period", True),
    ],
)
def test_a_bad_hippo_setting_is_refused_by_name(key, value):
    with pytest.raises(ConfigError, match=key):
        HippoConfig(**{**BUDGET, key: value})


def test_both_levels_frozen_is_refused():
    with pytest.raises(ConfigError, match="train_manager"):
        HippoConfig(**BUDGET, train_manager=False, train_skills=False)


@pytest.mark.parametrize(("key", "value"), [("action_repeat", 0), ("action_repeat", 51), ("updates", 0)])
def test_a_bad_ppo_setting_is_refused_by_name(key, value):
    with pytest.raises(ConfigError, match=key):
        PPOConfig(**{**BUDGET, key: value})


def test_the_batch_is_whole_horizons():
    # Paper: Ant 20, Snake 13 (104 000 steps), Block 50.
    for batch, horizon, expected in ((100_000, 5000, 20), (100_000, 8000, 13), (50_000, 1000, 50)):
        assert HippoConfig(iterations=1, batch_size=batch, horizon=horizon).num_envs == expected


def test_streams_repeat_by_name_and_differ_by_seed_purpose_and_index():
    draw = lambda *name: tuple(seeding.numpy_generator(*name).integers(2**62, size=2))  # noqa: E731
    assert draw(1, "policy", 0) == draw(1, "policy", 0)
    assert len({draw(1, "policy", 0), draw(2, "policy", 0), draw(1, "manager", 0), draw(1, "policy", 1)}) == 4
    assert seeding.integer(1, "policy") < 2**63
    first, second = (torch.rand(3, generator=seeding.torch_generator(1, name)) for name in ("a", "b"))
    assert not torch.equal(first, second)
    assert np.array_equal(seeding.stream(5, "a").generate_state(2), seeding.stream(5, "a").generate_state(2))
