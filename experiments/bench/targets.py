"""What the benchmark aims at, the table that says whether it got there, and where it is kept; part of `make bench`."""

import os
import re
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from experiments.choices import ROOT
from experiments.config import installed

PAGE = ROOT / "docs" / "performance.md"
MARK = re.compile(r"(<!-- bench -->\n).*?(<!-- end -->)", re.DOTALL)


@dataclass(frozen=True)
class Target:
    """One number to reach."""

    what: str
    sense: str  # ">=" or "<="
    bound: float

    def met(self, value: float) -> bool:
        """Whether `value` is good enough."""
        return value >= self.bound if self.sense == ">=" else value <= self.bound


# key of a Row -> what it should be. One thread, paper physics, paper batch unless it says otherwise.
TARGETS = {
    "iteration/ant_gather": Target("HiPPO iteration / bare stepping, Ant Gather", ">=", 0.65),
    "iteration/snake_gather": Target("HiPPO iteration / bare stepping, Snake Gather", ">=", 0.9),
    "iteration/block_hopper": Target("HiPPO iteration / bare stepping, Block Hopper", ">=", 0.6),
    "iteration/block_half_cheetah": Target("HiPPO iteration / bare stepping, Block Half-Cheetah", ">=", 0.65),
    "environment/ant_gather x 20": Target("environment / bare stepping, Ant Gather x 20", ">=", 0.85),
    "environment/ant_gather x 64": Target("environment / bare stepping, Ant Gather x 64", ">=", 0.85),
    "environment/block_half_cheetah x 50": Target("environment / bare stepping, Block Half-Cheetah x 50", ">=", 0.8),
    "lidar": Target("lidar of 64 environments, microseconds a step", "<=", 150),
    "stable_baselines/block_hopper": Target("PPO / Stable-Baselines3's, the faster, Block Hopper", ">=", 4),
    "stable_baselines/ant_gather": Target("PPO / Stable-Baselines3's, the faster, Ant Gather", ">=", 4),
    "clean_rl/block_hopper": Target("PPO / CleanRL-style loop, Block Hopper", ">=", 3),
    "clean_rl/ant_gather": Target("PPO / CleanRL-style loop, Ant Gather", ">=", 3),
    "scaling": Target("cost of a step, 256 environments / 20", "<=", 1.1),
    "workers": Target("throughput of two workers / one, idle cores", ">=", 1.8),
    "launcher": Target("seconds per run beyond its training", "<=", 0.5),
    "memory": Target("peak memory in MB, HiPPO on Ant Gather", "<=", 1000),
    "fig3": Target("make fig3 SCALE=smoke with 2 workers, minutes", "<=", 3),
}


def closing(measured: Mapping[str, float]) -> list[str]:
    """The table of all targets: what was measured by key, and whether that is enough."""
    rows = [f"{'target':54} {'aim':>8} {'measured':>9}"]
    for key, target in TARGETS.items():
        value = measured.get(key)
        outcome = f"{'-':>9}  not measured"
        if value is not None:
            outcome = f"{value:9,.2f}  {'met' if target.met(value) else 'MISSED'}"
        rows.append(f"{target.what:54} {target.sense} {target.bound:5g} {outcome}")
    return rows


def machine() -> str:
    """The CPU's model, family and number of cores, the day, how busy it is, and versions."""
    found = re.findall(r"^(vendor_id|model name|cpu family|model)\s*: (.*)$", Path("/proc/cpuinfo").read_text(), re.M)
    cpu, cores = dict(found), len(os.sched_getaffinity(0))
    versions = ", ".join(f"{name} {installed(name)}" for name in ("torch", "mujoco", "numpy"))
    model = (
        f"{cpu.get('model name', 'unknown CPU')} (family {cpu.get('cpu family', '?')}, model {cpu.get('model', '?')})"
    )
    load = f"load {os.getloadavg()[0]:.1f} before it started"
    return f"{time.strftime('%Y-%m-%d')}, {model}, {cores} cores, {load}, {versions}."


def with_block(page: str, about: str, lines: Sequence[str]) -> str:
    """`page` with a sentence and a table in place of what is between its marks.

    Raises:
        ValueError: the page has no marks.
    """
    block = "\n".join([about, "", "```", *lines, "```"])
    new, count = MARK.subn(lambda m: f"{m[1]}{block}\n{m[2]}", page)
    if count != 1:
        raise ValueError(f"{PAGE.name} needs one part between <!-- bench --> and <!-- end -->, has {count}")
    return new
