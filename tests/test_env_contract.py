"""What every environment, under every id and option, must keep: the contract with learners and with Gymnasium."""

import itertools
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from hippo.envs import ENVIRONMENTS, gymnasium_id, make

# Every environment as it is and with each of its option values that is not the default, one at a time.
VARIANTS = [(name, {}) for name in ENVIRONMENTS] + [
    (name, {option: value} | ({"strength": "all"} if option == "perturbation" else {}))
    for name, environment in ENVIRONMENTS.items()
    for option, values in environment.options.items()
    for value in values[1:]
    if option != "strength"
]
IDS = ["-".join([name, *(f"{k}={v}" for k, v in options.items())]) for name, options in VARIANTS]
every_variant = pytest.mark.parametrize(("name", "options"), VARIANTS, ids=IDS)
STEPS = 60
# Entries that cannot change within a short episode, and why.
CONSTANT = {
    "next_wall_length": "all walls are as long",
    "previous_wall_length": "all walls are as long",
    "previous_wall_height": "zero until the first wall is passed",
    "previous_wall_x": "zero until the first wall is passed",
    "previous_wall_distance": "zero until the first wall is passed",
    "next_wall_height": "of the same wall until it is passed",
    "next_wall_x": "of the same wall until it is passed",
    **{f"{kind}_{i}": "zero while nothing is in the bin" for kind in ("apple", "bomb") for i in range(10)},
}

# The direction in which a planar robot cannot move.
PLANAR = {"snake": "com_z", "hopper": "com_y", "half_cheetah": "com_y"}


def trajectory(envs, steps=STEPS, seed=3, columns=slice(None)):
    """Everything that a learner sees of `steps` steps under fixed actions; environment i takes the i-th's actions."""
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (steps, 32, envs.single_action_space.shape[0]))[:, columns]
    seen = [envs.reset(seed=seed)[0]]
    for action in actions[:, : envs.num_envs]:
        seen += list(envs.step(action)[:4])
    return seen


@every_variant
def test_gymnasiums_own_checker_has_nothing_to_say(name, options):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gym.make(gymnasium_id(name), **options).unwrapped
        check_env(env, skip_render_check=True)
        env.close()


@every_variant
def test_spaces_bounds_and_types(name, options):
    envs = make(name, 3, 0, **options)
    obs, _ = envs.reset(seed=0)
    assert np.isfinite(envs.single_observation_space.low).all()
    assert np.isfinite(envs.single_observation_space.high).all()
    assert len(envs.observation_names) == len(set(envs.observation_names)) == obs.shape[1]
    assert len(envs.observation_units) == obs.shape[1]
    for _ in range(5):
        obs, reward, terminated, truncated, info = envs.step(envs.action_space.sample())
        assert envs.observation_space.contains(obs)
        assert (obs.dtype, reward.dtype, terminated.dtype, truncated.dtype) == (np.float32, np.float64, bool, bool)
        assert {"diverged", "com"} <= set(info)
    assert 0 < envs.robot_size <= obs.shape[1]


@every_variant
def test_a_seed_decides_everything_and_resets_differ(name, options):
    one, other = make(name, 3, 0, **options), make(name, 3, 9, **options)
    first = trajectory(one)
    for a, b in zip(first, trajectory(other), strict=True):
        np.testing.assert_array_equal(a, b)
    assert not np.array_equal(first[0], one.reset()[0])
    assert not np.array_equal(first[0][0], first[0][1])


@every_variant
def test_threads_and_neighbours_change_nothing(name, options):
    many = trajectory(make(name, 32, 0, **options), steps=15)
    for a, b in zip(many, trajectory(make(name, 32, 0, num_threads=2, **options), steps=15), strict=True):
        np.testing.assert_array_equal(a, b)
    alone = trajectory(make(name, 1, 0, **options), steps=15, seed=3 + 17, columns=slice(17, 18))
    for a, b in zip(many, alone, strict=True):
        np.testing.assert_array_equal(a[17:18], b)


@every_variant
def test_no_observation_entry_is_constant_without_a_reason(name, options):
    envs = make(name, 8, 0, horizon=30, **options)
    observations = np.concatenate(trajectory(envs)[:1] + trajectory(envs)[1::4])
    spread = dict(zip(envs.observation_names, np.ptp(observations, axis=0), strict=True))
    assert {name for name, width in spread.items() if width == 0} <= CONSTANT.keys() | {PLANAR.get(envs.robot_name)}


@every_variant
def test_the_reward_is_the_sum_of_its_terms(name, options):
    envs = make(name, 8, 0, horizon=25, **options)
    envs.reset(seed=0)
    for _ in range(STEPS):
        _, reward, *_, info = envs.step(envs.action_space.sample())
        terms = [term for key, term in info.items() if key.startswith("reward_")]
        expected = np.sum(terms, 0) if terms else np.zeros(8)
        np.testing.assert_allclose(reward, expected - info.get("velocity_penalty", 0.0), rtol=0, atol=1e-12)


@every_variant
def test_final_obs_is_what_a_single_environment_would_have_shown(name, options):
    horizon = 10
    envs = make(name, 3, 0, horizon=horizon, **options)
    singles = [gym.make(gymnasium_id(name), horizon=horizon, **options).unwrapped for _ in range(3)]
    obs, _ = envs.reset(seed=5)
    alone = [single.reset(seed=5 + i)[0] for i, single in enumerate(singles)]
    rng = np.random.default_rng(1)
    for _ in range(horizon):
        np.testing.assert_array_equal(obs, alone)
        actions = rng.uniform(-1, 1, envs.action_space.shape)
        obs, reward, terminated, truncated, info = envs.step(actions)
        results = [single.step(action) for single, action in zip(singles, actions, strict=True)]
        alone = [result[0] for result in results]
        np.testing.assert_array_equal(reward, [result[1] for result in results])
        np.testing.assert_array_equal(terminated, [result[2] for result in results])
        np.testing.assert_array_equal(truncated, [result[3] for result in results])
        if (terminated | truncated).any():
            break
    ended = np.flatnonzero(info["_final_obs"])
    assert len(ended)
    for i in ended:
        np.testing.assert_array_equal(info["final_obs"][i], alone[i])
        assert not np.array_equal(obs[i], alone[i])


@every_variant
def test_returned_arrays_share_no_memory(name, options):
    envs = make(name, 4, 0, horizon=3, **options)
    results = [envs.reset(seed=0)]
    results += [envs.step(np.zeros(envs.action_space.shape)) for _ in range(5)]
    arrays = []
    for result in results:
        for part in result:
            arrays += [a for a in part.values() if isinstance(a, np.ndarray)] if isinstance(part, dict) else [part]
    shared = [1 for a, b in itertools.combinations(arrays, 2) if a is not b and np.may_share_memory(a, b)]
    assert not shared


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_the_version_of_an_id_counts_revisions(name):
    assert gymnasium_id(name).endswith(f"-v{ENVIRONMENTS[name].revision - 1}")
    assert gym.spec(gymnasium_id(name)).id == gymnasium_id(name)
    envs = gym.make_vec(gymnasium_id(name), num_envs=2)
    assert envs.reset(seed=0)[0].shape[0] == 2


def test_bad_arguments_of_a_registered_id_are_named():
    for arguments, message in (
        ({"physics": "slow"}, "physics=slow"),
        ({"colour": "red"}, "colour=red"),
        ({"render_mode": "ansi"}, "render_mode=ansi"),
        ({"horizon": 0}, "horizon=0"),
    ):
        with pytest.raises((ValueError, gym.error.Error), match=message):
            gym.make("hippo/AntGather-v0", disable_env_checker=True, **arguments)
    with pytest.raises(ValueError, match="render_mode=rgb_array: a vector environment has none"):
        gym.make_vec("hippo/AntGather-v0", num_envs=2, render_mode="rgb_array")
    env = gym.make("hippo/BlockHopper-v0")
    with pytest.raises(gym.error.ResetNeeded):
        env.step(env.action_space.sample())


def test_a_third_party_learner_trains_on_the_registered_id():
    from stable_baselines3 import PPO

    env = gym.make("hippo/BlockHopper-v0", horizon=200)
    learner = PPO("MlpPolicy", env, n_steps=500, batch_size=250, n_epochs=2, device="cpu", seed=0)
    before = learner.policy.action_net.weight.detach().clone()
    learner.learn(2000)
    assert learner.num_timesteps == 2000
    assert not np.array_equal(before.numpy(), learner.policy.action_net.weight.detach().numpy())
    assert len(learner.ep_info_buffer) == 10
