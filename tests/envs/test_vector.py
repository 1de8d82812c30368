"""RobotTaskEnv: seeding, same-step autoreset, the horizon, exact continuation, and what it refuses."""

import gymnasium as gym
import numpy as np
import pytest

from hippo.envs import ENVIRONMENTS, blocks, gather, locomote, make, mass_centre, physics, robots, vector

everywhere = pytest.mark.parametrize("name", ENVIRONMENTS)


def actions(env, steps, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (steps, *env.action_space.shape))


def played(env, moves):
    return [env.step(a) for a in moves]


def same(a, b):
    return all(
        np.array_equal(x, y) for left, right in zip(a, b, strict=True) for x, y in zip(left[:4], right[:4], strict=True)
    )


@everywhere
def test_a_seed_decides_everything_and_resets_differ(name):
    env = make(name, 2, 0, horizon=5)
    moves = actions(env, 12)
    first, _ = env.reset(seed=4)
    rows = played(env, moves)
    again, _ = env.reset(seed=4)
    assert np.array_equal(first, again)
    assert same(rows, played(env, moves))
    later, _ = env.reset()
    other, _ = env.reset(seed=5)
    assert not np.array_equal(first, later)
    assert not np.array_equal(first, other)
    assert not np.array_equal(first[0], first[1])


@everywhere
def test_environment_i_of_many_is_environment_i_alone(name):
    many = make(name, 8, 0, horizon=6)
    moves = actions(many, 10)
    obs, _ = many.reset(seed=11)
    rows = played(many, moves)  # over one autoreset
    for i in range(8):
        alone = make(name, 1, 0, horizon=6)
        single, _ = alone.reset(seed=[11 + i])
        assert np.array_equal(obs[i], single[0])
        for a, expected in zip(moves, rows, strict=True):
            got = alone.step(a[i : i + 1])
            assert all(np.array_equal(x[i], y[0]) for x, y in zip(expected[:4], got[:4], strict=True))
    assert not np.array_equal(obs[0], obs[7])


@everywhere
def test_at_the_horizon_the_last_observation_is_kept_and_the_next_episode_has_begun(name):
    long, short = make(name, 3, 0, horizon=50), make(name, 3, 0, horizon=4)
    moves = actions(long, 4)
    long.reset(seed=2)
    short.reset(seed=2)
    expected, got = played(long, moves), played(short, moves)
    for t in range(3):
        assert "final_obs" not in got[t][4]
        assert not got[t][3].any()
    obs, reward, terminated, truncated, info = got[3]
    assert truncated.all()
    assert not terminated.any()
    assert info["_final_obs"].all()
    assert np.array_equal(info["final_obs"], expected[3][0])
    assert np.array_equal(reward, expected[3][1])
    assert np.array_equal(obs, long.reset()[0])  # what a reset at this moment begins with
    assert not np.array_equal(obs, expected[3][0])
    assert np.array_equal(info["final_info"]["diverged"], [False] * 3)
    assert not short.step(moves[0])[3].any()  # the clock has started again


def test_termination_and_truncation_are_apart_also_when_they_coincide():
    # Ant 0 dies in step 1 of 3, ant 1 in the last step, ant 2 lives on to the horizon.
    env = make("ant_gather", 3, 0, horizon=3)
    env.reset(seed=0)
    rows = []
    for t in range(3):
        if t != 1:
            env.physics.qpos[t // 2, 2] = 5.0
            env.physics.forward(np.arange(3))
        rows.append(env.step(np.zeros((3, 8))))
    assert [r[2].tolist() for r in rows] == [[True, False, False], [False] * 3, [False, True, False]]
    assert [r[3].tolist() for r in rows] == [[False] * 3, [False] * 3, [False, False, True]]
    assert [r[4].get("_final_obs", np.zeros(3, bool)).tolist() for r in rows] == [
        [True, False, False],
        [False] * 3,
        [False, True, True],
    ]
    last, final = rows[2][0], rows[2][4]["final_obs"]
    z = env.observation_names.index("z")
    assert final[1, z] > 4
    assert last[1, z] < 1  # reborn
    assert np.array_equal(final[0], last[0])  # its episode goes on
    assert not np.array_equal(final[2], last[2])
    assert rows[2][4]["final_info"]["reward_death"].tolist() == [0.0, -10.0, 0.0]


@pytest.mark.parametrize("layout_seed", [None, 5])
@everywhere
def test_continuation_from_a_state_is_bit_identical_also_in_another_environment(name, layout_seed):
    env = make(name, 3, 0, horizon=7)
    env.reset(seed=1, options={"layout_seed": layout_seed})
    moves = actions(env, 20)
    played(env, moves[:5])
    state = env.get_state()
    expected = played(env, moves[5:])  # over two autoresets
    env.set_state(state)
    assert same(expected, played(env, moves[5:]))
    other = make(name, 3, 99, horizon=7)
    other.set_state(state)
    assert same(expected, played(other, moves[5:]))
    for missing in ("rngs", "clock", "physics"):  # each part matters
        fresh = make(name, 3, 99, horizon=7)
        fresh.reset()
        fresh.set_state(state | {missing: fresh.get_state()[missing]})
        assert not same(expected, played(fresh, moves[5:]))


@everywhere
def test_returned_arrays_share_no_memory(name):
    env = make(name, 2, 0, horizon=2)
    env.reset(seed=0)
    rows = played(env, actions(env, 4))
    arrays = [x for row in rows for x in (*row[:4], *(v for v in row[4].values() if isinstance(v, np.ndarray)))]
    for i, a in enumerate(arrays):
        assert not any(np.shares_memory(a, b) for b in arrays[i + 1 :] if b is not a)
    kept = rows[0][0].copy()
    env.step(actions(env, 1)[0])
    assert np.array_equal(rows[0][0], kept)


@everywhere
def test_what_the_caller_does_to_returned_arrays_is_not_seen_by_the_environment(name):
    for steps in (0, 1):  # the last finite observation comes from reset, then from step
        env = make(name, 2, 0)
        obs, _ = env.reset(seed=0)
        for a in actions(env, steps):
            obs = env.step(a)[0]
        kept = obs.copy()
        obs[:] = 7.0
        env.physics.qvel[1, 0] = np.nan
        info = env.step(np.zeros(env.action_space.shape))[4]
        assert np.array_equal(info["final_obs"][1], kept[1])


@pytest.mark.parametrize("options", [{}, {"velocity_penalty": True}])
def test_the_reward_is_the_sum_of_its_terms(options):
    env = make("ant_gather", 6, 0, **options)
    env.reset(seed=0)
    env.physics.qpos[:2, 2] = 5.0
    env.physics.qvel[:, 0] = 4.0
    env.physics.forward(np.arange(6))
    total = 0.0
    for a in actions(env, 30):
        _, reward, _, _, info = env.step(a)
        np.testing.assert_allclose(reward, sum_of_terms(info), rtol=0, atol=1e-15)
        total += np.abs(reward).sum()
    assert total >= 20  # two deaths at least


def sum_of_terms(info):
    return sum(v for k, v in info.items() if k.startswith("reward_")) - info.get("velocity_penalty", 0.0)


@pytest.mark.parametrize("name", [n for n in ENVIRONMENTS if n.endswith("gather") or n.startswith("block")])
def test_the_reward_is_the_sum_of_its_terms_also_where_a_simulation_diverges(name):
    env = make(name, 3, 0)
    env.reset(seed=0)
    if name.endswith("gather"):
        env.task.objects[:, :8] = env.physics.com[:, None, :2]  # eight apples to catch at once
    else:
        env.physics.qpos[:, 1 if name == "block_hopper" else 0] += 17.0  # eight walls behind
        env.physics.forward(np.arange(3))
    env.physics.qvel[2, 0] = np.nan
    _, reward, _, _, info = env.step(np.zeros(env.action_space.shape))
    assert reward.tolist() == [8.0, 8.0, 0.0]
    assert sum_of_terms(info).tolist() == [8.0, 8.0, 0.0]


@everywhere
def test_observations_have_their_dtype_and_stay_in_their_space(name):
    env = make(name, 4, 0)
    obs, _ = env.reset(seed=0)
    assert obs.dtype == np.float32
    space = env.single_observation_space
    assert np.isfinite(space.low).all()
    assert np.isfinite(space.high).all()
    wide = np.flatnonzero(space.high >= 1e3)  # bounds that only a diverging simulation meets
    assert len(wide) >= env.robot_size - 4  # all of the robot but a quaternion
    for a in actions(env, 100):
        obs, reward, terminated, truncated, _ = env.step(3 * a)
        assert env.observation_space.contains(obs)
        assert (np.abs(obs[:, wide]) < 1e3).all()
        assert (reward.dtype, terminated.dtype, truncated.dtype) == (np.float64, bool, bool)


def test_actions_are_clipped_and_mapped_to_the_controls():
    env = make("block_hopper", 2, 0)
    env.reset(seed=0)
    env.step(np.array([[0.5, -2.0, 1.0], [0.0, 1.5, -0.25]]))
    assert env.physics.ctrl.tolist() == [[100, -200, 200], [0, 200, -50]]


def test_an_observation_is_its_sources_as_single_floats_within_their_bounds_and_nan_stays():
    sources = [np.array([[0.1, -1e30, np.nan]]), np.array([[7.0, 2.0]]), np.zeros((1, 3)), np.array([[0.0, 5.5]])]
    picks = [(0, 0), (0, 1), (0, 2), (1, 1), (2, 2), (3, 1)]
    low, high = np.full(6, -1.0, np.float32), np.full(6, 4.0, np.float32)
    out = np.empty((1, 6), np.float32)
    vector._fill(*sources, *np.array(picks).T.copy(), low, high, out)
    np.testing.assert_array_equal(out, np.array([[0.1, -1.0, np.nan, 2.0, 0.0, 4.0]], np.float32))


@everywhere
def test_nothing_is_compiled_but_for_one_and_for_many_simulations_however_the_actions_come(name):
    def compiled():
        modules = (vector, physics, mass_centre, robots, gather, blocks, locomote)
        kernels = [(f"{m.__name__}.{n}", k) for m in modules for n, k in vars(m).items() if hasattr(k, "signatures")]
        assert len(kernels) > 15
        return {name: list(kernel.signatures) for name, kernel in kernels}

    def step(num_envs):
        env = make(name, num_envs, 0, horizon=3)
        env.reset(seed=0)
        moves = actions(env, 1)[0]
        frozen, wide = moves.copy(), np.repeat(moves, 2, 1)
        frozen.flags.writeable = False
        for a in (moves, moves.astype(np.float32), moves.tolist(), np.asfortranarray(moves), frozen, wide[:, ::2]):
            env.step(a)

    step(1)
    step(2)
    once = compiled()
    step(1)
    step(5)
    assert compiled() == once


@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        ("ant_gatherer", {}, "env=ant_gatherer"),
        ("ant_gather", {"num_envs": 0}, "num_envs=0"),
        ("ant_gather", {"num_envs": 2.0}, "num_envs=2.0"),
        ("ant_gather", {"num_threads": 0}, "num_threads=0"),
        ("ant_gather", {"seed": None}, "seed=None"),
        ("ant_gather", {"seed": -1}, "seed=-1"),
        ("ant_gather", {"seed": 2.5}, "seed=2.5"),
        ("ant_gather", {"horizon": 0}, "horizon=0"),
        ("ant_gather", {"wind": 1}, "wind=1"),
        ("ant_gather", {"physics": "slow"}, "physics=slow"),
        ("ant_gather", {"observation": "ego"}, "observation=ego"),
        ("block_hopper", {"velocity_penalty": True}, "velocity_penalty=True"),
        ("snake_gather", {"velocity_penalty": "yes"}, "velocity_penalty=yes"),
        ("block_hopper", {"perturbation": "mass"}, "strength=original"),
        ("snake_gather", {"perturbation": "colour"}, "perturbation=colour"),
        ("ant_gather", {"horizon": 10**20}, "horizon=100000000000000000000: must be at most"),
        ("ant_gather", {"num_envs": 10**20}, "num_envs=100000000000000000000: must be at most"),
        ("ant_gather", {"num_threads": 2**31}, "num_threads=2147483648: must be at most"),
        ("ant_gather", {"num_envs": np.array([2])}, "num_envs="),
        ("ant_gather", {"num_envs": np.True_}, "num_envs=True"),
        ("ant_gather", {"autoreset": "no"}, "autoreset=no: must be one of True, False, NextStep"),
        ("ant_gather", {"autoreset": None}, "autoreset=None"),
        ("ant_gather", {"autoreset": 1}, "autoreset=1"),
        ("snake_gather", {"walls": 1}, "walls=1"),
        ("snake_gather", {"walls": np.array([True, False])}, "walls="),
        ("snake_gather", {"walls": []}, "walls="),
        ("ant_gather", {"strength": "all"}, "strength=all: changes nothing without a perturbation"),
        ("block_hopper", {"strength": "all", "perturbation": None}, "strength=all"),
    ],
)
def test_bad_arguments_are_refused_by_name(name, arguments, message):
    with pytest.raises(ValueError, match=message):
        make(name, **({"num_envs": 1, "seed": 0} | arguments))


def test_bad_calls_are_refused():
    env = make("block_hopper", 2, 0)
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros((2, 3)))
    for bad in (-1, 2.5, "a", True):
        with pytest.raises(ValueError, match=f"layout_seed={bad}"):
            env.reset(options={"layout_seed": bad})
    with pytest.raises(ValueError, match="wall_seed"):
        env.reset(options={"wall_seed": 1})
    with pytest.raises(ValueError, match="seed="):
        env.reset(seed=[1, 2, 3])
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"\(2, 4\)"):
        env.step(np.zeros((2, 4)))
    with pytest.raises(ValueError, match="1 non-finite"):
        env.step(np.array([[0.0, np.nan, 0.0], [0.0, 0.0, 0.0]]))
    with pytest.raises(ValueError, match="2 non-finite"):
        env.step(np.array([[0.0, np.inf, 0.0], [0.0, 0.0, -np.inf]]))
    for bad in (np.zeros((2, 3), complex), [[1j] * 3] * 2, np.full((2, 3), "0.5"), np.full((2, 3), None)):
        with pytest.raises(ValueError, match=r"actions are of type .*; expected real numbers"):
            env.step(bad)
    with pytest.raises(ValueError, match="layout_seed=-1"):
        env.reset(seed=3, options={"layout_seed": -1})
    clean = make("block_hopper", 2, 0)
    clean.reset(seed=0)
    assert same([clean.step(np.ones((2, 3)))], [env.step(np.ones((2, 3)))])  # what was refused left no trace
    env.close()
    with pytest.raises(gym.error.ClosedEnvironmentError):
        env.reset()
    with pytest.raises(gym.error.ClosedEnvironmentError):
        env.step(np.zeros((2, 3)))


@pytest.mark.parametrize("quantity", ["mass", "damping", "inertia", "friction"])
@pytest.mark.parametrize("name", ["ant_gather", "snake_gather"])
def test_a_perturbation_scales_exactly_the_authors_elements(name, quantity):
    base = make(name, 1, 0).physics.model
    model = make(name, 1, 0, perturbation=quantity).physics.model
    fields = {"mass": "body_mass", "damping": "dof_damping", "inertia": "body_inertia", "friction": "geom_friction"}
    for other, field in fields.items():
        before, after = getattr(base, field), getattr(model, field)
        if other != quantity:
            np.testing.assert_allclose(after, before, rtol=1e-12, err_msg=other)
    # Body and geom counts scaled: Ant 6 bodies (inertia by 1.3), hip_1 alone has damping; floor, 4 walls, 4 of the Ant.
    before, after = getattr(base, fields[quantity]), getattr(model, fields[quantity])
    rows = np.flatnonzero(np.abs(after - before).reshape(len(before), -1).max(1) > 1e-9)
    counts = {
        "ant_gather": {"mass": 6, "damping": 1, "inertia": 6, "friction": 9},
        "snake_gather": {"mass": 2, "damping": 0, "inertia": 2, "friction": 3},
    }
    assert len(rows) == counts[name][quantity]
    factor = 1.3 if (name, quantity) == ("ant_gather", "inertia") else 1.5
    np.testing.assert_allclose(after[rows], before[rows] * factor, rtol=1e-9)
    if quantity == "mass":
        assert model.body_mass.sum() == pytest.approx({"ant_gather": 1.1866, "snake_gather": 213.63}[name], rel=1e-4)
        np.testing.assert_allclose(model.body_subtreemass[1], model.body_mass.sum())


@pytest.mark.parametrize(
    ("quantity", "changes"), [("damping", False), ("friction", False), ("mass", True), ("inertia", True)]
)
def test_two_perturbations_of_the_snake_cannot_change_its_dynamics(quantity, changes):
    env, perturbed = make("snake_gather", 2, 0), make("snake_gather", 2, 0, perturbation=quantity)
    env.reset(seed=0)
    perturbed.reset(seed=0)
    moves = actions(env, 20)
    assert same(played(env, moves), played(perturbed, moves)) is not changes
