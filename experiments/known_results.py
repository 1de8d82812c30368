"""Learning results of other papers, reproduced at reduced budget: that a competitor here is as strong as its authors'.

    python -m experiments.known_results option_critic --seeds 3 --runs-dir runs/known_results

trains Option-Critic with two options on Gymnasium's Hopper-v5 for 10^6 steps, with the settings that PPOC was published
with, and draws the learning curves. PPOC's published curves end between 2000 and 2250 (on Hopper-v1). A run that was
interrupted goes on where it stopped.
"""

import argparse
from pathlib import Path
from typing import Any

import gymnasium as gym
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import torch

from baselines import option_critic
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
LABELS = {
    "option_critic": "Option-Critic, 2 options",
    "option_critic_half": "at half the step size, 2 options",
    "option_critic_ppoc": "with PPOC's losses, 2 options",
    "option_critic_ppo": "1 option (PPO)",
}


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


def train(variant: str, seed: int, folder: Path) -> None:
    """One run in `folder`, from its newest checkpoint."""

    def make_envs(num_envs: int, purpose: str) -> GymnasiumEnvs:
        return GymnasiumEnvs("Hopper-v5", num_envs, seeding.integer(seed, purpose))

    config = option_critic.OptionCriticConfig(**BUDGET, **VARIANTS[variant])
    option_critic.train(config, make_envs, RunLog(folder), seed, Checkpoint(folder))


def draw(runs_dir: Path, target: Path) -> pd.DataFrame:
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
    parser.add_argument("variant", choices=VARIANTS)
    parser.add_argument("--seeds", type=int, default=3, help="how many seeds, from 0")
    parser.add_argument("--runs-dir", type=Path, default=Path("runs/known_results"))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    for seed in range(arguments.seeds):
        train(arguments.variant, seed, arguments.runs_dir / f"{arguments.variant}-{seed}")
    print(draw(arguments.runs_dir, arguments.runs_dir / "hopper.png").to_string(index=False))


if __name__ == "__main__":
    main()
