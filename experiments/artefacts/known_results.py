"""Learning results of other papers, reproduced at reduced budget: that a competitor here is as strong as its authors'.

    python -m experiments.artefacts.known_results option_critic --seeds 3 --runs-dir runs/known_results

trains Option-Critic with two options on Gymnasium's Hopper-v5 for 10^6 steps, with the settings that PPOC was published
with, and draws the learning curves. PPOC's published curves end between 2000 and 2250 (on Hopper-v1).

    python -m experiments.artefacts.known_results mlsh

trains MLSH with two sub-policies on movement bandits, whose right goal a fresh master has to find out: the published
finding is that the sub-policies come to walk to one goal each, so that it soon does. An interrupted run goes on where
it stopped.
"""

import argparse
from pathlib import Path
from typing import Any

import gymnasium as gym
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import torch

from baselines import mlsh, option_critic
from experiments.command_line import run_command
from hippo.core import seeding
from hippo.core.checkpoint import Checkpoint
from hippo.core.log import RunLog

HORIZON = 1000
PUBLISHED = (2000, 2250)  # PPOC, Hopper-v1, two options, 10^6 steps, all deliberation costs
# Two environments for a whole horizon each: 2000 steps between updates, where PPOC has 2048.
BUDGET: dict[str, Any] = {"iterations": 500, "batch_size": 2 * HORIZON, "horizon": HORIZON}
VARIANTS: dict[str, dict[str, Any]] = {
    "option_critic": {"num_skills": 2, "log_std_per_skill": True},
    "option_critic_half": {"num_skills": 2, "log_std_per_skill": True, "learning_rate": 1.5e-4},
    "option_critic_ppoc": {"num_skills": 2, "log_std_per_skill": True, "ppoc_faithful": True},
    "option_critic_ppo": {"num_skills": 1, "minibatch_size": 64, "critic_minibatch_size": 64},
}
MLSH: dict[str, Any] = {
    "iterations": 2000,
    "batch_size": 2000,
    "warmup_iterations": 10,
    "joint_iterations": 10,
    "num_skills": 2,
}
LABELS = {
    "option_critic": "Option-Critic, 2 options",
    "option_critic_half": "at half the step size, 2 options",
    "option_critic_ppoc": "with PPOC's losses, 2 options",
    "option_critic_ppo": "1 option (PPO)",
}


class MovementBandits(gym.vector.VectorEnv):
    """A point and two goals in the plane; being within 50 of the right one pays 1 a step. Which one it is is not seen.

    After openai/mlsh (test_envs): episodes start at the origin, goals are anywhere within 200 of it in x and y, a step
    is 20 at most. Which of the goals is right, `layout_seed` decides for all environments and episodes.
    """

    metadata = {"autoreset_mode": gym.vector.AutoresetMode.SAME_STEP}  # noqa: RUF012
    robot_name, observation_variant, robot_size, horizon = "point", "paper", 6, 50
    observation_names = ("x", "y", "goal_0_x", "goal_0_y", "goal_1_x", "goal_1_y")
    reach, step_size, radius = 200.0, 20.0, 50.0

    def __init__(self, num_envs: int, seed: int) -> None:
        self.num_envs, self.right = num_envs, 0
        self.single_observation_space = gym.spaces.Box(-np.inf, np.inf, (6,), np.float32)
        self.single_action_space = gym.spaces.Box(-1, 1, (2,), np.float32)
        self.rng = np.random.default_rng(seed)

    def _observe(self) -> np.ndarray:
        """(N, 6): the place, and where the goals are from there, in units of 200."""
        seen = [self.place, *(goal - self.place for goal in self.goals)]
        return (np.concatenate(seen, 1) / self.reach).astype(np.float32)

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Fresh goals; options: layout_seed."""
        if seed is not None:
            self.rng = np.random.default_rng(seed)
        if options is not None:
            self.right = int(np.random.default_rng(options["layout_seed"]).integers(2))
        self.clock, self.place = 0, np.zeros((self.num_envs, 2))
        self.goals = self.rng.uniform(-self.reach, self.reach, (2, self.num_envs, 2))
        return self._observe(), {}

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Walk; all episodes end together."""
        self.place = self.place + self.step_size * np.clip(actions, -1, 1)
        self.clock += 1
        reward = (np.linalg.norm(self.place - self.goals[self.right], axis=1) < self.radius).astype(np.float64)
        no, truncated = np.zeros(self.num_envs, bool), np.full(self.num_envs, self.clock == self.horizon)
        obs, info = self._observe(), {"diverged": no}
        if truncated.any():
            info |= {"final_obs": obs, "_final_obs": truncated}
            obs, _ = self.reset()
        return obs, reward, no, truncated, info


class GymnasiumEnvs(gym.vector.VectorWrapper):
    """Copies of one of Gymnasium's environments with the interface of hippo.envs: all of it is the robot."""

    def __init__(self, name: str, num_envs: int, seed: int) -> None:
        same_step = gym.vector.AutoresetMode.SAME_STEP
        super().__init__(gym.make_vec(name, num_envs, "sync", vector_kwargs={"autoreset_mode": same_step}))
        self.robot_name, self.observation_variant, self.horizon = name, "paper", HORIZON
        space = self.env.single_observation_space
        assert space.shape is not None
        self.robot_size = space.shape[0]
        self.env.reset(seed=seed)

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        """As hippo.envs: float32 observations."""
        obs, info = self.env.reset(seed=seed, options=options)
        return obs.astype(np.float32), info

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """As hippo.envs: float32 observations, and that no simulation diverged."""
        obs, reward, terminated, truncated, info = self.env.step(actions)
        return obs.astype(np.float32), reward, terminated, truncated, info | {"diverged": np.zeros(len(obs), bool)}


def train_option_critic(variant: str, seed: int, folder: Path) -> None:
    """One run in `folder`, from its newest checkpoint."""

    def make_envs(num_envs: int, purpose: str) -> GymnasiumEnvs:
        return GymnasiumEnvs("Hopper-v5", num_envs, seeding.integer(seed, purpose))

    config = option_critic.OptionCriticConfig(**BUDGET, **VARIANTS[variant])
    option_critic.train(config, make_envs, RunLog(folder), seed, Checkpoint(folder))


def train_mlsh(seed: int, folder: Path) -> pd.DataFrame:
    """One run in `folder`, from its newest checkpoint; where its sub-policies end: a row per sub-policy."""

    def make_envs(num_envs: int, purpose: str) -> MovementBandits:
        return MovementBandits(num_envs, seeding.integer(seed, purpose))

    config = mlsh.MLSHConfig(horizon=MovementBandits.horizon, **MLSH)
    mlsh.train(config, make_envs, RunLog(folder), seed, Checkpoint(folder))
    policy = mlsh.MLSHPolicy(config, 6, 6, 2, torch.Generator())
    Checkpoint(folder).restore(policy=policy)
    act, ends = policy.skills.actor(), []
    for skill in range(config.num_skills):
        envs = make_envs(500, "where sub-policies end")
        obs, _ = envs.reset()
        for _ in range(envs.horizon - 1):
            obs, *_ = envs.step(act(obs, np.full(500, skill), np.zeros((500, 2), np.float32)))
        near = [float((np.linalg.norm(envs.place - goal, axis=1) < envs.radius).mean()) for goal in envs.goals]
        ends.append({"run": folder.name, "sub-policy": skill, "ends at goal 0": near[0], "ends at goal 1": near[1]})
    return pd.DataFrame(ends)


def draw_mlsh(runs_dir: Path, target: Path) -> pd.DataFrame:
    """Return after a reset of the master, early and late in training; returns it per run for the last quarter."""
    length = MLSH["warmup_iterations"] + MLSH["joint_iterations"]
    figure, axes = plt.subplots(figsize=(6, 4))
    curves = {}
    for path in sorted(runs_dir.glob("mlsh-*/progress.csv")):
        table = pd.read_csv(path).set_index("iteration")["return_mean"]
        curves[path.parent.name] = [table[part].groupby(table[part].index % length).mean() for part in quarters(table)]
    for quarter in range(4):
        mean = pd.DataFrame([run[quarter] for run in curves.values()]).mean()
        axes.plot(mean.index + 1, mean, color=plt.get_cmap("viridis")(quarter / 3.5), label=f"quarter {quarter + 1}")
    for run in curves.values():
        axes.plot(run[3].index + 1, run[3], color=plt.get_cmap("viridis")(3 / 3.5), alpha=0.4, lw=1)
    axes.axvspan(0.5, MLSH["warmup_iterations"] + 0.5, color="0.93", label="master alone learns")
    axes.set(xlabel="iterations since the master started over", ylabel="return (50 steps)", ylim=(0, 50))
    axes.set_title(f"Movement bandits, {len(curves)} seeds", fontsize=10)
    axes.legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(target, dpi=120)
    at = {"fresh master": 0, "after its warm-up": MLSH["warmup_iterations"], "end of cycle": length - 1}
    rows = [{"run": run} | {what: curve[3].loc[i] for what, i in at.items()} for run, curve in curves.items()]
    return pd.DataFrame(rows)


def quarters(table: pd.Series) -> list[slice]:
    """The four quarters of a run, as slices of its iterations."""
    n = len(table) // 4
    return [slice(q * n, (q + 1) * n) for q in range(4)]


def draw_option_critic(runs_dir: Path, target: Path) -> pd.DataFrame:
    """Learning curves of every run in `runs_dir`, each the mean over 20 iterations; returns the last values."""
    rows = []
    figure, axes = plt.subplots(figsize=(6, 4))
    for color, variant in enumerate(VARIANTS):
        curves = {}
        for path in sorted(runs_dir.glob(f"{variant}-*/progress.csv")):
            table = pd.read_csv(path)
            curve = table["return_mean_all"].rolling(20, min_periods=1).mean()
            curve.index = table["env_steps"] / 1e6
            curves[path.parent.name] = curve
            last = {"variant": variant, "run": path.parent.name, "env_steps": int(table["env_steps"].iloc[-1])}
            rows.append(last | {"return": curve.iloc[-1], "option length": table["commitment_mean"].iloc[-20:].mean()})
        for i, curve in enumerate(curves.values()):
            axes.plot(curve, color=f"C{color}", alpha=0.4, lw=1)
            if i == 0:
                mean = pd.DataFrame(curves).mean(axis=1)
                axes.plot(mean, color=f"C{color}", lw=2, label=f"{LABELS[variant]} ({len(curves)} seeds)")
    axes.axhspan(*PUBLISHED, color="0.85", label="PPOC's published final values (Hopper-v1)")
    axes.set(xlabel="environment steps / 10^6", ylabel="return", title="Gymnasium Hopper-v5")
    axes.legend(fontsize=8)
    figure.tight_layout()
    target.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(target, dpi=120)
    return pd.DataFrame(rows)


def main() -> None:
    """Train the seeds of one variant, one after the other, and draw all curves there are."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("variant", choices=[*VARIANTS, "mlsh"])
    parser.add_argument("--seeds", type=int, default=3, help="how many seeds, from 0")
    parser.add_argument("--runs-dir", type=Path, default=Path("runs/known_results"))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    folders = [arguments.runs_dir / f"{arguments.variant}-{seed}" for seed in range(arguments.seeds)]
    if arguments.variant == "mlsh":
        ends = pd.concat([train_mlsh(seed, folder) for seed, folder in enumerate(folders)])
        print(ends.round(2).to_string(index=False))
        table = draw_mlsh(arguments.runs_dir, arguments.runs_dir / "bandits.png")
    else:
        for seed, folder in enumerate(folders):
            train_option_critic(arguments.variant, seed, folder)
        table = draw_option_critic(arguments.runs_dir, arguments.runs_dir / "hopper.png")
    print(table.round(1).to_string(index=False))


if __name__ == "__main__":
    run_command(main)
