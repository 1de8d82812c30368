"""What is kept of Stable-Baselines3's PPO, beside ours: the rows that experiments.artefacts.peer_curves trains."""

from pathlib import Path

import pandas as pd

from experiments.choices import COMMITTED

ROWS = COMMITTED / "studies" / "stable_baselines3.csv"
COLUMNS = ["env", "seed", "env_steps", "seconds", "return_mean"]
LABEL = "PPO, Stable-Baselines3"


def read(path: Path) -> pd.DataFrame:
    """The kept rows, none where there is no file."""
    return pd.read_csv(path) if path.exists() else pd.DataFrame(columns=COLUMNS)
