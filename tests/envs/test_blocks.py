"""The Block task: which wall is next, the ring of mocap bodies, rewards, and that the walls are really there."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from hippo.envs import blocks, make

TRACK = blocks.Track(first_wall=2.0, low=0.1, high=0.3)


def test_the_next_wall_is_the_first_whose_far_face_is_ahead():
    # Far faces at 2.05, 4.05, 6.05.
    x = np.array([-5.0, 0.0, 2.0, 2.04, 2.06, 4.0, 4.06, 6.1])
    assert blocks.next_wall(x, TRACK).tolist() == [0, 0, 0, 0, 1, 1, 2, 3]


def test_the_observation_of_both_walls_worked_by_hand():
    heights = np.tile(np.arange(512) / 100, (2, 1))
    out = blocks.observe(np.array([1.0, 5.0]), np.array([0, 2]), heights, TRACK)
    assert out[0].tolist() == [0.0, 0.1, 2.0, 1.0, 0, 0, 0, 0]  # nothing before the first wall
    assert out[1].tolist() == pytest.approx([0.02, 0.1, 6.0, 1.0, 0.01, 0.1, 4.0, -1.0])


def test_the_ring_holds_four_walls_behind_and_eight_ahead_each_in_its_own_slot():
    for ahead in (0, 3, 4, 5, 17, 100):
        index = blocks.ring_indices(np.array([ahead]))[0]
        start = max(ahead - 4, 0)
        assert sorted(index.tolist()) == list(range(start, start + 12))
        assert (index % 12 == np.arange(12)).all()  # a wall keeps its body while it stands


def test_heights_are_uniform_in_the_tracks_range():
    heights = blocks.draw_heights(np.random.default_rng(0), TRACK)
    assert heights.min() >= 0.1
    assert heights.max() <= 0.3
    assert heights.mean() == pytest.approx(0.2, abs=0.02)


def driven(xs, robot="hopper"):
    """Rewards of a Block task whose robot's centre of mass is moved along `xs`."""
    options = SimpleNamespace(terminate_on_fall=False, terminate_on_tumble=False)
    task = blocks.Blocks(SimpleNamespace(name=robot), options, 1)
    task.physics, task.com = SimpleNamespace(mocap_pos=np.zeros((1, 12, 3))), np.zeros((1, 3))
    task.reset(np.array([0]), [np.random.default_rng(0)])
    rewards = []
    for x in xs:
        task.com[0, 0] = x
        rewards.append(float(task.step()[0][0]))
    return rewards


def test_a_wall_pays_once_in_order_and_also_several_in_one_step():
    assert driven([0, 2.04, 2.06, 1.0, 2.06, 4.1, 0.0, 4.1]) == [0, 0, 1, 0, 0, 1, 0, 0]
    assert driven([6.1]) == [3]
    assert driven([-3.0, 0.0, 2.0]) == [0, 0, 0]  # reaching a wall does not pay
    back_and_forth = [2.06 if t % 2 else 0.0 for t in range(20)]
    assert sum(driven(back_and_forth)) == 1
    assert sum(np.diff([0, *blocks.next_wall(np.array(back_and_forth), TRACK)]) > 0) == 10  # without a memory
    assert driven(np.linspace(0, 100.06, 400)).count(1) == 50  # far faces at 2.05, ..., 100.05
    assert driven([1.5, 1.56], "half_cheetah") == [0, 1]  # its first far face is at 1.55


@pytest.mark.parametrize("name", ["block_hopper", "block_half_cheetah"])
def test_a_step_puts_the_ring_where_its_definition_says_and_only_where_a_wall_was_passed_or_left_behind(name):
    env, rng = make(name, 100, 0), np.random.default_rng(0)
    env.reset(seed=0)
    task, boxes = env.task, env.physics.mocap_pos
    for x in rng.uniform(-3, 30, (20, 100)) + np.arange(20)[:, None] * 60:  # beyond the 512 heights too
        boxes[:, :, 1] = 7.0  # a mark
        before = task.ahead.copy()
        task.com[:, 0] = np.where(rng.random(100) < 0.5, x, task.com[:, 0])
        task.step()
        expected = blocks.ring_positions(blocks.ring_indices(task.ahead), task.heights, task.track)
        assert np.array_equal(task.ahead, blocks.next_wall(task.com[:, 0], task.track))
        turned = task.ahead != before
        assert 0 < turned.sum() < 100
        assert np.array_equal(boxes[turned], expected[turned])
        assert np.array_equal(boxes[~turned][:, :, [0, 2]], expected[~turned][:, :, [0, 2]])
        assert (boxes[~turned][:, :, 1] == 7.0).all()


@pytest.mark.parametrize(("name", "first_wall"), [("block_hopper", 2.0), ("block_half_cheetah", 1.5)])
def test_a_probe_dropped_on_every_wall_rests_at_its_drawn_height(name, first_wall):
    """Also after a second reset and after the ring has turned."""
    env = make(name, 2, 0)
    env.reset(seed=1)
    seen = []
    for phase, first in (("first episode", 0), ("second episode", 0), ("turned ring", 6)):
        if phase == "second episode":
            env.reset()
        if phase == "turned ring":  # to 0.5 m before wall 10: walls 6 to 17 stand, walls 0 to 5 are gone
            env.physics.qpos[:, 1 if name == "block_hopper" else 0] += first_wall + 2 * 10 - 0.5
            env.physics.forward(np.arange(2))
            env.step(np.zeros(env.action_space.shape))
            assert env.task.ahead.tolist() == [10, 10]
        k = np.arange(first, first + 12)
        for i in range(2):
            expected = env.task.heights[i, k]
            np.testing.assert_allclose(drop(env, i, first_wall + 2.0 * k), expected, rtol=0, atol=3e-3)  # soft contacts
            np.testing.assert_allclose(rays(env, i, first_wall + 2.0 * k), expected, rtol=0, atol=1e-12)
            np.testing.assert_allclose(rays(env, i, first_wall + 2.0 * k + 0.06), 0, atol=1e-12)  # 0.05 m to a face
            seen.append(expected)
    if name == "block_hopper":  # where the ring has left, there is only floor
        np.testing.assert_allclose(drop(env, 0, 2.0 + 2.0 * np.arange(6)), 0, atol=3e-3)
    for i, a in enumerate(seen):  # otherwise old heights, or those of another simulation, would do
        assert all(np.abs(a - b).max() > 0.02 for b in seen[:i])


def drop(env, i, x, half=0.02):
    """Heights at which small boxes dropped from 0.4 m at `x` come to rest: simulation i's walls and free boxes."""
    spec = env.robot.spec("paper")
    spec.option.timestep = 0.004
    env.task.build(spec)
    for n, at in enumerate(x):
        body = spec.worldbody.add_body(name=f"probe_{n}", pos=[at, 2.0, 0.4 + half])
        body.add_freejoint()
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[half] * 3, density=500, condim=3)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.mocap_pos[:] = env.physics.mocap_pos[i]
    while data.time < 1.0:
        mujoco.mj_step(model, data)
    return np.array([data.body(f"probe_{n}").xpos[2] - half for n in range(len(x))])


def rays(env, i, x):
    """Heights at which rays straight down at `x`, beside the robot, meet simulation i itself."""
    data, geom = env.physics.data(i), np.zeros(1, np.int32)
    mujoco.mj_kinematics(env.physics.model, data)
    down = np.array([0.0, 0.0, -1.0])
    return np.array(
        [1 - mujoco.mj_ray(env.physics.model, data, np.array([at, 2.0, 1.0]), down, None, 1, -1, geom) for at in x]
    )


@pytest.mark.parametrize(("height", "passes"), [(0.9, False), (0.001, True)])
def test_a_pushed_robot_passes_low_walls_and_is_held_by_high_ones(height, passes, monkeypatch):
    monkeypatch.setitem(blocks.TRACKS, "half_cheetah", blocks.Track(1.5, height, height))
    env = make("block_half_cheetah", 10, 0)
    env.reset(seed=0)
    rng, total = np.random.default_rng(0), 0.0
    for t in range(200):
        if t % 20 == 0:
            env.physics.qvel[:, 0] = 3.0
        total += env.step(rng.standard_normal((10, 6)))[1].sum()
    assert total > 20 if passes else total == 0


def test_nothing_but_the_horizon_ends_an_episode_unless_falling_does():
    for terminate, expected in ((False, False), (True, True)):
        env = make("block_hopper", 4, 0, terminate_on_fall=terminate)
        env.reset(seed=0)
        rng, ended = np.random.default_rng(0), False
        for _ in range(60):
            _, _, terminated, truncated, _ = env.step(rng.standard_normal((4, 3)))
            ended |= bool(terminated.any())
            assert not truncated.any()
        assert ended is expected


@pytest.mark.parametrize("name", ["block_hopper", "block_half_cheetah"])
@pytest.mark.parametrize("option", ["terminate_on_tumble", "terminate_on_fall", None])
def test_a_tumble_ends_the_episode_where_asked_to_and_its_wall_is_paid(name, option):
    env = make(name, 4, 0, **({option: True} if option else {}))
    env.reset(seed=0)
    env.physics.qpos[:, 2] = [0.97, 1.1, -0.97, -1.1]  # the pitch moves by less than 0.03 rad in a step
    env.physics.qvel[:] = 0.0
    env.physics.qpos[:, 0 if name == "block_half_cheetah" else 1] = 2.9  # the first wall is behind
    env.physics.forward(np.arange(4))
    _, reward, terminated, truncated, _ = env.step(np.zeros(env.action_space.shape))
    tumbled, fallen = [False, True, False, True], [name == "block_hopper"] * 4
    expected = {"terminate_on_tumble": tumbled, "terminate_on_fall": fallen, None: [False] * 4}
    assert terminated.tolist() == expected[option]
    assert reward.tolist() == [1.0] * 4
    assert not truncated.any()
