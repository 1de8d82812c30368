"""Our flat PPO against Stable-Baselines3 and a CleanRL-style loop, the same work for all three; part of `make bench`.

The same work: environment id, number of environments, steps, networks (policy 256-64, value 32-32, tanh), and ten
full-batch gradient steps on policy and value per batch; one thread each, peers on our registered environment. Each
takes an iteration in turn, with one of ours before and after it. SubprocVecEnv may use every core, the others one.
"""

import functools
import os
import time
from collections.abc import Callable, Iterator

import gymnasium as gym
import torch
from torch import nn

from experiments.bench.environments import registered
from experiments.bench.iterations import training
from experiments.bench.measure import (
    CORES,
    Row,
    beside,
    contestants,
    median_ratio,
    median_reference,
    median_speed,
    one_core,
)
from hippo.envs import gymnasium_id

NUM_ENVS = {"block_hopper": 50, "ant_gather": 20}
EPOCHS, CLIP, LEARNING_RATE, GAMMA = 10, 0.1, 3e-3, 0.999
Report = Callable[[float], None]


def stable_baselines(name: str, num_envs: int, steps: int, processes: bool, report: Report) -> None:
    """Report steps per second of Stable-Baselines3's PPO."""
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

    if processes:
        os.sched_setaffinity(0, CORES)
    one = functools.partial(registered, gymnasium_id(name))
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
    total = num_envs * steps
    _report(lambda: learner.learn(total, reset_num_timesteps=False), total, report)


def _report(iteration: Callable[[], object], steps: int, report: Report) -> None:
    """Report steps per second of one call of `iteration` after the other, without end."""
    while True:
        start = time.perf_counter()
        iteration()
        report(steps / (time.perf_counter() - start))


def clean_rl(name: str, num_envs: int, steps: int, report: Report) -> None:
    """Report steps per second of PPO written as one plain loop over Gymnasium's SyncVectorEnv, in CleanRL's manner."""
    envs = gym.make_vec(gymnasium_id(name), num_envs, vectorization_mode=gym.VectorizeMode.SYNC)
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

    _report(iteration, num_envs * steps, report)


def rows(quick: bool) -> Iterator[Row]:
    """Steps per second of whole iterations, and how many times as fast ours is."""
    steps, rounds = (100, 1) if quick else (400, 3)
    for name, num_envs in NUM_ENVS.items():
        budget = [f"batch_size={num_envs * steps}", f"env.horizon={steps}"]
        bodies = {
            "ours": (training, [f"env={name}", "algo=ppo", "scale=paper", *budget]),
            "Stable-Baselines3, DummyVecEnv": (stable_baselines, name, num_envs, steps, False),
            "Stable-Baselines3, SubprocVecEnv": (stable_baselines, name, num_envs, steps, True),
            "CleanRL-style, SyncVectorEnv": (clean_rl, name, num_envs, steps),
        }
        with one_core(), contestants(bodies) as turns:
            ours = turns.pop("ours")
            measured = beside(lambda ours=ours: ours().speed, turns, rounds)  # type: ignore[misc]
        yield Row(name, "PPO, ours", median_reference(measured["CleanRL-style, SyncVectorEnv"]), "steps/s")
        ratios = {what: 1 / median_ratio(pairs) for what, pairs in measured.items()}
        faster = min((what for what in ratios if what.startswith("Stable")), key=lambda what: ratios[what])
        keys = {faster: f"stable_baselines/{name}", "CleanRL-style, SyncVectorEnv": f"clean_rl/{name}"}
        for what, pairs in measured.items():
            speed, key = median_speed(pairs), keys.get(what, "")
            yield Row(name, f"PPO, {what}", speed, "steps/s", ratios[what], "ours over its", key)
