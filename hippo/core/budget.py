"""The settings that every learner has: how long it trains, on how much at a time, in episodes of which length."""

import dataclasses
from dataclasses import dataclass

from hippo.core.settings import MOST_STEPS, ConfigError, check, setting


@dataclass
class BudgetConfig:
    """Iterations, batch and horizon, which the scale fills in; a learner whose sources differ says its own."""

    iterations: int = setting(dataclasses.MISSING, "training iterations", code="2000 on Gather (README)", low=1)
    batch_size: int = setting(
        dataclasses.MISSING,
        "environment steps per iteration",
        paper="Block 50 000, Gather 100 000 (App. A)",
        low=1,
        high=MOST_STEPS,
    )
    horizon: int = setting(
        dataclasses.MISSING, "episode length H in steps", paper="Block 1000, Ant 5000, Snake 8000 (App. A)", low=1
    )

    def __post_init__(self) -> None:
        check(self)
        if self.batch_size < self.horizon:
            raise ConfigError("batch_size", self.batch_size, f"must be at least one horizon, {self.horizon} steps")

    @property
    def num_envs(self) -> int:
        """Environments that collect one horizon each; ceil(batch / horizon)."""
        return -(-self.batch_size // self.horizon)
