"""The generated tables of docs/environments: what is observed, which options there are, what a perturbation changes.

    python -m experiments.artefacts.environment_pages        # renews them; the text around them is written by hand

Every page is docs/environments/<environment>.md; a table stands between `<!-- table: NAME -->` and `<!-- end -->`.
"""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from experiments.choices import ROOT
from experiments.command_line import run_command
from hippo.envs import ENVIRONMENTS, gymnasium_id, make
from hippo.envs.perturb import PERTURBATIONS, STRENGTHS, change_of
from hippo.envs.registration import Options

FOLDER = ROOT / "docs" / "environments"
STEPS = 50  # of the comparison that finds out whether a perturbation changes anything
MARK = re.compile(r"(<!-- table: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def observation(name: str) -> str:
    """Every entry of the default observation: index, name, unit, bounds; the robot's part first."""
    envs = make(name, 1, 0)
    space: Any = envs.single_observation_space
    lines = ["| index | entry | unit | range | part |", "|---|---|---|---|---|"]
    for i, (entry, unit) in enumerate(zip(envs.observation_names, envs.observation_units, strict=True)):
        part = "robot" if i < envs.robot_size else "task"
        lines.append(f"| {i} | `{entry}` | {unit} | [{space.low[i]:g}, {space.high[i]:g}] | {part} |")
    return "\n".join(lines)


def options(name: str) -> str:
    """Option and values, the default first."""
    defaults = Options()
    lines = ["| option | default | other values |", "|---|---|---|"]
    for option, values in ENVIRONMENTS[name].options.items():
        default = getattr(defaults, option)
        others = ", ".join(f"`{value}`" for value in values if value != default) or "none"
        lines.append(f"| `{option}` | `{default}` | {others} |")
    return "\n".join(lines)


def summary(name: str) -> str:
    """Ids, sizes, times."""
    envs = make(name, 1, 0)
    timing = envs.robot.timing("paper")
    action = envs.single_action_space.shape
    assert action is not None
    rows = {
        "name, Gymnasium id": f"`{name}`, `{gymnasium_id(name)}`",
        "observation": f"{len(envs.observation_names)} numbers, of which {envs.robot_size} of the robot",
        "action": f"{action[0]} numbers in [-1, 1], mapped to the motors' control range",
        "horizon": f"{envs.horizon} steps",
        "control step": f"{timing.frame_skip} x {timing.timestep:g} s, {timing.integrator.name.removeprefix('mjINT_')}",
        "revision": str(envs.revision),
    }
    return "\n".join(["| | |", "|---|---|", *(f"| {key} | {value} |" for key, value in rows.items())])


def robots() -> str:
    """The robots alone: ids, sizes and times; their observation is the first part of their task's."""
    tasks = {e.robot: name for name, e in ENVIRONMENTS.items() if name != e.robot}
    lines = [
        "| name | Gymnasium id | observation | actions | horizon | control step | options |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, task in tasks.items():
        envs, whole = make(task, 1, 0), make(name, 1, 0)
        if whole.observation_names != envs.observation_names[: envs.robot_size]:
            raise ValueError(f"{name} does not observe what the robot of {task} does")
        timing, action = whole.robot.timing("paper"), whole.single_action_space.shape
        assert action is not None
        observed = f"{whole.robot_size}: entries 0 to {whole.robot_size - 1} of [{task}]({task}.md#observation)"
        step = f"{timing.frame_skip} x {timing.timestep:g} s"
        valid = ", ".join(f"`{option}`" for option, values in ENVIRONMENTS[name].options.items() if len(values) > 1)
        lines.append(
            f"| `{name}` | `{gymnasium_id(name)}` | {observed} | {action[0]} | {whole.horizon} | {step} | {valid} |"
        )
    return "\n".join(lines)


def perturbations() -> str:
    """What every perturbation multiplies on every robot, and whether its trajectories differ from the original's."""
    lines = [
        "| robot | quantity | strength | multiplied | factor | changes the dynamics |",
        "|---|---|---|---|---|---|",
    ]
    for name in ("ant_gather", "snake_gather", "block_hopper", "block_half_cheetah"):
        robot = ENVIRONMENTS[name].robot
        for quantity in PERTURBATIONS:
            for strength in STRENGTHS:
                try:
                    change = change_of(robot, quantity, strength, make(name, 1, 0).robot.spec("paper"))
                except ValueError:
                    continue
                what = ", ".join(change.elements) if strength == "original" else "every one"
                effect = "yes" if changes_dynamics(name, quantity, strength) else "**no**: bit-identical trajectories"
                lines.append(f"| {robot} | {quantity} | {strength} | {what} | {change.factor} | {effect} |")
    return "\n".join(lines)


def changes_dynamics(name: str, quantity: str, strength: str) -> bool:
    """Whether `STEPS` random steps end in another state."""
    states = []
    changes: dict[str, Any] = {"perturbation": quantity, "strength": strength}
    for options in ({}, changes):
        envs = make(name, 2, 0, **options)
        rng = np.random.default_rng(0)
        envs.reset(seed=0)
        for _ in range(STEPS):
            envs.step(rng.uniform(-1, 1, envs.action_space.shape or ()))
        states.append(np.concatenate([envs.physics.qpos, envs.physics.qvel], 1))
    return not np.array_equal(states[0], states[1])


def renewed(path: Path) -> str:
    """The page with its tables as they are now."""
    name = path.stem
    tables: dict[str, Callable[[], str]] = {
        "summary": lambda: summary(name),
        "observation": lambda: observation(name),
        "options": lambda: options(name),
        "robots": robots,
        "perturbations": perturbations,
    }
    return MARK.sub(lambda m: f"{m[1]}{tables[m[2]]()}\n{m[3]}", path.read_text())


def main() -> int:
    """Renew every page."""
    for path in sorted(FOLDER.glob("*.md")):
        path.write_text(renewed(path))
        print(f"wrote {path} (MuJoCo {mujoco.__version__})")
    return 0


if __name__ == "__main__":
    run_command(main)
