"""Environments of Gymnasium's registry as the learners see them: `gym:<id>`."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from experiments.config import ConfigError, compose_run
from experiments.train import execute, prepare
from hippo.core.rollout import Steps
from hippo.envs import environment, foreign, layout, make
from hippo.envs.foreign import EnvironmentFault, Refused


class Counting(gym.Env):
    """Observes how many steps the episode and the whole life have had; every third step ends it, if `ends`."""

    observation_space = gym.spaces.Dict(
        {
            "target": gym.spaces.Box(-9.0, 9.0, (2,)),
            "episode": gym.spaces.Box(-np.inf, np.inf, (1,)),
            "life": gym.spaces.Box(-np.inf, np.inf, (1,)),
        }
    )
    action_space = gym.spaces.Box(np.array([-2.0, 0.0]), np.array([2.0, 10.0]), dtype=np.float64)

    def __init__(self, ends=True, broken_at=10**9, reward=1.0):
        self.ends, self.broken_at, self.reward = ends, broken_at, reward
        self.life, self.actions = 0, []

    def observe(self):
        episode = np.nan if self.episode >= self.broken_at else self.episode
        parts = {"target": self.target, "episode": np.array([episode]), "life": np.array([self.life])}
        return {key: part.astype(np.float32) for key, part in parts.items()}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.episode, self.target = 0, self.np_random.uniform(-9, 9, 2)
        return self.observe(), {}

    def step(self, action):
        assert self.action_space.contains(action), action
        self.actions.append(action)
        self.episode, self.life = self.episode + 1, self.life + 1
        return self.observe(), self.reward, self.ends and self.episode == 3, False, {"extra": 1.0}


@pytest.fixture(autouse=True)
def registered():
    gym.register("Counting-v0", Counting, max_episode_steps=5)
    gym.register("Endless-v0", Counting)
    yield
    for name in ("Counting-v0", "Endless-v0"):
        del gym.registry[name]
    foreign._layout.cache_clear()


def column(envs, name):
    return envs.observation_names.index(name)


def test_no_step_is_recorded_that_the_environment_did_not_take():
    envs = make("gym:Counting-v0", 2, 0)
    life = column(envs, "life[0]")
    obs, _ = envs.reset(seed=0)
    for t in range(1, 8):
        obs, reward, terminated, _, info = envs.step(np.zeros((2, 2)))
        last = np.where(terminated[:, None], info.get("final_obs", obs), obs)
        assert (last[:, life] == t).all()
        assert (reward == 1).all()
        assert (obs[:, column(envs, "episode[0]")] == t % 3).all()
    # Gymnasium's default would have: of seven steps two were the resets after the third and the sixth.
    plain = SyncVectorEnv([lambda: gym.make("Counting-v0")], autoreset_mode=AutoresetMode.NEXT_STEP)
    plain.reset()
    for _ in range(8):
        obs, *_ = plain.step(np.array([[0.0, 5.0]]))
    assert obs["life"] == 6


@pytest.mark.parametrize(("action", "expected"), [(-9.0, [-2, 0]), (0.0, [0, 5]), (0.5, [1, 7.5]), (3.1, [2, 10])])
def test_actions_reach_the_environment_scaled_and_in_bounds(action, expected):
    envs = make("gym:Counting-v0", 1, 0)
    envs.reset(seed=0)
    envs.step(np.full((1, 2), action))
    assert envs.envs.envs[0].unwrapped.actions[-1].tolist() == expected


def recorded(bootstrap, **kwargs):
    steps = Steps(make("gym:Counting-v0", 1, 0, kwargs=kwargs), 5, bootstrap)
    steps.reset(0)
    for t in range(5):
        steps.step(t, np.zeros((1, 2), np.float32))
    return steps


def test_a_time_limit_is_bootstrapped_and_an_end_is_not():
    limited = recorded(True, ends=False)
    assert limited.done[:, 0].tolist() == [False] * 4 + [True]
    assert not limited.terminated.any()
    (obs,), step, _ = limited.final()
    assert 5 in obs  # the observation at the limit, not the first of the next episode
    assert step.tolist() == [4]
    ended = recorded(True)
    assert ended.terminated[:, 0].tolist() == [False, False, True, False, False]
    of_the_paper = recorded(False, ends=False)  # whose horizon nothing follows
    assert of_the_paper.terminated[:, 0].tolist() == [False] * 4 + [True]
    assert len(of_the_paper.final()[1]) == 0


def test_an_end_at_the_time_limit_is_an_end():
    envs = make("gym:Counting-v0", 1, 0, horizon=3)
    envs.reset(seed=0)
    for _ in range(3):
        _, _, terminated, truncated, _ = envs.step(np.zeros((1, 2)))
    assert (terminated.tolist(), truncated.tolist()) == ([True], [False])


@pytest.mark.parametrize(
    ("view", "size", "names"),
    [
        ("", 4, ["episode[0]", "life[0]", "target[0]", "target[1]"]),
        ("target", 2, ["target[0]", "target[1]", "episode[0]", "life[0]"]),
        ("1:3", 2, ["life[0]", "target[0]", "episode[0]", "target[1]"]),
        ("target[1], 0", 2, ["target[1]", "episode[0]", "life[0]", "target[0]"]),
    ],
)
def test_skills_see_the_first_entries_of_a_row(view, size, names):
    envs = make("gym:Counting-v0", 2, 0, skill_view=view)
    assert envs.observation_names == names
    assert envs.robot_size == size
    obs, _ = envs.reset(seed=3)
    single = gym.make("Counting-v0")
    for i in range(2):
        flat, _ = single.reset(seed=3 + i)
        values = {"episode[0]": 0, "life[0]": 0, "target[0]": flat["target"][0], "target[1]": flat["target"][1]}
        assert obs[i].tolist() == [values[name] for name in names]


def test_the_same_seed_gives_the_same_batch_whatever_came_before():
    envs = make("gym:Counting-v0", 3, 7)
    first = [envs.reset(seed=5)[0], *(envs.step(np.zeros((3, 2)))[0] for _ in range(4))]
    again = [envs.reset(seed=5)[0], *(envs.step(np.zeros((3, 2)))[0] for _ in range(4))]
    life = column(envs, "life[0]")
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(np.delete(a, life, 1), np.delete(b, life, 1))


def test_our_own_registered_environments_come_by_their_own_vector_environment():
    ours, direct = make("gym:hippo/BlockHopper-v0", 2, 5), make("block_hopper", 2, 5)
    np.testing.assert_array_equal(ours.reset(seed=1)[0], direct.reset(seed=1)[0])
    action = np.full((2, 3), 0.25)
    for _ in range(20):
        a, b = ours.step(action), direct.step(action)
        np.testing.assert_array_equal(a[0], b[0])
        np.testing.assert_array_equal(a[1], b[1])


@pytest.mark.parametrize(("kwargs", "fault"), [({"broken_at": 2}, "observation"), ({"reward": np.inf}, "reward")])
def test_what_is_not_finite_is_named_with_place_and_time(kwargs, fault):
    gym.register("Broken-v0", lambda: Counting(**kwargs), max_episode_steps=5)
    envs = make("gym:Broken-v0", 2, 0)
    envs.reset(seed=0)
    if fault == "observation":
        envs.step(np.zeros((2, 2)))
    step = 2 if fault == "observation" else 1
    with pytest.raises(EnvironmentFault, match=f"gym:Broken-v0: {fault} of environment 0 is not finite at step {step}"):
        envs.step(np.zeros((2, 2)))
    del gym.registry["Broken-v0"]


def refused(*overrides):
    with pytest.raises(ConfigError) as error:
        compose_run(list(overrides))
    return str(error.value)


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["env=gym:Hoper-v5"], "env=gym:Hoper-v5: no such id is registered; did you mean Hopper-v5"),
        (["env=gym:Hopper"], "did you mean Hopper-v5"),
        (["env=gym:MiniGrid-Empty-5x5-v0"], "pip install minigrid"),
        (["env=gym:no_such_module:X-v0"], "No module named 'no_such_module'"),
        (["env=gym:CartPole-v1"], "acts in Discrete(2); policies here act in a Box of one dimension"),
        (["env=gym:Blackjack-v1", "env.horizon=9"], "observes Tuple; valid are Boxes"),
        (["env=gym:Endless-v0"], "env.horizon=???: must be given: Endless-v0 has no registered time limit"),
        (["env=gym:Counting-v0", "env.kwargs={foo: 1}"], 'env.kwargs={"foo": 1}: gym:Counting-v0 does not take them'),
        (["env=gym:Counting-v0", "env.skill_view=2:9"], "env.skill_view=2:9: must list entries below 4"),
        (["env=gym:Counting-v0", "env.skill_view=0,0"], "each once; the parts are episode, life, target"),
        (["env=gym:Counting-v0", "env.physics=fast"], "env.physics=fast: gym:Counting-v0 has no such option"),
        (["env=gym:Counting-v0", "algo=snn"], "algo=snn: makes skills of the robots here"),
        (["env=gym:Counting-v0", "algo.skills=pretrained"], "algo.skills=pretrained: there are none"),
        (["env=gym:Hopper-v5", "algo=hiro"], "algo.goal_space=body: must list entries below 11"),
        (["env=gym:Hopper-v5", "algo=hiro", "algo.goal_space=11"], "algo.goal_space=11: must list entries below 11"),
        (["env=block_hopper", "algo=hiro", "algo.goal_space=0:2"], "algo.goal_space=0:2: must be one of body, xy"),
        (["env=block_hopper", "env.skill_view=0:2"], "env.skill_view=0:2: block_hopper has no such option"),
        (["env=gym"], "gym:<id>"),
    ],
)
def test_what_cannot_be_trained_is_refused_by_name(overrides, words):
    assert words in refused(*overrides)


def test_unbounded_actions_and_pictures_are_refused():
    with pytest.raises(Refused, match="valid are bounded actions"):
        layout._action_range("gym:X", gym.spaces.Box(-np.inf, np.inf, (2,)))
    with pytest.raises(Refused, match=r"observes Box; valid are Boxes of one dimension"):
        list(layout._parts("gym:X", gym.spaces.Box(0, 255, (9, 9, 3), np.uint8)))


def test_the_run_id_holds_the_id_the_package_and_the_arguments():
    run = compose_run(["env=gym:Hopper-v5"])
    assert run.identity["env"] == "gym:Hopper-v5"
    assert run.identity["package"] == f"gymnasium {gym.__version__}"
    others = [["env=gym:Walker2d-v5"], ["env=gym:Hopper-v5", "env.kwargs={ctrl_cost_weight: 0.1}"]]
    others += [["env=gym:Hopper-v5", "env.skill_view=0:5"], ["env=gym:Hopper-v5", "env.horizon=500"]]
    assert len({run.run_id, *(compose_run(other).run_id for other in others)}) == 5
    assert type(run).from_yaml(run.to_yaml(), run.runs_dir).run_id == run.run_id
    assert environment("gym:Counting-v0").package == Counting.__module__  # of no installed package


def test_a_time_limit_is_bootstrapped_by_default_here_and_not_on_the_tasks_of_the_paper():
    assert compose_run(["env=gym:Hopper-v5"]).config.bootstrap_horizon
    assert not compose_run(["env=gym:Hopper-v5", "algo.bootstrap_horizon=false"]).config.bootstrap_horizon
    assert not compose_run(["env=block_hopper"]).config.bootstrap_horizon


LEARNERS = {
    "hippo": ["algo.period_min=2", "algo.period_max=4"],
    "ppo": [],
    "hier_vpg": ["algo.period_min=2", "algo.period_max=4"],
    "mlsh": ["algo.period_min=2", "algo.period_max=2"],
    "option_critic": [],
    "hiro": ["algo.goal_space=episode,target", "algo.warmup_steps=10", "algo.period=2", "algo.minibatch_size=8"],
}


@pytest.mark.parametrize("algo", LEARNERS)
def test_every_learner_trains_on_it_and_is_evaluated(tmp_path, algo):
    from experiments.evaluate import evaluate

    settings = ["scale=smoke", "iterations=2", "batch_size=40", f"runs_dir={tmp_path}", *LEARNERS[algo]]
    if algo in ("hippo", "ppo"):
        settings += ["protocol=modern", "algo.minibatch_size=16"]
    run = compose_run(["env=gym:Counting-v0", "env.skill_view=target", f"algo={algo}", *settings])
    assert run.config.horizon == 5
    assert execute(run) == "finished"
    rows = evaluate(run, 3, 0)
    assert [(row["return"], row["length"]) for row in rows] == [(3.0, 3)] * 3  # three steps of reward one


def test_a_fault_of_the_environment_ends_the_run_in_one_line(tmp_path, capsys):
    gym.register("Broken-v0", lambda: Counting(broken_at=2), max_episode_steps=5)
    run = compose_run(["env=gym:Broken-v0", "scale=smoke", "batch_size=20", f"runs_dir={tmp_path}"])
    assert execute(run) == "failed"
    said = capsys.readouterr().err
    assert "error: gym:Broken-v0: observation of environment 0 is not finite at step 2" in said
    assert "Traceback" not in said
    del gym.registry["Broken-v0"]


def test_training_environments_are_independent_of_their_number(tmp_path):
    run = compose_run(["env=gym:Counting-v0", "scale=smoke", "batch_size=20"])
    few, many = prepare(run)(2, "training"), prepare(run)(4, "training")
    np.testing.assert_array_equal(few.reset(seed=9)[0], many.reset(seed=9)[0][:2])
    assert torch.get_num_threads() == 1


def test_a_maze_of_gymnasium_robotics_is_found_by_its_id_and_trains(tmp_path):
    pytest.importorskip("gymnasium_robotics")
    maze = ["env=gym:AntMaze_UMaze-v5", "env.skill_view=observation", "env.horizon=20", "batch_size=40"]
    run = compose_run([*maze, "scale=smoke", "iterations=1", f"runs_dir={tmp_path}"])
    assert run.identity["package"].startswith("gymnasium-robotics ")
    assert execute(run) == "finished"
    envs = prepare(run)(1, "training")
    assert envs.observation_names[envs.robot_size :] == [
        f"{goal}_goal[{i}]" for goal in ("achieved", "desired") for i in (0, 1)
    ]
