"""The robots against the numbers of the authors' models (rllab's hopper, half_cheetah, snake and low-gear ant)."""

import numpy as np
import pytest

from hippo.envs import make

TASK = {"ant": "ant_gather", "snake": "snake_gather", "hopper": "block_hopper", "half_cheetah": "block_half_cheetah"}


def model_of(robot, **options):
    return make(TASK[robot], 1, 0, **options).physics.model


MASSES = {
    "hopper": {"torso": 3.6652, "thigh": 4.0579, "leg": 2.7814, "foot": 5.3156},
    "half_cheetah": {
        "torso": 6.2502,
        "bthigh": 1.5435,
        "bshin": 1.5874,
        "bfoot": 1.0954,
        "fthigh": 1.4381,
        "fshin": 1.2008,
        "ffoot": 0.8845,
    },
    "snake": dict.fromkeys(("torso", "mid", "back", "back2", "back3"), 35.6047),
    "ant": {"torso": 0.32725}
    | dict.fromkeys(("front_left_leg", "front_right_leg", "back_leg", "right_back_leg"), 0.03916)
    | {f"aux_{i}": 0.03916 for i in range(1, 5)}
    | {f"foot_{i}": 0.06759 for i in range(1, 5)},
}
TOTAL = {"hopper": 15.820, "half_cheetah": 14.0, "snake": 178.024, "ant": 0.91088}


@pytest.mark.parametrize("robot", MASSES)
def test_masses_are_the_originals_also_with_walls_in_the_world(robot):
    model = model_of(robot)
    bodies = {model.body(i).name for i in range(1, model.nbody)}
    assert {name for name in bodies if not name.startswith("block_")} == set(MASSES[robot])
    for body, mass in MASSES[robot].items():
        assert model.body(body).mass[0] == pytest.approx(mass, rel=1e-3), body
    assert model.body_mass.sum() == pytest.approx(TOTAL[robot], rel=1e-4)
    assert model.body("torso").subtreemass[0] == pytest.approx(TOTAL[robot], rel=1e-4)


@pytest.mark.filterwarnings("ignore:compiler attribute 'settotalmass' is deprecated")
def test_a_total_mass_set_over_the_world_would_count_the_walls_in():
    # The original's settotalmass="14" with 12 boxes of 0.1 x 10 x 2 m = 2000 kg each at the default density: the robot
    # keeps 14 * 14 / (14 + 12 * 2000) = 0.0082 kg. This is why its masses are written out.
    robot, walls = 14.0, 12 * 0.1 * 10 * 2 * 1000
    env = make("block_half_cheetah", 1, 0)
    spec = env.robot.spec("paper")
    env.task.build(spec)
    for geom in spec.geoms:
        if geom.name.startswith("block_"):
            geom.mass = np.nan  # as if none were given
    spec.compiler.settotalmass = 14
    wrong = spec.compile()
    assert wrong.body("torso").subtreemass[0] == pytest.approx(14 * robot / (robot + walls), rel=1e-3)
    assert env.physics.model.body("torso").subtreemass[0] == pytest.approx(14, rel=1e-4)


def test_a_snake_links_inertia_is_that_of_the_original():
    model = model_of("snake")
    for link in MASSES["snake"]:
        assert np.sort(model.body(link).inertia) == pytest.approx([0.1738, 3.9176, 3.9176], rel=1e-3)


@pytest.mark.parametrize(
    ("robot", "timestep", "integrator", "frame_skip"),
    [("ant", 0.01, 1, 1), ("snake", 0.001, 0, 50), ("hopper", 0.02, 1, 1), ("half_cheetah", 0.01, 0, 5)],
)  # MuJoCo numbers Euler 0 and RK4 1
def test_time_steps_and_integrators(robot, timestep, integrator, frame_skip):
    physics = make(TASK[robot], 1, 0).physics
    assert (physics.model.opt.timestep, physics.model.opt.integrator) == (timestep, integrator)
    assert physics.frame_skip == frame_skip
    assert physics.model.opt.jacobian == 0  # dense


@pytest.mark.parametrize(("robot", "timestep", "frame_skip"), [("ant", 0.01, 1), ("snake", 0.005, 10)])
def test_fast_physics_is_another_integrator_over_the_same_time(robot, timestep, frame_skip):
    paper, fast = make(TASK[robot], 1, 0).physics, make(TASK[robot], 1, 0, physics="fast").physics
    assert (fast.model.opt.timestep, fast.model.opt.integrator, fast.frame_skip) == (timestep, 3, frame_skip)
    assert timestep * frame_skip == pytest.approx(paper.model.opt.timestep * paper.frame_skip)
    assert np.array_equal(fast.model.body_mass, paper.model.body_mass)


@pytest.mark.parametrize(
    ("robot", "joints", "limit", "gears"),
    [
        ("ant", "hip_4 ankle_4 hip_1 ankle_1 hip_2 ankle_2 hip_3 ankle_3", 1, [30] * 8),
        ("snake", "rot2 rot3 rot4 rot5", 50, [1] * 4),
        ("hopper", "thigh leg foot", 200, [1] * 3),
        ("half_cheetah", "bthigh bshin bfoot fthigh fshin ffoot", 1, [120, 90, 60, 120, 60, 30]),
    ],
)
def test_actuators_have_the_original_order_ranges_and_gears(robot, joints, limit, gears):
    model = model_of(robot)
    assert [model.joint(j).name for j in model.actuator_trnid[:, 0]] == joints.split()  # what is moved, not a name
    assert model.actuator_gear[:, 0].tolist() == gears
    assert model.actuator_ctrlrange.tolist() == [[-limit, limit]] * len(gears)
    assert model.actuator_ctrllimited.all()


def test_joint_ranges_damping_stiffness_and_armature():
    degrees = lambda model, name: np.degrees(model.joint(name).range).round(6).tolist()  # noqa: E731
    ant, hopper, cheetah = model_of("ant"), model_of("hopper"), model_of("half_cheetah")
    assert [degrees(ant, f"hip_{i}") for i in (1, 2, 3, 4)] == [[-30, 30]] * 4
    assert [degrees(ant, f"ankle_{i}") for i in (1, 2, 3, 4)] == [[30, 70], [-70, -30], [-70, -30], [30, 70]]
    assert [degrees(model_of("snake"), f"rot{i}") for i in (2, 3, 4, 5)] == [[-100, 100]] * 4
    assert degrees(hopper, "thigh") == degrees(hopper, "leg") == [-150, 0]
    assert degrees(hopper, "foot") == [-45, 45]
    ranges = [[-0.52, 1.05], [-0.785, 0.785], [-0.4, 0.785], [-1, 0.7], [-1.2, 0.87], [-0.5, 0.5]]
    assert cheetah.jnt_range[3:].tolist() == ranges
    for robot, free in (("ant", 1), ("snake", 3), ("hopper", 3), ("half_cheetah", 3)):  # the root's joints
        limited = model_of(robot).jnt_limited.tolist()
        assert limited == [0] * free + [1] * (len(limited) - free)
    assert cheetah.jnt_stiffness[3:].tolist() == [240, 180, 120, 180, 120, 60]
    assert cheetah.dof_damping.tolist() == [0, 0, 0, 6, 4.5, 3, 4.5, 3, 1.5]
    assert ant.dof_damping.tolist() == [0] * 6 + [1] * 8
    assert ant.dof_armature.tolist() == [0] * 6 + [1] * 8
    assert hopper.dof_armature.tolist() == [0, 0, 0, 1, 1, 1]
    assert not model_of("snake").dof_damping.any()


def test_initial_centres_of_mass():
    for robot, expected in {"hopper": [0.0218, 0, 0.5964], "snake": [-1, 0, 0]}.items():
        env = make(TASK[robot], 1, 0)
        physics, model = env.physics, env.physics.model
        physics.reset(np.array([0]), model.qpos0[None], np.zeros((1, model.nv)))
        physics.forward(np.array([0]))
        assert physics.com[0] == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize(
    ("name", "robot_size", "size"),
    [("ant_gather", 27, 47), ("snake_gather", 17, 37), ("block_hopper", 14, 22), ("block_half_cheetah", 20, 28)],
)
def test_observations_have_the_papers_sizes(name, robot_size, size):
    env = make(name, 1, 0)
    assert (env.robot_size, env.single_observation_space.shape) == (robot_size, (size,))
    assert len(set(env.observation_names)) == size
    assert make("snake_gather", 1, 0, observation="ego").robot_size == 12


@pytest.mark.parametrize(
    ("name", "entries"),
    [
        ("ant_gather", {"z": ("qpos", 2), "hip_1": ("qpos", 7), "x_velocity": ("qvel", 0)}),
        ("snake_gather", {"x": ("qpos", 0), "heading": ("qpos", 2), "rot5_velocity": ("qvel", 6)}),
        ("block_hopper", {"z": ("qpos", 0), "pitch": ("qpos", 2), "x_velocity": ("qvel", 1)}),
        ("block_half_cheetah", {"z": ("qpos", 1), "pitch": ("qpos", 2), "ffoot": ("qpos", 8)}),
    ],
)
def test_observation_entries_hold_what_their_names_say(name, entries):
    env = make(name, 3, 0)
    obs, _ = env.reset(seed=1)
    for entry, (field, index) in entries.items():
        column = env.observation_names.index(entry)
        np.testing.assert_allclose(obs[:, column], getattr(env.physics, field)[:, index].astype(np.float32))
    if "com_x" in env.observation_names:
        com = env.physics.com[:, 0]
        np.testing.assert_allclose(obs[:, env.observation_names.index("com_x")], com.astype(np.float32))


def test_the_snake_touches_nothing_unless_its_walls_are_switched_on():
    def x_of_head_after_a_push(**options):
        env = make("snake_gather", 1, 0, **options)
        env.reset(seed=0)
        env.physics.qpos[:] = [[4.5, 0, 0, 0, 0, 0, 0]]  # the head at x = 6.0, the wall's face at 6.5
        env.physics.qvel[:] = [[20.0, 0, 0, 0, 0, 0, 0]]
        for _ in range(10):
            env.step(np.zeros((1, 4)))
        return env.physics.qpos[0, 0] + 1.5

    assert x_of_head_after_a_push() > 7.0
    assert x_of_head_after_a_push(walls=True) < 6.6


@pytest.mark.parametrize("physics", ["paper", "fast"])
def test_the_low_gear_ant_stays_alive_under_unit_noise(physics):
    env = make("ant_gather", 8, 0, physics=physics)
    env.reset(seed=0)
    rng, start = np.random.default_rng(0), env.physics.qpos[:, :2].copy()
    for _ in range(300):
        _, _, terminated, _, _ = env.step(rng.standard_normal((8, 8)))
        assert not terminated.any()
    assert (np.linalg.norm(env.physics.qpos[:, :2] - start, axis=1) > 1e-3).all()  # and it does move
