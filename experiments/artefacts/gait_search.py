"""A blind gait for each Block task: what the task allows a policy that sees nothing, found without learning.

    python -m experiments.artefacts.gait_search block_hopper        # searches, half an hour; writes gaits.json

One sinusoid per joint, all of one frequency. The cross-entropy method looks for the parameters that take the robot
far: a candidate's score is its return plus its distance in walls, since walls alone reward hardly any beginner.
`python -m experiments.artefacts.calibration` measures what is found.
"""

import dataclasses
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from experiments.command_line import Parser, bad_input, run_command
from experiments.status import write_atomically
from hippo.core import seeding
from hippo.core.settings import ConfigError
from hippo.envs import ENVIRONMENTS, make
from hippo.envs.blocks import SPACING, Blocks

FOUND = Path(__file__).with_name("gaits.json")
TASKS = tuple(name for name, environment in ENVIRONMENTS.items() if environment.task is Blocks)
STEPS = 4_000_000  # environment steps of a search
CANDIDATES, EPISODES, ELITES = 60, 2, 8  # of one generation; each candidate runs so many episodes
FINALISTS_EPISODES = 20  # that decide between the last elites and their mean
MEAN = {"frequency": 2.0, "amplitude": 0.5, "phase": 0.0, "offset": 0.0}  # Hz, action, rad, action
STD = {"frequency": 1.0, "amplitude": 0.5, "phase": 2.0, "offset": 0.3}
FLOOR = 0.02  # of the initial spread, below which no generation's falls, so that the search stays alive
DECIMALS = 4  # of what is kept


@dataclass(frozen=True)
class Gait:
    """action_j(t) = offset_j + amplitude_j sin(2 pi frequency t + phase_j); environments clip it to [-1, 1]."""

    frequency: float  # Hz
    amplitude: tuple[float, ...]  # (A,)
    phase: tuple[float, ...]  # (A,) rad
    offset: tuple[float, ...]  # (A,)


def actions(parameters: np.ndarray, seconds: float) -> np.ndarray:
    """What candidates (N, 1 + 3 A) - frequency, amplitudes, phases, offsets - do at a time: (N, A)."""
    amplitude, phase, offset = np.split(parameters[:, 1:], 3, 1)
    return offset + amplitude * np.sin(2 * np.pi * parameters[:, :1] * seconds + phase)


def row(gait: Gait) -> np.ndarray:
    """The parameters (1 + 3 A,) of a gait."""
    return np.array([gait.frequency, *gait.amplitude, *gait.phase, *gait.offset])


def gait(parameters: np.ndarray) -> Gait:
    """The gait of parameters (1 + 3 A,)."""
    frequency, rest = float(parameters[0]), np.split(parameters[1:], 3)
    return Gait(frequency, *(tuple(part.tolist()) for part in rest))


def committed(task: str) -> Gait:
    """The gait that was found for `task`."""
    found = json.loads(FOUND.read_text())[task]
    return Gait(found["frequency"], *(tuple(found[name]) for name in ("amplitude", "phase", "offset")))


def scores(task: str, parameters: np.ndarray, episodes: int, seed: int, horizon: int | None = None) -> np.ndarray:
    """Mean score (N,) of candidates (N, P) over fresh episodes: walls cleared plus distance in walls."""
    envs = make(task, len(parameters) * episodes, seed, horizon=horizon)
    envs.reset()
    every = np.repeat(parameters, episodes, 0)
    walls, seconds = np.zeros(len(every)), 1 / envs.metadata["render_fps"]
    for step in range(envs.horizon):
        _, reward, *_, info = envs.step(actions(every, step * seconds))
        walls += reward
    return (walls + info["com"][:, 0] / SPACING).reshape(-1, episodes).mean(1)


def search(task: str, steps: int, seed: int, horizon: int | None = None, report: Callable[[str], None] = print) -> Gait:
    """The best gait that the cross-entropy method finds in so many environment steps."""
    num_joints = make(task, 1, 0).physics.model.nu
    mean, initial = (np.repeat([s[k] for k in MEAN], [1, *[num_joints] * 3]) for s in (MEAN, STD))
    std, rng = initial.copy(), seeding.numpy_generator(seed, "gait search")
    generations = steps // (CANDIDATES * EPISODES * (horizon or ENVIRONMENTS[task].horizon))
    for generation in range(generations):
        candidates = mean + std * rng.standard_normal((CANDIDATES, len(mean)))
        score = scores(task, candidates, EPISODES, seeding.integer(seed, "generation", generation), horizon)
        elites = candidates[np.argsort(-score)[:ELITES]]
        mean, std = elites.mean(0), np.maximum(elites.std(0), FLOOR * initial)
        report(
            f"{task}: generation {generation + 1} of {generations}, score {score.mean():.2f}, best {score.max():.2f}"
        )
    finalists = np.round([mean, *elites], DECIMALS)
    score = scores(task, finalists, FINALISTS_EPISODES, seeding.integer(seed, "finalists"), horizon)
    return gait(finalists[score.argmax()])


def main(arguments: Sequence[str] | None = None) -> int:
    """Search from the command line."""
    parser = Parser(prog="experiments.artefacts.gait_search", description=__doc__.splitlines()[0])
    parser.add_argument("task", choices=TASKS)
    parser.add_argument("--steps", type=int, default=STEPS, help=f"environment steps, default {STEPS}")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--out", type=Path, default=FOUND, help="a JSON file, of which only this task's entry is renewed"
    )
    options = parser.parse_args(arguments)
    least = ENVIRONMENTS[options.task].horizon * CANDIDATES * EPISODES
    if options.steps < least:
        return bad_input(ConfigError("--steps", options.steps, f"must be at least one generation, {least}"))
    if options.seed < 0:
        return bad_input(ConfigError("--seed", options.seed, "must be at least 0"))
    found = json.loads(options.out.read_text()) if options.out.exists() else {}
    found[options.task] = dataclasses.asdict(search(options.task, options.steps, options.seed))
    write_atomically(options.out, json.dumps(found, indent=1, sort_keys=True) + "\n")
    print(f"wrote {options.out}")
    return 0


if __name__ == "__main__":
    run_command(main)
