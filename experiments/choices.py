"""Where the project's configuration lies, what may be chosen in it, and hints at what was meant."""

import difflib
from collections.abc import Sequence
from pathlib import Path

from hippo.core.settings import ConfigError
from hippo.envs import ENVIRONMENTS, foreign
from hippo.learners import LEARNERS

ROOT = Path(__file__).parent.parent
CONF = ROOT / "experiments" / "conf"
COMMITTED = ROOT / "paper_figures" / "data"
# The groups of conf/ that a run chooses from, and what it chooses when nothing is said.
GROUPS = {"env": "block_hopper", "algo": "hippo", "scale": "paper", "protocol": "paper"}


def choices(group: str) -> list[str]:
    """The files of one group of conf/, e.g. the scales."""
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


def nearest(value: str, valid: Sequence[str]) -> str:
    """A hint at the valid choices, the closest one first if there is one; of many choices only the closest five."""
    close = difflib.get_close_matches(value, valid, n=5, cutoff=0.6 if len(valid) <= 12 else 0.3)
    suggestion = f"did you mean {close[0]}? " if close else ""
    shown = list(valid) if len(valid) <= 12 else [*(close or valid[:5]), "..."]
    return f"{suggestion}valid: {', '.join(shown)}"


def check_choice(key: str, value: str, valid: Sequence[str]) -> str:
    """`value`, or a ConfigError that names the valid ones."""
    if value not in valid:
        raise ConfigError(key, value, nearest(value, valid))
    return value


def group_choices(group: str) -> list[str]:
    """The values of env, algo, scale or protocol."""
    if group == "env":
        return [name if name in ENVIRONMENTS else f"{foreign.PREFIX}<id>" for name in choices(group)]
    return list(LEARNERS) if group == "algo" else choices(group)
