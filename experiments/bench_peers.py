"""Our flat PPO against Stable-Baselines3 and a CleanRL-style loop, the same work for all three; part of `make bench`.

The same work: environment id, number of environments, steps, networks (policy 256-64, value 32-32, tanh), and ten
full-batch gradient steps on policy and value per batch; one thread each, peers on our registered environment.
"""

import functools
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import gymnasium as gym
import torch
from torch import nn

from baselines import ppo
from experiments.config import compose_run
from hippo.core.checkpoint import Checkpoint
from hippo.core.log import RunLog
from hippo.envs import make

IDS = {"block_hopper": "hippo/BlockHopper-v0", "ant_gather": "hippo/AntGather-v0"}
NUM_ENVS = {"block_hopper": 50, "ant_gather": 20}
EPOCHS, CLIP, LEARNING_RATE, GAMMA = 10, 0.1, 3e-3, 0.999
TARGETS = {"Stable-Baselines3, DummyVecEnv": 4.0, "CleanRL-style, SyncVectorEnv": 3.0}


def compare(name: str, steps: int, iterations: int) -> dict[str, float]:
    """Environment steps per second of whole iterations of `steps` steps in every environment, by implementation."""
    num_envs = NUM_ENVS[name]
    return {
        "ours": ours(name, num_envs, steps, iterations),
        "Stable-Baselines3, DummyVecEnv": stable_baselines(name, num_envs, steps, iterations, processes=False),
        "Stable-Baselines3, SubprocVecEnv": stable_baselines(name, num_envs, steps, iterations, processes=True),
        "CleanRL-style, SyncVectorEnv": clean_rl(name, num_envs, steps, iterations),
    }


def ours(name: str, num_envs: int, steps: int, iterations: int) -> float:
    """Steps per second of baselines/ppo.py."""
    budget = [f"iterations={iterations + 1}", f"batch_size={num_envs * steps}", f"env.horizon={steps}"]
    run = compose_run([f"env={name}", "algo=ppo", "scale=paper", *budget])
    speeds: list[float] = []
    with tempfile.TemporaryDirectory() as folder:
        log = RunLog(Path(folder), lambda _, timing: speeds.append(float(timing["steps_per_second"])))
        ppo.train(run.config, lambda n, purpose: make(name, n, 0, horizon=steps), log, 0, Checkpoint(Path(folder)))
    return statistics.median(speeds[1:])


def stable_baselines(name: str, num_envs: int, steps: int, iterations: int, processes: bool) -> float:
    """Steps per second of Stable-Baselines3's PPO."""
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

    one = functools.partial(gym.make, IDS[name])
    envs = SubprocVecEnv([one] * num_envs, "fork") if processes else DummyVecEnv([one] * num_envs)
    learner = PPO(
        "MlpPolicy",
        envs,
        learning_rate=LEARNING_RATE,
        n_steps=steps,
        batch_size=num_envs * steps,
        n_epochs=EPOCHS,
        gamma=GAMMA,
        gae_lambda=1.0,
        clip_range=CLIP,
        policy_kwargs={"net_arch": {"pi": [256, 64], "vf": [32, 32]}, "activation_fn": nn.Tanh},
        device="cpu",
        seed=0,
    )
    speed = timed(lambda: learner.learn(num_envs * steps, reset_num_timesteps=False), num_envs * steps, iterations)
    envs.close()
    return speed


def timed(iteration: Callable[[], object], steps: int, iterations: int) -> float:
    """Median steps per second of calls of `iteration` after a first one."""
    seconds = []
    for _ in range(iterations + 1):
        start = time.perf_counter()
        iteration()
        seconds.append(time.perf_counter() - start)
    return steps / statistics.median(seconds[1:])


def clean_rl(name: str, num_envs: int, steps: int, iterations: int) -> float:
    """Steps per second of PPO written as one plain loop over Gymnasium's SyncVectorEnv, in CleanRL's manner."""
    envs = gym.make_vec(IDS[name], num_envs, vectorization_mode=gym.VectorizeMode.SYNC)
    obs_size, action_size = envs.single_observation_space.shape[0], envs.single_action_space.shape[0]  # type: ignore[index]
    mean = nn.Sequential(nn.Linear(obs_size, 256), nn.Tanh(), nn.Linear(256, 64), nn.Tanh(), nn.Linear(64, action_size))
    critic = nn.Sequential(nn.Linear(obs_size, 32), nn.Tanh(), nn.Linear(32, 32), nn.Tanh(), nn.Linear(32, 1))
    log_std = nn.Parameter(torch.zeros(action_size))
    parameters = [*mean.parameters(), *critic.parameters(), log_std]
    optimizer = torch.optim.Adam(parameters, lr=LEARNING_RATE)
    obs = torch.zeros(steps, num_envs, obs_size)
    actions = torch.zeros(steps, num_envs, action_size)
    log_probs, rewards, dones, values = torch.zeros(4, steps, num_envs)
    state = {"obs": torch.as_tensor(envs.reset(seed=0)[0]), "done": torch.zeros(num_envs)}

    def iteration() -> None:
        for t in range(steps):
            obs[t], dones[t] = state["obs"], state["done"]
            with torch.no_grad():
                policy = torch.distributions.Normal(mean(state["obs"]), log_std.exp())
                actions[t] = policy.sample()
                log_probs[t] = policy.log_prob(actions[t]).sum(1)
                values[t] = critic(state["obs"]).flatten()
            next_obs, reward, terminated, truncated, _ = envs.step(actions[t].numpy().clip(-1, 1))
            rewards[t] = torch.as_tensor(reward)
            state["obs"], state["done"] = torch.as_tensor(next_obs), torch.as_tensor(terminated | truncated).float()
        with torch.no_grad():
            following, alive, advantages = critic(state["obs"]).flatten(), 1 - state["done"], torch.zeros_like(rewards)
            last = torch.zeros(num_envs)
            for t in reversed(range(steps)):
                delta = rewards[t] + GAMMA * following * alive - values[t]
                advantages[t] = last = delta + GAMMA * alive * last
                following, alive = values[t], 1 - dones[t]
            returns = advantages + values
        flat = [x.flatten(0, 1) for x in (obs, actions, log_probs, advantages, returns)]
        advantage = (flat[3] - flat[3].mean()) / (flat[3].std() + 1e-8)
        for _ in range(EPOCHS):
            policy = torch.distributions.Normal(mean(flat[0]), log_std.exp())
            ratio = (policy.log_prob(flat[1]).sum(1) - flat[2]).exp()
            surrogate = torch.min(advantage * ratio, advantage * ratio.clamp(1 - CLIP, 1 + CLIP)).mean()
            loss = 0.5 * (critic(flat[0]).flatten() - flat[4]).square().mean() - surrogate
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(parameters, 0.5)
            optimizer.step()

    speed = timed(iteration, num_envs * steps, iterations)
    envs.close()
    return speed


def lines(quick: bool) -> list[str]:
    """The comparison as rows of the benchmark's table."""
    table = []
    for name in IDS:
        speeds = compare(name, 100 if quick else 400, 1 if quick else 3)
        for what, speed in speeds.items():
            ratio, target = speeds["ours"] / speed, TARGETS.get(what)
            aim = "" if target is None else f">= {target}" + ("" if ratio >= target else "  MISSED")
            table.append(f"{name:20} PPO, {what:32} {speed:12,.0f} {ratio:8.1f}x   {aim}")
    return table
