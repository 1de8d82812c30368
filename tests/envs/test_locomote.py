"""The robots alone: inner rewards against a plain MuJoCo loop, their ends, and what learners of skills read of them."""

import mujoco
import numpy as np
import pytest

from hippo.envs import make

TASK_OF = {"ant": "ant_gather", "snake": "snake_gather", "hopper": "block_hopper", "half_cheetah": "block_half_cheetah"}
# robot, physics -> physics steps and seconds of one control step (the authors' models; "fast" is ours)
TIMING = {("ant", "paper"): (1, 0.01), ("ant", "fast"): (1, 0.01), ("snake", "paper"): (50, 0.001)}
TIMING[("snake", "fast")] = (10, 0.005)


def centre(model, data):
    """Mass-weighted mean of the bodies' centres at the current joint positions, by hand."""
    mujoco.mj_kinematics(model, data)
    return (model.body_mass[1:, None] * data.xipos[1:]).sum(0) / model.body_mass[1:].sum()


@pytest.mark.parametrize(("robot", "physics"), TIMING)
def test_the_inner_reward_is_planar_speed_less_control_cost_plus_survival(robot, physics):
    envs = make(robot, 2, 0, physics=physics)
    envs.reset(seed=4)
    model, (frame_skip, timestep) = envs.physics.model, TIMING[robot, physics]
    assert model.opt.timestep == timestep
    data = mujoco.MjData(model)
    rng, others = np.random.default_rng(2), []
    for _ in range(40):
        mujoco.mj_setState(model, data, envs.physics.get_state()[1], mujoco.mjtState.mjSTATE_INTEGRATION)
        before, torso = centre(model, data), data.qpos[:2].copy()
        actions = 2 * rng.standard_normal(envs.action_space.shape)  # many beyond the bounds
        _, reward, _, _, info = envs.step(actions)
        clipped = np.clip(actions[1], -1, 1)
        data.ctrl[:] = clipped * (1 if robot == "ant" else 50)
        mujoco.mj_step(model, data, frame_skip)
        moved = centre(model, data) - before
        seconds = frame_skip * timestep
        speed, control = np.hypot(*moved[:2]) / seconds, -0.5 * 0.01 * (clipped**2).sum()
        survival = 0.05 if robot == "ant" else 0.0
        np.testing.assert_allclose(info["reward_speed"][1], speed, rtol=0, atol=1e-9)
        np.testing.assert_allclose(info["reward_control"][1], control, rtol=0, atol=1e-12)
        assert info["reward_survival"][1] == survival
        np.testing.assert_allclose(reward[1], speed + control + survival, rtol=0, atol=1e-9)
        wrong_torso = np.hypot(*(data.qpos[:2] - torso)) / seconds
        others.append(
            (wrong_torso - speed, np.linalg.norm(moved) / seconds - speed, (actions[1] ** 2 - clipped**2).sum())
        )
    torso, spatial, unclipped = np.abs(others).max(0)
    assert torso > 1e-3, "the torso's speed would pass for the whole robot's"
    assert unclipped > 1e-3, "a cost of unclipped actions would pass"
    assert (spatial > 1e-3) == (robot == "ant"), "the speed in space would pass for that in the plane"


def test_the_first_step_of_an_episode_is_not_paid_for_the_way_back_to_the_start():
    envs = make("snake", 1, 0, horizon=2)
    envs.reset(seed=0)
    envs.physics.qvel[:, 0] = 20.0  # m/s: a metre in the first step, less in water after it
    speeds = [envs.step(np.zeros((1, 4)))[4]["reward_speed"][0] for _ in range(3)]
    assert speeds[0] > 1.0
    assert speeds[2] < 0.5, "of the next episode, at rest but for the noise"


@pytest.mark.parametrize("robot", ["hopper", "half_cheetah"])
def test_the_robots_of_diayn_are_paid_nothing_and_never_end_but_at_the_horizon(robot):
    envs = make(robot, 4, 0, horizon=60)
    envs.reset(seed=0)
    for step in range(60):
        _, reward, terminated, truncated, info = envs.step(envs.action_space.sample())
        assert not reward.any()
        assert not terminated.any()
        assert truncated.all() == truncated.any() == (step == 59)
        assert not [name for name in info if name.startswith("reward_")]


@pytest.mark.parametrize(("robot", "ends"), [("ant", True), ("snake", False)])
def test_only_an_ant_out_of_its_heights_ends_early(robot, ends):
    envs = make(robot, 2, 0)
    envs.reset(seed=0)
    envs.physics.qpos[1, 2] = 1.5  # the Ant's height; the Snake's heading
    _, _, terminated, truncated, _ = envs.step(np.zeros(envs.action_space.shape))
    assert terminated.tolist() == [False, ends]
    assert not truncated.any()


@pytest.mark.parametrize("robot", TASK_OF)
def test_a_robot_alone_observes_itself_as_in_its_task(robot):
    alone, task = make(robot, 1, 0), make(TASK_OF[robot], 1, 0)
    assert alone.robot_name == task.robot_name == robot
    assert alone.robot_size == task.robot_size == len(alone.observation_names)
    assert alone.observation_names == task.observation_names[: task.robot_size]
    np.testing.assert_array_equal(alone.reset(seed=6)[0], task.reset(seed=6)[0][:, : task.robot_size])


def test_the_variant_of_an_observation_is_told():
    assert make("snake", 1, 0).observation_variant == "paper"
    assert make("snake", 1, 0, observation="ego").observation_variant == "ego"


@pytest.mark.parametrize("robot", TASK_OF)
def test_the_centre_of_mass_in_info_is_the_ended_episodes_and_com_the_new_ones(robot):
    envs = make(robot, 2, 0, horizon=3)
    reference = make(robot, 2, 0, horizon=4)
    envs.reset(seed=1)
    reference.reset(seed=1)
    for _ in range(3):
        actions = envs.action_space.sample()
        info = envs.step(actions)[4]
        reference.step(actions)
    assert info["_final_obs"].all()
    np.testing.assert_array_equal(info["com"], reference.com)
    assert not np.isclose(envs.com, info["com"]).all()


@pytest.mark.parametrize("name", ["ant_gather", "snake_gather"])
def test_the_position_is_appended_at_the_very_end_and_changes_nothing_before_it(name):
    plain, located = make(name, 3, 0), make(name, 3, 0, position=True)
    assert located.robot_size == plain.robot_size
    assert located.observation_names == [*plain.observation_names, "position_x", "position_y"]
    obs, (longer, _) = plain.reset(seed=2)[0], located.reset(seed=2)
    rng = np.random.default_rng(0)
    for _ in range(20):
        np.testing.assert_array_equal(longer[:, :-2], obs)
        np.testing.assert_array_equal(longer[:, -2:], located.physics.qpos[:, :2].astype(np.float32))
        assert not np.isclose(longer[:, -2:], located.com[:, :2], atol=1e-6).all(), "the torso, not the whole robot"
        actions = rng.uniform(-1, 1, plain.action_space.shape)
        obs, longer = plain.step(actions)[0], located.step(actions)[0]


def test_the_centre_of_mass_of_a_diverged_simulation_is_its_last_finite_one():
    envs = make("snake", 2, 0)
    envs.reset(seed=0)
    envs.physics.qpos[1, 0] += 49.0
    _, _, _, _, info = envs.step(np.zeros((2, 4)))
    last = info["com"][1].copy()
    assert last[0] > 45
    envs.physics.qvel[1, 0] = np.nan
    _, _, _, truncated, info = envs.step(np.zeros((2, 4)))
    assert truncated.tolist() == [False, True]
    np.testing.assert_array_equal(info["com"][1], last)
