"""What skills see with `skill_observation=ego`: the same, and so do the same, wherever a robot stands and faces."""

import mujoco
import numpy as np
import pytest
import torch

from baselines import hiro, option_critic, snn
from experiments.config import compose_run
from hippo import hippo
from hippo.core.checkpoint import Checkpoint
from hippo.core.hierarchy import HierarchicalPolicy
from hippo.core.log import RunLog
from hippo.core.policies import SkillPolicy
from hippo.core.rollout import Steps
from hippo.core.settings import ConfigError
from hippo.core.skills import SkillsError, load_skills, policy_of, save_skills
from hippo.core.view import Ego
from hippo.envs import make
from hippo.envs.robots import ROBOTS

X_OF = {"hopper": 1, "half_cheetah": 0}  # where qpos has x; they cannot turn


def rotation(angle):
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def product(p, q):
    """Of quaternions (w, x, y, z)."""
    (a, b, c, d), (w, x, y, z) = p, q
    return np.array(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ]
    )


def moved(robot, qpos, qvel, angle, shift):
    """The same pose and motion, turned about the origin by `angle` and then moved by `shift`."""
    qpos, qvel, turn = qpos.copy(), qvel.copy(), rotation(angle)
    if robot in X_OF:
        qpos[X_OF[robot]] += shift[0]
        return qpos, qvel
    qpos[:2], qvel[:2] = turn @ qpos[:2] + shift, turn @ qvel[:2]
    if robot == "snake":
        qpos[2] += angle
    else:
        qpos[3:7] = product([np.cos(angle / 2), 0, 0, np.sin(angle / 2)], qpos[3:7])
    return qpos, qvel


def observed(robot, variant, data):
    """Names and entries of the robot's observation of a state, in double precision."""
    sources = {"qpos": data.qpos, "qvel": data.qvel, "com": data.subtree_com[0]}
    quantities = ROBOTS[robot].observations[variant]
    names = [name for q in quantities for name in q.names]
    return names, np.array([sources[q.source][i] for q in quantities for i in q.index])


@pytest.mark.parametrize(
    ("robot", "variant"),
    [("ant", "paper"), ("snake", "paper"), ("snake", "ego"), ("hopper", "paper"), ("half_cheetah", "paper")],
)
def test_a_robot_that_is_moved_and_turned_acts_the_same(robot, variant):
    model = ROBOTS[robot].spec("paper").compile()
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    start = model.key_qpos[0] if model.nkey else model.qpos0
    for _ in range(20):
        qpos, qvel = start + 0.3 * rng.standard_normal(model.nq), rng.standard_normal(model.nv)
        if robot == "ant":
            qpos[3:7] /= np.linalg.norm(qpos[3:7])
        angle, shift = (0.0 if robot in X_OF else rng.uniform(-7, 7)), rng.uniform(-6, 6, 2)
        seen, com = [], []
        for state in ((qpos, qvel), moved(robot, qpos, qvel, angle, shift)):
            data.qpos[:], data.qvel[:] = state
            mujoco.mj_forward(model, data)
            names, entries = observed(robot, variant, data)
            seen.append(torch.from_numpy(entries)[None])
            com.append(data.subtree_com[0].copy())
        there = rotation(angle) @ com[0][:2] + (shift if robot not in X_OF else [shift[0], 0])
        np.testing.assert_allclose(com[1][:2], there, rtol=0, atol=1e-12)  # it is the frame that was moved
        ego = Ego(names)
        np.testing.assert_allclose(ego(seen[1]), ego(seen[0]), rtol=0, atol=1e-11)
        policy = SkillPolicy(ego.size, 6, model.nu, [64, 64], torch.Generator().manual_seed(1)).double()
        torch.testing.assert_close(policy.means(ego(seen[1])), policy.means(ego(seen[0])), rtol=0, atol=1e-10)
        whole = SkillPolicy(len(names), 6, model.nu, [64, 64], torch.Generator().manual_seed(1)).double()
        assert (whole.means(seen[1]) - whole.means(seen[0])).abs().max() > 1e-3  # as skills saw until now


def test_what_is_left_out_and_what_is_kept():
    kept = {}
    for robot, of in ROBOTS.items():
        names = [name for q in of.observations["paper"] for name in q.names]
        kept[robot] = [names[i] for i in Ego(names).kept]
        assert not {"x", "y", "com_x", "com_y", "heading"} & set(kept[robot])
    assert kept["hopper"][:5] == ["z", "pitch", "thigh", "leg", "foot"]
    assert len(kept["ant"]) == 27
    assert kept["snake"][:6] == ["rot2", "rot3", "rot4", "rot5", "x_velocity", "y_velocity"]


def test_a_heading_of_a_quarter_turn_worked_by_hand():
    # Facing along y and moving along y is moving forward; to the side along -x is to the left.
    ego = Ego(["heading", "x_velocity", "y_velocity"])
    seen = ego(torch.tensor([[np.pi / 2, 0.0, 2.0], [np.pi / 2, -3.0, 0.0], [0.0, 1.0, 0.0]], dtype=torch.float64))
    np.testing.assert_allclose(seen, [[2, 0], [0, 3], [1, 0]], rtol=0, atol=1e-12)
    # A yaw of 90 degrees is (cos 45, 0, 0, sin 45); turned back it is no rotation, whichever sign it comes with.
    half = np.sqrt(0.5)
    ego = Ego(["quat_w", "quat_x", "quat_y", "quat_z"])
    seen = ego(torch.tensor([[half, 0, 0, half], [-half, 0, 0, -half]], dtype=torch.float64))
    np.testing.assert_allclose(seen, [[1, 0, 0, 0], [1, 0, 0, 0]], rtol=0, atol=1e-12)


def test_what_acts_and_what_learns_see_the_same():
    envs = make("snake_gather", 3, 0, horizon=20, physics="fast")
    config = hippo.HippoConfig(iterations=1, batch_size=60, horizon=20, skill_observation="ego")
    sizes = envs.single_observation_space.shape[0], envs.robot_size, envs.single_action_space.shape[0]
    policy = HierarchicalPolicy(config, *sizes, torch.Generator().manual_seed(0), envs.observation_names)
    batch = hippo.collect(policy, envs, config, 0, 0, greedy=True)
    obs, time_left, skill = batch.steps.obs[:-1], batch.time_left[:-1], batch.skill[:-1]
    seen = policy.skill_input(obs, time_left)
    assert seen.shape[-1] == policy.skill_view + 1 == envs.robot_size - 5 + 1
    mean = policy.skills.means(seen.flatten(0, 1))[torch.arange(60), skill.flatten()]
    torch.testing.assert_close(batch.steps.action.flatten(0, 1), mean, rtol=1e-5, atol=1e-5)
    assert policy.manager_input(obs, time_left).shape[-1] == sizes[0] + 1  # the manager sees everything


def pretrained(tmp_path, view):
    """A skills file of the Snake that was hardly trained."""
    config = snn.SNNConfig(iterations=1, batch_size=40, horizon=20, skill_observation=view)
    checkpoint = Checkpoint(tmp_path / view)

    def make_envs(num_envs, purpose):
        return make("snake", num_envs, 0, horizon=20, physics="fast")

    snn.train(config, make_envs, RunLog(tmp_path / view), 0, checkpoint)
    policy, metadata = snn.skills(config, make_envs, checkpoint)
    save_skills(tmp_path / f"{view}.pt", policy, metadata | {"run_id": "0"})
    return tmp_path / f"{view}.pt", policy


def test_skills_made_with_a_view_are_adapted_with_it_and_with_no_other(tmp_path):
    path, source = pretrained(tmp_path, "ego")
    assert source.first.inputs == 12
    read, metadata = policy_of(path)
    assert metadata["view"] == "ego"
    obs = torch.randn(5, 17, generator=torch.Generator().manual_seed(0))
    assert torch.equal(read.see(obs), source.see(obs))
    envs = make("snake_gather", 2, 0, horizon=20, physics="fast")
    for view, fits in (("ego", True), ("robot", False)):
        config = hippo.HippoConfig(iterations=1, batch_size=40, horizon=20, skill_observation=view)
        sizes = envs.single_observation_space.shape[0], envs.robot_size, envs.single_action_space.shape[0]
        policy = HierarchicalPolicy(config, *sizes, torch.Generator(), envs.observation_names).skills
        if fits:
            load_skills(path, policy, "snake", "paper")
        else:
            with pytest.raises(SkillsError, match="its view is ego, the policy's robot"):
                load_skills(path, policy, "snake", "paper")
    with pytest.raises(ConfigError, match="has view ego, this run needs robot"):
        compose_run(["env=snake_gather", "algo=hippo", f"algo.skills={path}"])
    config = hippo.HippoConfig(iterations=1, batch_size=40, horizon=20, skill_observation="ego", skills=str(path))

    def make_envs(num_envs, purpose):
        return make("snake_gather", num_envs, 0, horizon=20, physics="fast")

    hippo.train(config, make_envs, RunLog(tmp_path / "run"), 0, Checkpoint(tmp_path / "run"))
    settings = {"cloning_steps": 20, "cloning_updates": 2, "hidden_sizes": [16, 16], "warmup_steps": 1000}
    cloned = hiro.HiroConfig(iterations=1, batch_size=20, horizon=20, skills=str(path), **settings)
    hiro.train(cloned, make_envs, RunLog(tmp_path / "hiro"), 0, Checkpoint(tmp_path / "hiro"))
    settings = {"skill_observation": "ego", "skills": str(path), "steps_per_update": 20, "num_skills": 6}
    options = option_critic.OptionCriticConfig(iterations=1, batch_size=40, horizon=20, **settings)
    option_critic.train(options, make_envs, RunLog(tmp_path / "oc"), 0, Checkpoint(tmp_path / "oc"))


def test_pretrained_skills_have_the_view_of_who_asks_for_them_and_defaults_keep_their_ids():
    run = compose_run(["env=snake_gather", "algo.skills=pretrained", "algo.skill_observation=ego"])
    assert run.pretraining.config.skill_observation == "ego"
    plain = compose_run(["env=snake_gather", "algo.skills=pretrained"])
    assert "skill_observation" not in plain.pretraining.identity["settings"]
    assert plain.pretraining.run_id != run.pretraining.run_id


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["protocol=modern", "algo.skill_observation=ego"], "needs normalize_observations=false"),
        (["env=gym:Hopper-v5", "algo.skill_observation=ego"], "valid here: robot, full"),
        (["algo=option_critic", "algo.skill_observation=ego"], "needs observation_filter=false"),
        (["algo.skill_observation=world"], "must be one of robot, ego, full"),
    ],
)
def test_a_view_that_cannot_be_is_refused_by_name(overrides, message):
    with pytest.raises(ConfigError, match=f"algo.skill_observation=.*{message}"):
        compose_run(overrides)


@pytest.mark.parametrize(("env", "options"), [("snake_gather", {}), ("block_hopper", {}), ("ant_gather", {})])
def test_hiro_without_x_and_y_knows_its_place_by_no_entry(env, options):
    envs = make(env, 4, 0, horizon=20, **options)
    agents = hiro.make_agents(hiro.HiroConfig(iterations=1, batch_size=80, horizon=20), envs, 0)
    obs = Steps(envs, 20).reset(0)
    there = obs.copy()
    where = [i for i, name in enumerate(envs.observation_names) if name in ("x", "y", "com_x", "com_y")]
    assert bool(where) == (env != "ant_gather")
    there[:, where] += 5.0
    obs, there = torch.from_numpy(obs), torch.from_numpy(there)
    goal = agents.new_goal(obs, None)
    assert torch.equal(agents.new_goal(there, None), goal)
    assert torch.equal(agents.act(there, goal, None), agents.act(obs, goal, None))
    rows = {"obs": obs, "next_obs": obs, "goal": goal, "next_goal": goal, "action": agents.act(obs, goal, None)}
    assert torch.equal(agents.low_input(rows["obs"], goal), agents.low_input(there, goal))


def test_hiro_that_is_given_x_and_y_sees_all_of_it():
    envs = make("snake_gather", 2, 0, horizon=20, position=True)
    config = hiro.HiroConfig(iterations=1, batch_size=40, horizon=20, goal_space="xy")
    agents = hiro.make_agents(config, envs, 0)
    obs = torch.from_numpy(Steps(envs, 20).reset(0))
    there = obs.clone()
    there[:, envs.observation_names.index("com_x")] += 5.0
    assert not torch.equal(agents.new_goal(there, None), agents.new_goal(obs, None))
