"""BatchPhysics: exactly a plain `mj_step` loop, current derived fields, and contained divergence."""

import warnings

import mujoco
import numpy as np
import pytest

from hippo.envs import ENVIRONMENTS, make
from hippo.envs.mass_centre import MassCentre, ant_features, hopper_features

STEPS = {"ant": 60, "snake": 10, "hopper": 150, "cheetah": 100}


@pytest.mark.parametrize("num_threads", [1, 2])
@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_batch_stepping_is_exactly_a_plain_loop(name, num_threads):
    env = make(name, 3, 0, num_threads=num_threads)
    env.reset(seed=3)
    physics, model = env.physics, env.physics.model
    datas = [mujoco.MjData(model) for _ in range(3)]
    for data, row in zip(datas, physics.get_state(), strict=True):
        mujoco.mj_setState(model, data, row, mujoco.mjtState.mjSTATE_INTEGRATION)
    rng = np.random.default_rng(0)
    for _ in range(next(steps for robot, steps in STEPS.items() if robot in name)):
        for i, data in enumerate(datas):
            data.mocap_pos[:] = physics.mocap_pos[i]
        _, _, terminated, _, _ = env.step(rng.uniform(-1, 1, (3, model.nu)))
        assert not terminated.any()
        for i, data in enumerate(datas):
            data.ctrl[:] = physics.ctrl[i]
            for _ in range(physics.frame_skip):
                mujoco.mj_step(model, data)
            assert np.array_equal(data.qpos, physics.qpos[i])
            assert np.array_equal(data.qvel, physics.qvel[i])


@pytest.mark.parametrize("num_threads", [1, 2])
@pytest.mark.parametrize("name", ["block_hopper", "block_half_cheetah"])
def test_batch_stepping_is_exactly_a_plain_loop_while_walls_move(name, num_threads):
    """The robots are carried 1.5 m a turn, so the ring turns; the plain loop gets the walls' positions copied in."""
    env = make(name, 3, 0, num_threads=num_threads)
    env.reset(seed=3)
    physics, model = env.physics, env.physics.model
    datas, blind = [mujoco.MjData(model) for _ in range(3)], mujoco.MjData(model)
    x = 1 if name == "block_hopper" else 0
    rng, moved, touched, differs = np.random.default_rng(0), 0, 0, False
    for turn in range(24):
        for data, row in zip(datas, physics.get_state(), strict=True):
            mujoco.mj_setState(model, data, row, mujoco.mjtState.mjSTATE_INTEGRATION)
            data.qpos[x] += 1.5 * (turn > 0)
        physics.qpos[:, x] += 1.5 * (turn > 0)
        for _ in range(4):
            walls = physics.mocap_pos.copy()
            mujoco.mj_copyData(blind, model, datas[0])
            blind.mocap_pos[:, 2] = -10  # the same robot where there are no walls
            _, _, _, truncated, _ = env.step(rng.uniform(-1, 1, (3, model.nu)))
            assert not truncated.any()
            for data, before, i in zip(datas, walls, range(3), strict=True):
                data.mocap_pos[:], data.ctrl[:] = before, physics.ctrl[i]
                for _ in range(physics.frame_skip):
                    mujoco.mj_step(model, data)
                assert np.array_equal(data.qpos, physics.qpos[i])
                assert np.array_equal(data.qvel, physics.qvel[i])
                blocks = data.contact.geom[: data.ncon] if data.ncon else np.zeros((0, 2), int)
                touched += any(model.geom(g).name.startswith("block_") for g in blocks.ravel())
            blind.ctrl[:] = physics.ctrl[0]
            for _ in range(physics.frame_skip):
                mujoco.mj_step(model, blind)
            differs |= not np.array_equal(blind.qpos, physics.qpos[0])
            moved += int((physics.mocap_pos != walls).any())
    assert moved >= 8
    assert touched >= 8
    assert differs


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_derived_fields_are_those_of_the_new_state(name):
    env = make(name, 2, 0)
    env.reset(seed=0)
    physics, model = env.physics, env.physics.model
    data = mujoco.MjData(model)
    for _ in range(3):
        env.step(np.full((2, model.nu), 0.7))
    mujoco.mj_setState(model, data, physics.get_state()[1], mujoco.mjtState.mjSTATE_INTEGRATION)
    mujoco.mj_forward(model, data)
    com = physics.com[1]
    np.testing.assert_allclose(com, data.subtree_com[1], rtol=0, atol=1e-12)
    for _ in range(physics.frame_skip):
        mujoco.mj_step(model, data)  # leaves the derived fields one physics step behind
    stale = data.subtree_com[1].copy()
    mujoco.mj_forward(model, data)
    assert np.abs(data.subtree_com[1] - stale).max() > 1e-7


def test_mujocos_silent_reset_of_a_diverged_simulation_is_off():
    flags = make("ant_gather", 1, 0).physics.model.opt.disableflags
    assert flags & mujoco.mjtDisableBit.mjDSBL_AUTORESET


@pytest.mark.parametrize("name", ENVIRONMENTS)
@pytest.mark.parametrize("bad", [np.nan, 1e6])
def test_a_diverged_simulation_ends_alone(name, bad):
    def trajectory(inject):
        env = make(name, 4, 0)
        env.reset(seed=5)
        rng, rows = np.random.default_rng(1), []
        for t in range(12):
            if inject and t == 6:
                env.physics.qvel[2, 0] = bad
            rows.append(env.step(rng.uniform(-1, 1, env.action_space.shape)))
        return rows

    clean, injected = trajectory(False), trajectory(True)
    others = [0, 1, 3]
    for t, (expected, got) in enumerate(zip(clean, injected, strict=True)):
        assert np.array_equal(expected[0][others], got[0][others])
        for k in (1, 2, 3):
            assert np.array_equal(expected[k][others], got[k][others])
        assert np.isfinite(got[0]).all()
        assert got[4]["diverged"].tolist() == [False, False, t == 6, False]
    _, reward, terminated, truncated, info = injected[6]
    assert (reward[2], terminated[2], truncated[2]) == (0.0, False, True)
    assert np.array_equal(info["final_obs"][2], injected[5][0][2])  # the last finite observation
    assert np.isfinite(info["final_obs"]).all()
    assert info["_final_obs"].tolist() == [False, False, True, False]
    assert not np.array_equal(clean[6][0][2], injected[6][0][2])


def test_one_bad_number_anywhere_is_a_divergence_and_a_large_position_is_none():
    env = make("ant_gather", 4, 0)
    env.reset(seed=0)
    physics, which = env.physics, np.empty(4, bool)
    assert not physics.diverged(which)
    assert which.tolist() == [False] * 4
    for field, values in ((physics.qpos, [np.nan, np.inf, -np.inf]), (physics.qvel, [np.nan, np.inf, 10001, -10001])):
        for j in range(field.shape[1]):
            for value in values:
                kept, field[2, j] = field[2, j], value
                assert physics.diverged(which)
                assert which.tolist() == [False, False, True, False]
                field[2, j] = kept
    physics.qpos[1], physics.qvel[3] = 1e9, -1e4
    assert not physics.diverged(which)


def test_features_of_the_centre_of_mass_worked_by_numpy_and_without_a_warning_of_infinity():
    qpos = np.random.default_rng(0).normal(size=(40, 15)) * 3
    sin, cos = np.sin(qpos[:, 7:]), np.cos(qpos[:, 7:])
    hips, ankles = slice(0, None, 2), slice(1, None, 2)
    legs = [sin[:, hips], cos[:, hips], sin[:, hips] * cos[:, ankles], cos[:, hips] * cos[:, ankles], sin[:, ankles]]
    assert np.array_equal(ant_features(qpos), np.concatenate([np.ones((40, 1)), *legs], 1))
    pitch, thigh, leg, foot = qpos.T[2:6]
    angles = np.stack([pitch, pitch - thigh, pitch - thigh - leg, pitch - thigh - leg - foot], 1)
    chain = np.concatenate([np.ones((40, 1)), qpos[:, :2], np.sin(angles), np.cos(angles)], 1)
    assert np.array_equal(hopper_features(qpos[:, :6]), chain)
    qpos[3, 3:] = np.inf
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for features, columns in ((ant_features, 15), (hopper_features, 6)):
            assert np.isnan(features(qpos[:, :columns])[3]).any()
            assert np.isfinite(np.delete(features(qpos[:, :columns]), 3, 0)).all()


@pytest.mark.parametrize("name", ["ant_gather", "block_hopper"])
def test_our_centre_of_mass_is_mujocos_also_under_changed_masses_and_any_quaternion(name):
    options = {"perturbation": "mass", "strength": "all"} if name == "block_hopper" else {"perturbation": "mass"}
    for chosen in ({}, options):
        env = make(name, 50, 0, **chosen)
        physics, rng = env.physics, np.random.default_rng(1)
        physics.qpos[:] = rng.normal(size=physics.qpos.shape) * 2  # quaternions far from unit length included
        ours = physics._mass_centre(physics.qpos)
        physics.forward(np.arange(50))
        np.testing.assert_allclose(ours, physics.bind("subtree_com")[:, 1], rtol=0, atol=1e-12)


def test_features_that_do_not_span_the_centre_of_mass_are_refused():
    model = make("block_hopper", 1, 0).physics.model
    with pytest.raises(AssertionError, match="do not span"):
        MassCentre(model, lambda qpos: hopper_features(qpos)[:, :-1], is_free=False)
