"""Which plan of a figure is meant, and where it, its committed rows and its pictures lie.

The one agreement between experiments, which writes plans, and analysis and paper_figures, which read them.
"""

import argparse
import hashlib
import re
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

PAPER = "paper"  # the protocol whose folders carry no name
OVERRIDDEN = "overridden"  # folder of what has overrides
FIGURE = re.compile(r"\w+")
NEVER_OVERRIDES = ("wandb.", "log.")  # settings that change no number


@dataclass(frozen=True)
class Edition:
    """A scale, a protocol, and what is overridden in every run: nothing of two editions is ever put together."""

    scale: str
    protocol: str = PAPER
    overrides: tuple[str, ...] = ()  # sorted, one for a key

    @staticmethod
    def of(scale: str, protocol: str = PAPER, settings: Sequence[str] = ()) -> "Edition":
        """The edition that `settings`, as they are typed, make; of two for one key the last counts."""
        last = {setting.partition("=")[0]: setting for setting in settings}
        return Edition(scale, protocol, tuple(sorted(s for s in last.values() if not s.startswith(NEVER_OVERRIDES))))

    @staticmethod
    def planned(plan: dict[str, Any]) -> "Edition":
        """The edition that a plan says it is of."""
        return Edition(plan["scale"], plan.get("protocol", PAPER), tuple(plan.get("overrides", ())))

    @property
    def folder(self) -> Path:
        """Where its plans lie in a runs folder's `plans`, its rows among the committed ones, its pictures in `out`."""
        folder = Path(self.scale) if self.protocol == PAPER else Path(self.protocol) / self.scale
        return folder / OVERRIDDEN if self.overrides else folder

    def name(self, figure: str) -> str:
        """What a figure of this edition is called in names of files and in its rows.

        Raises:
            ValueError: `figure` is already the name of an overridden one, or none at all.
        """
        if not FIGURE.fullmatch(figure):
            raise ValueError(f"{figure}: is no figure or table; one with overrides is drawn by --set, and is no result")
        if not self.overrides:
            return figure
        return f"{figure}+{hashlib.sha256(' '.join(self.overrides).encode()).hexdigest()[:8]}"

    @property
    def marks(self) -> list[str]:
        """What tells it from the paper's own edition at the same scale, in words."""
        protocol = [] if self.protocol == PAPER else [f"{self.protocol} protocol"]
        return [*protocol, *([f"overridden: {', '.join(self.overrides)}"] if self.overrides else [])]

    def __str__(self) -> str:
        return ", ".join([f"scale {self.scale}", *self.marks])

    @property
    def called(self) -> str:
        """The same as titles have it."""
        return ", ".join([f"{self.scale} scale", *self.marks])

    @property
    def options(self) -> str:
        """As experiments.sweep and paper_figures take it on the command line."""
        words = ["--scale", self.scale, *([] if self.protocol == PAPER else ["--protocol", self.protocol])]
        return shlex.join([*words, *(word for setting in self.overrides for word in ("--set", setting))])

    @property
    def variables(self) -> str:
        """As make takes it; overrides have no variable."""
        return f"SCALE={self.scale}" + ("" if self.protocol == PAPER else f" PROTOCOL={self.protocol}")


def chosen(options: argparse.Namespace) -> Edition:
    """The edition that a command line names."""
    return Edition.of(options.scale, options.protocol, getattr(options, "set", ()))
