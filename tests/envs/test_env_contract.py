"""What every environment, under every id and option, must keep: the contract with learners and with Gymnasium."""

import copy
import itertools
import pickle
import warnings

import cloudpickle
import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

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


def assert_same(ours, theirs, what):
    for a, b in zip(ours[:4], theirs[:4], strict=True):
        np.testing.assert_array_equal(a, b, err_msg=str(what))


@pytest.mark.parametrize("mode", AutoresetMode, ids=lambda mode: mode.value)
@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_every_mode_of_autoreset_is_that_of_gymnasiums_vectorisation(name, mode):
    ours = gym.make_vec(gymnasium_id(name), num_envs=3, max_episode_steps=4, autoreset=mode.value)
    fns = [lambda: gym.make(gymnasium_id(name), max_episode_steps=4, disable_env_checker=True)] * 3
    theirs = gym.vector.SyncVectorEnv(fns, autoreset_mode=mode)
    assert ours.metadata["autoreset_mode"] is mode
    both = ours, theirs
    np.testing.assert_array_equal(*(envs.reset(seed=5)[0] for envs in both))
    rng = np.random.default_rng(0)
    for t in range(13):
        action = rng.uniform(-1, 1, ours.action_space.shape)
        if t == 6:  # a simulation that diverges ends apart from the others
            ours.physics.qvel[2, 0] = theirs.envs[2].unwrapped.envs.physics.qvel[0, 0] = np.nan
        got, expected = (envs.step(action) for envs in both)
        assert_same(got, expected, t)
        assert ("final_obs" in got[4]) == ("final_obs" in expected[4])
        mask = got[2] | got[3] if mode is AutoresetMode.DISABLED else np.zeros(3, bool)
        options, seeds = {}, None
        if t == 1:  # out of step from now on, and with its own seed and layout
            mask, seeds, options = np.array([False, True, False]), [1, 2, None], {"layout_seed": 8}
        if mask.any():
            options["reset_mask"] = mask
            obs, infos = zip(*(envs.reset(seed=seeds, options=dict(options)) for envs in both), strict=True)
            np.testing.assert_array_equal(*obs, err_msg=str(t))
            assert infos[0].keys() == {"diverged"}


def test_only_what_a_mask_names_is_reset():
    envs = make("ant_gather", 3, 0, autoreset=False)
    with pytest.raises(gym.error.ResetNeeded, match="before the first reset"):
        envs.reset(options={"reset_mask": np.array([True, False, True])})
    first, _ = envs.reset(seed=0, options={"reset_mask": np.ones(3, bool)})
    state = envs.physics.get_state()
    obs, _ = envs.reset(options={"reset_mask": np.array([False, True, False])})
    assert (obs == first).all(1).tolist() == [True, False, True]
    assert (envs.physics.get_state() == state).all(1).tolist() == [True, False, True]
    for bad in (np.zeros(3, bool), np.ones(2, bool), np.ones(3, int), "all"):
        with pytest.raises(ValueError, match=r"reset_mask=.*must be 3 bools"):
            envs.reset(options={"reset_mask": bad})


def test_in_next_step_mode_the_step_after_an_end_is_the_reset_and_nothing_else():
    envs = make("ant_gather", 2, 0, horizon=3, autoreset="NextStep")
    envs.reset(seed=0)
    ones = np.ones((2, 8))
    lasts = [envs.step(ones) for _ in range(3)][-1]
    assert lasts[3].all()
    envs.task.objects[:, 0] = 0.0  # an apple to catch, were the episode not over
    obs, reward, terminated, truncated, info = envs.step(ones)
    assert not np.any([reward, terminated, truncated])
    assert "final_obs" not in info
    assert not any(info[term].any() for term in info if term.startswith("reward_"))
    np.testing.assert_array_equal(info["com"], envs.com)
    np.testing.assert_array_equal(obs, envs._observe())
    assert [envs.step(ones)[3].all() for _ in range(3)] == [False, False, True]  # the reset was none of the three


WRAPPERS = {  # the modes that each of Gymnasium's vector wrappers takes, as docs/environments says
    "NormalizeObservation": ["NextStep"],
    "FlattenObservation": ["NextStep", "Disabled"],
    "NormalizeReward": ["NextStep", "Disabled", "SameStep"],
    "RecordEpisodeStatistics": ["NextStep", "Disabled", "SameStep"],
}


@pytest.mark.parametrize("mode", ["NextStep", "Disabled", "SameStep"])
@pytest.mark.parametrize("wrapper", WRAPPERS)
def test_gymnasiums_vector_wrappers_take_the_modes_that_the_page_says(wrapper, mode):
    def ends():
        envs = gym.make_vec("hippo/BlockHopper-v0", num_envs=2, max_episode_steps=3, autoreset=mode)
        wrapped = getattr(gym.wrappers.vector, wrapper)(envs)
        wrapped.reset(seed=0)
        return [wrapped.step(envs.action_space.sample())[3].all() for _ in range(7)]

    if mode not in WRAPPERS[wrapper]:
        with pytest.raises(ValueError, match=r"autoreset_mode.* to be"):
            ends()
    elif mode == "NextStep":
        assert ends() == [False, False, True, False, False, False, True]
    else:
        assert ends()[2]


COPIES = {
    "pickle": lambda environment: pickle.loads(pickle.dumps(environment)),
    "cloudpickle": lambda environment: pickle.loads(cloudpickle.dumps(environment)),
    "deepcopy": copy.deepcopy,
}
COPIED = [(name, options, how) for name, options in VARIANTS for how in COPIES if how == "pickle" or not options]


@pytest.mark.parametrize(("name", "options", "how"), COPIED)
def test_a_pickled_or_copied_environment_continues_bit_identically(name, options, how):
    copied = COPIES[how]
    single = gym.make(gymnasium_id(name), max_episode_steps=7, **options)
    several = gym.make_vec(gymnasium_id(name), num_envs=3, max_episode_steps=7, num_threads=2, **options)
    for envs in (single, several):
        fresh = copied(envs)
        envs.reset(seed=3, options={"layout_seed": 1})
        first = [envs.action_space.sample() for _ in range(4)]
        for action in first:
            envs.step(action)
        other = copied(envs)
        assert other.unwrapped.spec == envs.unwrapped.spec
        for _ in range(9):  # over an end
            action = envs.action_space.sample()
            np.testing.assert_array_equal(action, other.action_space.sample())
            assert_same(envs.step(action), other.step(action), name)
            if envs is single and envs.unwrapped.envs._clock[0] == 7:
                np.testing.assert_array_equal(envs.reset()[0], other.reset()[0])
        begun, again = fresh.reset(seed=3), envs.reset(seed=3, options={"layout_seed": None})
        np.testing.assert_array_equal(begun[0], again[0])
    several.close()
    with pytest.raises(gym.error.ClosedEnvironmentError):
        copied(several).reset()


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_the_metadata_is_that_of_gymnasiums_own_robots(name):
    limit = ENVIRONMENTS[name].horizon
    env = gym.make(gymnasium_id(name))
    assert gym.spec(gymnasium_id(name)).max_episode_steps == env.spec.max_episode_steps == limit
    timed = gym.wrappers.TimeAwareObservation(gym.make(gymnasium_id(name), max_episode_steps=5))
    assert timed.reset(seed=0)[0][-1] == 0
    assert [timed.step(timed.action_space.sample())[3] for _ in range(5)] == [False] * 4 + [True]
    assert timed.spec.max_episode_steps == 5
    longer = gym.make(gymnasium_id(name), max_episode_steps=2 * limit)
    assert longer.unwrapped.envs.horizon > 2 * limit  # the limit is Gymnasium's alone
    for spec in (gym.spec(gymnasium_id(name)), timed.env.spec):
        again = gym.make(gym.envs.registration.EnvSpec.from_json(spec.to_json()))
        assert again.spec.max_episode_steps == spec.max_episode_steps
    several = gym.make_vec(gymnasium_id(name), num_envs=2, horizon=9, autoreset="NextStep")
    same = gym.make_vec(gym.envs.registration.EnvSpec.from_json(several.spec.to_json()))
    assert (same.num_envs, same.horizon, same.autoreset) == (2, 9, AutoresetMode.NEXT_STEP)


def test_gymnasiums_words_are_accepted_and_numpy_values_count_as_what_they_are():
    envs = gym.make_vec("hippo/SnakeGather-v0", num_envs=np.int64(2), seed=np.uint32(1), max_episode_steps=np.int32(5))
    assert (envs.num_envs, envs.horizon) == (2, 5)
    same = make("snake_gather", 2, 1, horizon=np.array(5))
    np.testing.assert_array_equal(envs.reset()[0], same.reset()[0])
    obs = {}
    for seed in (4, np.int8(4), np.array(4), [4, 5], (4, 5), np.array([4, 5]), range(4, 6), [np.int64(4), np.uint8(5)]):
        obs[repr(seed)] = envs.reset(seed=seed)[0]
        np.testing.assert_array_equal(obs[repr(seed)], obs["4"])
    single = gym.make("hippo/SnakeGather-v0", seed=1).unwrapped
    np.testing.assert_array_equal(single.reset()[0], same.reset(seed=1)[0][0])
    np.testing.assert_array_equal(single.reset(seed=np.int64(4))[0], obs["4"][0])
    solid = make("snake_gather", 1, 0, walls=np.True_, observation=np.str_("ego"), position=np.array(True))
    assert (solid.options.walls, type(solid.options.walls), solid.options.observation) == (True, bool, "ego")
    layouts = [envs.reset(seed=0, options={"layout_seed": seed})[0] for seed in (7, np.int64(7), np.array(7))]
    np.testing.assert_array_equal(layouts[0], layouts[1])
    np.testing.assert_array_equal(layouts[0], layouts[2])


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
        ({"horizon": 5001}, "horizon=5001: gymnasium.make ends it after 5000; give max_episode_steps"),
        ({"horizon": 10**20}, "horizon=100000000000000000000"),
        ({"num_envs": 2}, "num_envs=2: .* gymnasium.make_vec makes several"),
        ({"autoreset": True}, "autoreset=True: .* call reset"),
        ({"seed": -1}, "seed=-1"),
        ({"walls": True}, "walls=True"),
    ):
        with pytest.raises((ValueError, gym.error.Error), match=message):
            gym.make("hippo/AntGather-v0", disable_env_checker=True, **arguments)
    with pytest.raises(ValueError, match="render_mode=rgb_array: a vector environment has none"):
        gym.make_vec("hippo/AntGather-v0", num_envs=2, render_mode="rgb_array")
    for arguments, message in (
        ({"max_episode_steps": 0}, "max_episode_steps=0"),
        ({"max_episode_steps": 7, "horizon": 8}, "max_episode_steps=7: is the horizon, which is given as 8"),
        ({"autoreset_mode": "NextStep"}, "autoreset_mode=NextStep: .* its name here is autoreset"),
        ({"autoreset": "no"}, "autoreset=no: must be one of True, False, NextStep, SameStep, Disabled"),
        ({"seed": 1.5}, "seed=1.5"),
    ):
        with pytest.raises(ValueError, match=message):
            gym.make_vec("hippo/AntGather-v0", num_envs=2, **arguments)
    with pytest.raises(ValueError, match=r"max_episode_steps=7: .* its name here is horizon"):
        make("ant_gather", 2, 0, max_episode_steps=7)
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
