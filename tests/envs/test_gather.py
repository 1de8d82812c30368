"""The Gather task: lidar against a slow loop, catching, placement, death and the velocity penalty."""

import math

import mujoco
import numpy as np
import pytest

from hippo.envs import gather, make


def slow_lidar(com, yaw, objects, present):
    """One robot, one object at a time, nearest object last, as one would write it first."""
    out = np.zeros(20)
    nearest = np.full(20, np.inf)
    for o in range(16):
        if not present[o]:
            continue
        dx, dy = objects[o] - com
        distance = math.hypot(dx, dy)
        if distance > 6:
            continue
        angle = math.atan2(dy, dx) - yaw
        while angle <= -math.pi:
            angle += 2 * math.pi
        while angle > math.pi:
            angle -= 2 * math.pi
        slot = min(int((angle + math.pi) // math.radians(36)), 9) + (10 if o >= 8 else 0)
        if distance < nearest[slot]:
            nearest[slot], out[slot] = distance, 1 - distance / 6
    return out


def vectorised_lidar(com, yaw, objects, present):
    """All robots and objects at once by numpy, whose every bit the kernel must give."""
    offset = objects - com[:, None]
    reading = np.where(present, np.maximum(1 - np.sqrt((offset * offset).sum(-1)) / 6, 0), 0)
    turn = (np.arctan2(offset[..., 1], offset[..., 0]) - yaw[:, None] + np.pi) % (2 * np.pi)
    bins = np.where(turn == 0, 9, np.minimum((turn * (10 / (2 * np.pi))).astype(int), 9))
    out = np.zeros((len(com), 20))
    np.maximum.at(out, (np.arange(len(com))[:, None], bins + np.repeat([0, 10], 8)), reading)
    return out


def scene(*objects, yaw=0.0):
    """Lidar of one robot at the origin; `objects` are (kind, x, y)."""
    positions, present = np.zeros((1, 16, 2)), np.zeros((1, 16), bool)
    used = {"apple": 0, "bomb": 8}
    for kind, x, y in objects:
        positions[0, used[kind]], present[0, used[kind]] = (x, y), True
        used[kind] += 1
    return gather.lidar(np.zeros((1, 2)), np.array([yaw]), positions, present)[0]


def test_lidar_equals_a_slow_loop_on_random_scenes():
    rng = np.random.default_rng(0)
    com, yaw = rng.uniform(-6, 6, (200, 2)), rng.uniform(-20, 20, 200)
    objects, present = rng.uniform(-7, 7, (200, 16, 2)), rng.random((200, 16)) < 0.7
    fast = gather.lidar(com, yaw, objects, present)
    slow = np.array([slow_lidar(*each) for each in zip(com, yaw, objects, present, strict=True)])
    np.testing.assert_allclose(fast, slow, rtol=0, atol=1e-12)
    assert (gather.lidar(com, yaw + math.pi, objects, present) != slow).any()  # bins counted from ahead


def test_lidar_has_the_bits_of_numpy_also_where_bins_meet():
    rng, n = np.random.default_rng(1), 20_000
    objects, present = rng.uniform(-7, 7, (n, 16, 2)), rng.random((n, 16)) < 0.9
    com, yaw = rng.uniform(-6, 6, (n, 2)), rng.uniform(-20, 20, n)
    # Robots on the cells, turned by multiples of 18 degrees: objects on the borders of bins and exactly behind.
    com[::2], objects[::2], yaw[::2] = (
        np.rint(com[::2]),
        np.rint(objects[::2]),
        rng.integers(-40, 40, n // 2) * np.pi / 10,
    )
    fast = gather.lidar(com, yaw, objects, present)
    assert fast.tobytes() == vectorised_lidar(com, yaw, objects, present).tobytes()
    assert (fast > 0).mean() > 0.2


def test_bins_start_straight_behind_and_go_counter_clockwise():
    # At distance 3 the reading is 1 - 3/6 = 0.5. Angles from straight behind, counter-clockwise, 36 degrees a bin.
    for degrees, expected in ((1, 0), (35, 0), (37, 1), (179, 4), (181, 5), (359, 9)):
        angle = math.radians(degrees) - math.pi
        reading = scene(("apple", 3 * math.cos(angle), 3 * math.sin(angle)))
        assert np.flatnonzero(reading).tolist() == [expected]
        assert reading[expected] == pytest.approx(0.5)


def test_an_object_exactly_behind_belongs_to_the_last_bin():
    assert np.flatnonzero(scene(("bomb", -2.0, 0.0))).tolist() == [19]
    assert np.flatnonzero(scene(("bomb", -2.0, -0.0))).tolist() == [19]  # atan2 gives -pi instead of pi
    assert np.flatnonzero(scene(("bomb", 0.0, -2.0), yaw=math.pi / 2)).tolist() == [19]
    # A hair to the robot's right lies counter-clockwise of straight behind, a hair to its left closes the circle.
    assert np.flatnonzero(scene(("bomb", -2.0, -1e-9))).tolist() == [10]
    assert np.flatnonzero(scene(("bomb", -2.0, 1e-9))).tolist() == [19]


def test_the_lidar_turns_with_the_robot():
    assert np.flatnonzero(scene(("apple", 3.0, 0.1), yaw=0.0)).tolist() == [5]
    assert np.flatnonzero(scene(("apple", 3.0, 0.1), yaw=math.pi / 2)).tolist() == [2]  # now to its right
    assert np.flatnonzero(scene(("apple", 3.0, 0.1), yaw=math.pi / 2 + 6 * math.pi)).tolist() == [2]


def test_the_nearest_of_a_type_wins_types_do_not_hide_each_other_and_far_objects_are_unseen():
    reading = scene(("apple", 3.0, 0.1), ("apple", 1.5, 0.05), ("bomb", 4.5, 0.2), ("bomb", -6.1, 0.1))
    assert np.flatnonzero(reading).tolist() == [5, 15]
    assert reading[5] == pytest.approx(1 - math.hypot(1.5, 0.05) / 6)
    assert reading[15] == pytest.approx(1 - math.hypot(4.5, 0.2) / 6)


def test_objects_are_caught_within_one_metre_exclusive():
    objects = np.array([[[1.0, 0.0], [0.999, 0.0], [0.8, 0.59], [0.8, 0.61]] + [[9, 9]] * 12])
    caught = gather.catch(np.zeros((1, 2)), objects, np.ones((1, 16), bool))[0]
    assert caught[:4].tolist() == [False, True, True, False]
    just = np.array([[[math.nextafter(1.0, 0.0), 0.0], [0.0, -math.nextafter(1.0, 2.0)]] + [[9, 9]] * 14])
    assert gather.catch(np.zeros((1, 2)), just, np.ones((1, 16), bool))[0, :2].tolist() == [True, False]
    gone = np.ones((1, 16), bool)
    gone[0, 1] = False
    assert not gather.catch(np.zeros((1, 2)), objects, gone)[0, 1]


def test_an_ant_is_dead_outside_its_heights_and_at_none():
    heights = np.array([0.3, 1.0, math.nextafter(0.3, 0), math.nextafter(1.0, 2), math.nan, math.inf, -math.inf])
    assert gather.dead(heights).tolist() == [False, False, True, True, True, True, True]


@pytest.mark.parametrize("name", ["ant_gather", "snake_gather"])
def test_a_step_pays_for_and_removes_what_catch_says_unless_the_robot_is_dead(name):
    env, rng, n = make(name, 500, 0), np.random.default_rng(3), 500
    task = env.task
    task.objects[:], task.present[:] = rng.uniform(-2, 2, (n, 16, 2)), rng.random((n, 16)) < rng.random((n, 1))
    env.physics.qpos[:, 2] = rng.uniform(0.2, 1.1, n)
    present = task.present.copy()
    caught = gather.catch(task.com, task.objects, present)
    reward, terminated, terms = task.step()
    dies = (name == "ant_gather") & gather.dead(env.physics.qpos[:, 2])
    pay = caught[:, :8].sum(1) - caught[:, 8:].sum(1)
    assert np.array_equal(task.present, present & ~caught)
    assert np.array_equal(reward, np.where(dies, -10.0, pay))
    assert np.array_equal(terms["reward_objects"], np.where(dies, 0.0, pay))
    assert np.array_equal(terminated, dies | ~task.present.any(1))
    assert caught.sum() > 100
    assert terminated.sum() > 5


def test_placement_uses_distinct_cells_off_the_origin():
    for grid, count, reach in (("original", 35, 4), ("symmetric", 48, 6)):
        cells = gather.cells(grid)
        assert len(cells) == len(np.unique(cells, axis=0)) == count
        assert cells.min() == -6
        assert cells.max() == reach
        assert (np.abs(cells).sum(1) > 0).all()
        placed = gather.place(np.random.default_rng(0), cells)
        assert len(np.unique(placed, axis=0)) == 16


@pytest.mark.parametrize(("grid", "reaches_six"), [("original", False), ("symmetric", True)])
def test_placement_in_an_environment_reaches_plus_six_only_on_the_symmetric_grid(grid, reaches_six):
    env = make("snake_gather", 20, 0, grid=grid)
    seen = []
    for _ in range(5):
        env.reset()
        seen.append(env.task.objects.copy())
    seen = np.concatenate(seen)  # (100, 16, 2)
    assert all(len(np.unique(layout, axis=0)) == 16 for layout in seen)
    assert (np.abs(seen).max(-1) >= 2).all()  # never the origin
    assert seen.min() == -6
    assert bool((seen == 6).any()) is reaches_six
    assert len(np.unique(seen.reshape(100, -1), axis=0)) == 100  # every episode and environment has its own
    assert np.unique(seen[:, :8].reshape(-1, 2), axis=0).shape == np.unique(seen[:, 8:].reshape(-1, 2), axis=0).shape


def test_every_cell_is_about_equally_likely():
    rng, cells = np.random.default_rng(0), gather.cells("original")
    counts = {tuple(c): 0 for c in cells}
    for _ in range(2000):
        for c in gather.place(rng, cells):
            counts[tuple(c)] += 1
    expected = 2000 * 16 / 35
    assert max(abs(n - expected) for n in counts.values()) < 5 * math.sqrt(expected)


def at_objects(env, i, which):
    """Put objects `which` of simulation i on its robot and all others far away."""
    env.task.objects[i] = 50.0
    env.task.objects[i, which] = env.physics.com[i, :2]


def test_rewards_of_catching_add_up_and_nothing_comes_back():
    env = make("snake_gather", 2, 0)
    env.reset(seed=0)
    at_objects(env, 0, [0, 1, 8])  # two apples, one bomb
    at_objects(env, 1, [])
    _, reward, terminated, _, info = env.step(np.zeros((2, 4)))
    assert reward.tolist() == [1.0, 0.0]
    assert info["reward_objects"].tolist() == [1.0, 0.0]
    assert env.task.present.sum(1).tolist() == [13, 16]
    obs, reward, _, _, _ = env.step(np.zeros((2, 4)))  # the robot is still where they were
    assert reward.tolist() == [0.0, 0.0]
    assert not obs[:, env.robot_size :].any()  # and sees none of them
    env.task.present[0] = True
    assert env.step(np.zeros((2, 4)))[1].tolist() == [1.0, 0.0]  # had they come back, they would pay again
    assert not terminated.any()


def test_the_episode_ends_when_nothing_is_left():
    env = make("snake_gather", 2, 0)
    env.reset(seed=0)
    at_objects(env, 1, list(range(16)))
    _, reward, terminated, truncated, _ = env.step(np.zeros((2, 4)))
    assert reward[1] == 0.0  # 8 apples and 8 bombs
    assert terminated.tolist() == [False, True]
    assert not truncated.any()
    assert env.task.present.all()  # the next episode has new objects


@pytest.mark.parametrize(("z", "dies"), [(0.25, True), (0.35, False), (0.99, False), (1.02, True)])
def test_an_ant_dies_outside_its_heights_for_minus_ten_and_no_catch(z, dies):
    env = make("ant_gather", 2, 0)
    env.reset(seed=0)
    env.physics.qpos[0, 2], env.physics.qvel[0] = z, 0.0
    env.physics.forward(np.array([0]))
    at_objects(env, 0, [0])
    _, reward, terminated, truncated, info = env.step(np.zeros((2, 8)))
    assert terminated[0] == dies
    assert not truncated[0]
    assert reward[0] == (-10.0 if dies else 1.0)
    assert info["reward_death"][0] == (-10.0 if dies else 0.0)


def test_the_velocity_penalty_worked_by_hand():
    # Ant: 0 up to 1.2 m/s, then 0.001 + 0.0025 (v - 1.2): at 2.2 it is 0.0035. Snake: at 0.211, 0.001 + 0.0005 / 10.
    ant, snake = gather.PENALTIES["ant"], gather.PENALTIES["snake"]
    assert ant(np.array([0.0, 1.2, 2.2])).tolist() == pytest.approx([0.0, 0.0, 0.0035])
    assert ant(np.array([1.2 + 1e-9]))[0] == pytest.approx(0.001, abs=1e-9)  # it jumps by the bias
    assert snake(np.array([0.111, 0.211])).tolist() == pytest.approx([0.0, 0.00105])


def test_the_penalty_is_on_the_whole_robots_speed_and_is_subtracted_also_on_a_catch_and_on_death():
    env = make("ant_gather", 3, 0, velocity_penalty=True)
    env.reset(seed=0)
    env.physics.qvel[:] = 0.0
    env.physics.qvel[:, 0] = [5.0, 5.0, 0.0]
    env.physics.qpos[1, 2] = 2.0  # dead at once
    env.physics.forward(np.arange(3))
    at_objects(env, 0, [0])
    _, reward, _, _, info = env.step(np.zeros((3, 8)))
    penalty = info["velocity_penalty"]
    # The mass-weighted mean velocity of the bodies' centres, by MuJoCo's own routine on a copy.
    model, data = env.physics.model, env.physics.data(0)
    mujoco.mj_forward(model, data)
    mujoco.mj_subtreeVel(model, data)
    speed = np.linalg.norm(data.subtree_linvel[1])
    assert speed > 2
    assert penalty[0] == pytest.approx(0.001 + 0.0025 * (speed - 1.2), abs=1e-9)
    assert penalty[1] > 0.005
    assert penalty[2] == 0.0
    assert reward.tolist() == pytest.approx([1 - penalty[0], -10 - penalty[1], 0.0])


def test_a_layout_seed_fixes_objects_for_good_and_everywhere_but_not_the_pose():
    env = make("ant_gather", 3, 0, horizon=2)
    first, _ = env.reset(seed=1, options={"layout_seed": 7})
    layout = env.task.objects.copy()
    assert (layout == layout[0]).all()
    env.step(np.zeros((3, 8)))
    second = env.step(np.zeros((3, 8)))[0]  # every episode ended: these are the next ones' first observations
    assert np.array_equal(env.task.objects, layout)
    third, _ = env.reset()
    assert np.array_equal(env.task.objects, layout)
    for a, b in ((first, second), (second, third), (first[:1], first[1:2])):
        assert not np.array_equal(a[:, :27], b[:, :27])
    other = make("ant_gather", 2, 99)
    other.reset(options={"layout_seed": 7})
    assert np.array_equal(other.task.objects, layout[:2])
    other.reset(options={"layout_seed": 8})
    assert not (other.task.objects == layout[:2]).all()
    env.reset(options={"layout_seed": None})
    assert not (env.task.objects == layout).all()
