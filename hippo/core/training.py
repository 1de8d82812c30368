"""What stands around every learner's loop: going on where a run stopped, and a row and a checkpoint per iteration."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from hippo.core.checkpoint import Checkpoint
from hippo.core.log import RunLog
from hippo.core.rollout import Steps

MakeEnvs = Callable[[int, str], Any]  # (num_envs, purpose) -> a vector environment that knows its robot_size


@dataclass
class Training:
    """A run on its way: its log, its checkpoint and what that holds."""

    log: RunLog
    checkpoint: Checkpoint
    parts: dict[str, Any]  # by name: objects with a state_dict

    def begin(self) -> int:
        """Load the newest checkpoint into the parts and forget later rows; the first iteration that is to be done."""
        first = self.checkpoint.restore(**self.parts)
        self.log.resume(first)
        return first

    def record(self, iteration: int, steps: Steps, clocks: tuple[float, float, float], metrics: dict[str, Any]) -> None:
        """Write an iteration's row, its budget and episodes before `metrics`, then the checkpoint that covers it.

        Args:
            clocks: when it began, when its steps had been collected and when it had learnt, `time.perf_counter()` in s.
        """
        head = {"iteration": iteration, "env_steps": (iteration + 1) * steps.num_steps, **steps.statistics()}
        self.log.row(head | metrics, steps.timing(*clocks))
        self.checkpoint.record(iteration, **self.parts)
