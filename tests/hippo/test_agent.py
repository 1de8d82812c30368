"""A trained policy as an object: `hippo.load`, `Agent.act`, `Agent.save`, `hippo.train`."""

import copy
import json
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest

import hippo
from experiments.config import compose_run
from experiments.train import execute
from hippo.agent import AgentError, load, train
from hippo.core.acting import rollout
from hippo.core.checkpoint import Checkpoint
from hippo.envs import make
from hippo.hippo import HippoConfig
from hippo.learners import learner_of

SETTINGS = ["scale=smoke", "env.horizon=100", "batch_size=100", "iterations=2"]
LEARNERS = {
    "hippo": ["protocol=modern", "algo.minibatch_size=50"],
    "ppo": ["protocol=modern", "algo.minibatch_size=50", "algo.action_repeat=3"],
    "hier_vpg": [],
    "mlsh": [],
    "option_critic": [],
    "hiro": ["algo.warmup_steps=50", "algo.minibatch_size=8", "algo.hidden_sizes=[8,8]"],
}


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A finished run of every learner on the Block Hopper, trained when it is first asked for."""
    place, runs = tmp_path_factory.mktemp("runs"), {}

    def of(algo):
        if algo not in runs:
            run = compose_run([f"algo={algo}", *SETTINGS, *LEARNERS[algo], f"runs_dir={place}"])
            assert execute(run) == "finished"
            runs[algo] = run
        return runs[algo]

    return of


def acted(agent, envs, steps, seed, **how):
    """Actions (T, N, A) and dones of an agent in `envs`, whose first episodes are those of a roll-out with `seed`."""
    from hippo.core import seeding

    obs, _ = envs.reset(seed=seeding.integer(seed, "episodes", 0))
    state, done, actions = None, None, []
    for _ in range(steps):
        action, state = agent.act(obs, state, done=done, seed=seed, **how)
        actions.append(action)
        obs, _, terminated, truncated, _ = envs.step(action)
        done = terminated | truncated
    return np.array(actions)


@pytest.mark.parametrize("greedy", [False, True])
@pytest.mark.parametrize("algo", LEARNERS)
def test_an_agent_does_what_a_roll_out_of_its_run_does_bit_for_bit(trained, algo, greedy, tmp_path):
    run = trained(algo)
    options = {"horizon": 100, "terminate_on_fall": True}  # so that episodes end within
    steps = rollout(
        learner_of(algo), run.restored_config, make(run.env, 5, 1, **options), 7, Checkpoint(run.folder), greedy
    )
    assert steps.done[:-1].any()
    expected = np.clip(steps.action.numpy(), -1, 1)
    agent = load(run.folder)
    np.testing.assert_array_equal(acted(agent, make(run.env, 5, 1, **options), 100, 7, greedy=greedy), expected)
    saved = load(agent.save(tmp_path / "policy"))
    np.testing.assert_array_equal(acted(saved, make(run.env, 5, 1, **options), 100, 7, greedy=greedy), expected)


def test_ends_that_are_not_told_are_seen_in_the_actions(trained):
    agent, options = load(trained("hippo").folder), {"horizon": 100, "terminate_on_fall": True}
    told = acted(agent, make("block_hopper", 5, 1, **options), 100, 7)
    envs = make("block_hopper", 5, 1, **options)
    obs, _ = envs.reset(seed=0)
    state, untold = None, []
    for _ in range(100):
        action, state = agent.act(obs, state, seed=7)
        untold.append(action)
        obs = envs.step(action)[0]
    assert not np.array_equal(told, np.array(untold))


def test_the_state_says_which_skill_is_in_force_and_for_how_long(trained):
    agent = load(trained("hippo").folder)
    state, left, skill = None, 0, None
    for _ in range(300):  # three horizons, whose randomness is drawn one after another
        action, state = agent.act(np.zeros(len(agent.task.observation_names)), state)
        assert action.shape == (3,)
        assert agent.spaces[1].contains(action.astype(np.float32))
        if left > 1:
            assert (state.steps_left[0], state.skill[0]) == (left - 1, skill)
        left, skill = int(state.steps_left[0]), int(state.skill[0])
        assert 1 <= left <= 15
        assert agent.skill == skill
    kept = copy.deepcopy(state)
    first, _ = agent.act(np.zeros(len(agent.task.observation_names)), state)
    again, _ = agent.act(np.zeros(len(agent.task.observation_names)), kept)
    np.testing.assert_array_equal(first, again)
    flat = load(trained("ppo").folder)
    assert flat.act(np.zeros((2, len(flat.task.observation_names))))[0].shape == (2, 3)
    assert flat.skill is None


def test_a_saved_policy_needs_no_run_and_says_what_it_is(trained, tmp_path):
    run = trained("hippo")
    load(run.folder).save(tmp_path / "policy")
    assert sorted(path.name for path in (tmp_path / "policy").iterdir()) == ["README.md", "agent.json", "checkpoint.pt"]
    card = (tmp_path / "policy" / "README.md").read_text()
    assert run.run_id in card
    assert "| env_steps | 200 |" in card
    assert "hippo.load" in card
    again = load(tmp_path / "policy").save(tmp_path / "again")
    for name in ("agent.json", "checkpoint.pt", "README.md"):
        assert (again / name).read_bytes() == (tmp_path / "policy" / name).read_bytes()


def test_what_cannot_be_loaded_says_why(trained, tmp_path, monkeypatch):
    with pytest.raises(AgentError, match=r"holds neither agent.json nor config.yaml"):
        load(tmp_path)
    agent = load(trained("ppo").folder)
    with pytest.raises(ValueError, match=r"obs has shape \(4,\): must be \(\d+,\) or \(N, \d+\)"):
        agent.act(np.zeros(4))
    agent.save(tmp_path / "policy")
    (tmp_path / "policy" / "checkpoint.pt").write_bytes(b"nothing")
    with pytest.raises(AgentError, match="no intact checkpoint"):
        load(tmp_path / "policy")
    (tmp_path / "policy" / "checkpoint.pt").unlink()
    with pytest.raises(AgentError, match="has no checkpoint; train it first"):
        load(tmp_path / "policy")
    plain = json.loads((tmp_path / "policy" / "agent.json").read_text())
    (tmp_path / "policy" / "agent.json").write_text(json.dumps(plain | {"algo": "os"}))
    with pytest.raises(AgentError, match="holds no policy that can be read"):
        load(tmp_path / "policy")
    (tmp_path / "policy" / "agent.json").write_text("{")
    with pytest.raises(AgentError, match=r"agent\.json"):
        load(tmp_path / "policy")


def test_outside_the_checkout_the_package_loads_hippo_and_says_where_a_baseline_is(trained, tmp_path):
    for algo in ("hippo", "ppo"):
        load(trained(algo).folder).save(tmp_path / algo)
    code = "import sys; sys.path.insert(0, sys.argv[1]); import hippo; print(hippo.load(sys.argv[2]).algo)"
    (tmp_path / "package").mkdir()
    (tmp_path / "package" / "hippo").symlink_to(next(iter(hippo.__path__)))

    def loaded(algo):
        command = [sys.executable, "-I", "-c", code, str(tmp_path / "package"), str(tmp_path / algo)]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)

    assert loaded("hippo").stdout == "hippo\n"
    said = loaded("ppo").stderr.splitlines()[-1]
    assert "needs baselines.ppo, which is in the checkout: start Python there" in said


class Reach(gym.Env):
    """One step: the closer the action to the target, the better."""

    observation_space = gym.spaces.Dict({"target": gym.spaces.Box(-1, 1, (2,)), "noise": gym.spaces.Box(-1, 1, (1,))})
    action_space = gym.spaces.Box(-4.0, 4.0, (2,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.observe(), {}

    def observe(self):
        self.target = self.np_random.uniform(-1, 1, 2).astype(np.float32)
        return {"target": self.target, "noise": np.zeros(1, np.float32)}

    def step(self, action):
        reward = -float(np.square(action - self.target).sum())
        return self.observe(), reward, False, False, {}


def reaching(num_envs, mode=gym.vector.AutoresetMode.SAME_STEP):
    return gym.vector.SyncVectorEnv([lambda: gym.wrappers.TimeLimit(Reach(), 20)] * num_envs, autoreset_mode=mode)


CONFIG = {"batch_size": 200, "horizon": 20, "num_skills": 2, "period_min": 2, "period_max": 4}


def test_training_on_ones_own_object_goes_on_from_its_checkpoint_and_gives_the_policy(tmp_path):
    rows = []
    agent = train(HippoConfig(iterations=3, **CONFIG), reaching(10), tmp_path / "a", 1, "target", rows.append)
    assert [row["iteration"] for row in rows] == [0, 1, 2]
    train(HippoConfig(iterations=2, **CONFIG), reaching(10), tmp_path / "b", 1, "target")
    resumed = train(HippoConfig(iterations=3, **CONFIG), reaching(10), tmp_path / "b", 1, "target")
    assert (tmp_path / "a" / "progress.csv").read_bytes() == (tmp_path / "b" / "progress.csv").read_bytes()
    obs = {"target": np.array([[0.1, -0.2]] * 3, np.float32), "noise": np.zeros((3, 1), np.float32)}
    actions = [each.act(obs, greedy=True)[0] for each in (agent, resumed, load(tmp_path / "a"))]
    np.testing.assert_array_equal(actions[0], actions[1])
    np.testing.assert_array_equal(actions[0], actions[2])
    assert actions[0].shape == (3, 2)
    assert agent.act({key: part[0] for key, part in obs.items()})[0].shape == (2,)
    loud, _ = agent.act(obs, seed=3)
    assert all(Reach.action_space.contains(action) for action in loud)


def test_environments_that_do_not_fit_are_refused(tmp_path):
    with pytest.raises(ValueError, match="envs=3: must be batch_size / horizon, 10"):
        train(HippoConfig(iterations=1, **CONFIG), reaching(3), tmp_path)
    with pytest.raises(ValueError, match=r"resets by AutoresetMode\.NEXT_STEP; needed is AutoresetMode\.SAME_STEP"):
        train(HippoConfig(iterations=1, **CONFIG), reaching(10, gym.vector.AutoresetMode.NEXT_STEP), tmp_path)


def test_the_package_itself_imports_no_learning_library():
    code = "import hippo, hippo.envs, sys; assert 'torch' not in sys.modules; hippo.load; assert 'torch' in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
