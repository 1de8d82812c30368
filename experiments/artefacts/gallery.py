"""How diverse the skills of a skills file are: measured on fresh paths, beside skills that nobody trained.

    python -m experiments.artefacts.gallery paper_figures/data/skills/ant.pt [--paths 600] [--out DIR] [--videos DIR]

writes beside the file, or in --out, <name>.metrics.csv, <name>.paths.csv (some paths) and <name>.visits.csv (visits per
cell), which `python -m paper_figures.gallery` draws, and with --videos a short video of each skill. docs/skills.md has
the formulas.
"""

import hashlib
import itertools
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from baselines.diayn import Discriminator
from baselines.snn import cells, entropy, log_shares
from experiments.command_line import EXIT_FAILED, Parser, bad_input, clock, run_command
from experiments.status import write_atomically
from experiments.video import Recorded, streamed
from hippo.core import seeding
from hippo.core.policies import SkillPolicy
from hippo.core.pretraining import Paths, PretrainingConfig, collect
from hippo.core.settings import ConfigError
from hippo.core.skills import SkillsError, policy_of
from hippo.envs import make
from hippo.envs.rendering import NoOpenGL

STEPS = {"snn": 400, "diayn": 1000}  # of a path, as in pre-training at laptop scale
CELLS_PER_METRE = 10
PERMUTATIONS = 100
RANDOM_NETWORKS = 3  # each as many paths as the trained one, so that every measure compares
BLOCK = 60  # paths simulated side by side
DRAWN_PATHS = 6  # per skill, in paths.csv
DRAWN_POINTS = 40  # of a path
STATES = 2000  # at which action distributions are compared
VIDEO_STEPS = {"ant": 400, "snake": 100, "hopper": 250, "half_cheetah": 100}  # 4 to 5 s
PHYSICS = "paper"
TABLES = ("paths", "visits", "metrics")


@dataclass
class Rollouts:
    """P paths of T steps: what was seen (T, P, D) and where (T + 1, P, 2) m from the start, whose skill (P,)."""

    obs: Tensor
    place: np.ndarray
    skill: np.ndarray
    ended_early: int


def roll_out(policy: SkillPolicy, env: str, steps: int, paths: int, seed: int, what: str) -> Rollouts:
    """Fresh paths of every skill in turn, `paths` in all, under the paper's physics; prints progress."""
    parts, begun = [], time.monotonic()
    for block, size in enumerate(split(paths)):
        skill = (np.arange(size) + block * BLOCK) % policy.num_skills
        config = PretrainingConfig(iterations=1, batch_size=size * steps, horizon=steps)
        envs = make(env, size, 0, horizon=steps, physics=PHYSICS)
        walked = collect(policy, envs, config, seeding.integer(seed, "gallery"), block, skill)
        envs.close()
        parts.append((walked.next_obs, from_start(walked), skill, int(walked.steps.done[:-1].any(0).sum())))
        done = sum(len(part[2]) for part in parts)
        eta = (time.monotonic() - begun) * (paths - done) / done
        print(f"{env}, {what} skills: {done}/{paths} paths, ETA {clock(eta)}", flush=True)
    obs, place, skills, early = zip(*parts, strict=True)
    return Rollouts(torch.cat(obs, 1), np.concatenate(place, 1), np.concatenate(skills), sum(early))


def split(paths: int) -> list[int]:
    """Sizes of blocks."""
    return [BLOCK] * (paths // BLOCK) + [paths % BLOCK] * (paths % BLOCK > 0)


def from_start(paths: Paths) -> np.ndarray:
    """(T + 1, P, 2) m, the centre of mass from where the path started; a path that ends early stays where it ended."""
    position = np.concatenate([paths.position[:1].numpy(), paths.next_position.numpy()])[..., :2]
    done = paths.steps.done.numpy()
    last = np.where(done.any(0), done.argmax(0) + 1, len(done))  # what follows in the same slot is another path
    row = np.minimum(np.arange(len(position))[:, None], last)
    return np.take_along_axis(position, row[..., None], 0) - position[0]


def information(cell: np.ndarray, skill: np.ndarray, num_skills: int) -> float:
    """Plug-in estimate of I(z; cell) in nat: cells (T, P, 2), the skills of the paths (P,)."""
    z = np.broadcast_to(skill, cell.shape[:2]).reshape(-1)
    return float(log_shares(cell.reshape(-1, 2), z, num_skills).mean() + entropy(z))


def permuted_information(cell: np.ndarray, skill: np.ndarray, num_skills: int, seed: int) -> float:
    """Its mean under permutations of the skills over whole paths: what paths that know nothing of z would score."""
    # Cells are numbered once: 100 permutations would otherwise spend their time in np.unique.
    _, index = np.unique(cell.reshape(-1, 2), axis=0, return_inverse=True)
    numbered = np.stack([index.reshape(cell.shape[:2]), np.zeros(cell.shape[:2], np.int64)], -1)
    rng = np.random.default_rng(seed)
    return float(np.mean([information(numbered, rng.permutation(skill), num_skills) for _ in range(PERMUTATIONS)]))


def held_out_accuracy(names: Sequence[str], rollouts: Rollouts, num_skills: int) -> float:
    """Share of states whose skill DIAYN's discriminator names, fitted to half of the paths, on the other half."""
    generator = torch.Generator().manual_seed(0)
    discriminator = Discriminator(names, num_skills, [128, 128], generator)
    optimizer = torch.optim.Adam(discriminator.parameters(), lr=1e-3)
    T, paths = rollouts.obs.shape[:2]
    skill = torch.from_numpy(rollouts.skill).expand(T, paths)
    fitted = torch.arange(paths) // num_skills % 2 == 0
    obs = [rollouts.obs[:, which].flatten(0, 1) for which in (fitted, ~fitted)]
    label = [skill[:, which].flatten() for which in (fitted, ~fitted)]
    discriminator.fit(optimizer, obs[0], label[0], 2, 512, generator)
    with torch.no_grad():
        right = [discriminator.log_probs(part).argmax(1) for part in obs[1].split(10_000)]
    return float((torch.cat(right) == label[1]).double().mean())


@torch.no_grad()
def action_distance(policy: SkillPolicy, obs: Tensor) -> float:
    """2-Wasserstein distance of two skills' action distributions, mean over pairs of skills and states (B, D).

    sqrt(|mu_i - mu_j|^2 + |sigma_i - sigma_j|^2) for diagonal Gaussians, in units of the action range's half.
    """
    mean, std = policy.means(policy.see(obs)), policy.log_std().exp()
    pairs = itertools.combinations(range(policy.num_skills), 2)
    distances = [
        ((mean[:, i] - mean[:, j]).square().sum(-1) + (std[i] - std[j]).square().sum()).sqrt().mean() for i, j in pairs
    ]
    return float(torch.stack(distances).mean()) if distances else 0.0


def measure(policy: SkillPolicy, names: Sequence[str], rollouts: Rollouts) -> pd.DataFrame:
    """Rows metric, skill ("" for all), value."""
    n, cell = policy.num_skills, cells(rollouts.place[1:], CELLS_PER_METRE)
    plug_in = information(cell, rollouts.skill, n)
    chance = permuted_information(cell, rollouts.skill, n, 0)
    states = rollouts.obs.flatten(0, 1)
    some = torch.randperm(len(states), generator=torch.Generator().manual_seed(0))[:STATES]
    end = np.linalg.norm(rollouts.place[-1], axis=1)
    values: dict[str, float] = {
        "paths": len(rollouts.skill),
        "steps_per_path": len(rollouts.place) - 1,
        "paths_ended_early": rollouts.ended_early,
        "information": plug_in,
        "information_permuted": chance,
        "information_corrected": plug_in - chance,
        "accuracy": held_out_accuracy(names, rollouts, n),
        "action_distance": action_distance(policy, states[some]),
        "action_std": float(policy.log_std().exp().mean().detach()),
        "cells": len(np.unique(cell.reshape(-1, 2), axis=0)),
        "distance": float(end.mean()),
    }
    rows: list[dict[str, Any]] = [{"metric": name, "skill": "", "value": value} for name, value in values.items()]
    for z in range(n):
        mine = rollouts.skill == z
        of_skill = {
            "distance": float(end[mine].mean()),
            "cells": len(np.unique(cell[:, mine].reshape(-1, 2), axis=0)),
        }
        rows += [{"metric": name, "skill": z, "value": value} for name, value in of_skill.items()]
    return pd.DataFrame(rows)


def further_than_random(metrics: pd.DataFrame) -> int:
    """How many trained skills end further from the start, on average, than every random skill of every network."""
    of_skills = metrics[(metrics["metric"] == "distance") & (metrics["skill"] != "")]
    best = of_skills.loc[of_skills["group"] == "random", "value"].max()
    return int((of_skills.loc[of_skills["group"] == "trained", "value"] > best).sum())


def drawn_paths(group: str, rollouts: Rollouts) -> pd.DataFrame:
    """Some paths of every skill, thinned: group, skill, path, step, x, y."""
    steps = np.unique(np.linspace(0, len(rollouts.place) - 1, DRAWN_POINTS).round().astype(int))
    parts = []
    for z in np.unique(rollouts.skill):
        for path in np.flatnonzero(rollouts.skill == z)[:DRAWN_PATHS]:
            x, y = rollouts.place[steps, path].T.round(2)
            parts.append(pd.DataFrame({"group": group, "skill": z, "path": path, "step": steps, "x": x, "y": y}))
    return pd.concat(parts)


def visits(group: str, rollouts: Rollouts, cells_per_metre: float) -> pd.DataFrame:
    """Steps per skill and cell: group, skill, x, y (m, the cell's middle), steps."""
    cell = np.floor(rollouts.place[1:] * cells_per_metre).astype(int).reshape(-1, 2)
    z = np.broadcast_to(rollouts.skill, rollouts.place[1:].shape[:2]).reshape(-1)
    table = pd.DataFrame({"group": group, "skill": z, "x": cell[:, 0], "y": cell[:, 1]})
    table = table.value_counts(sort=False).reset_index(name="steps")
    table[["x", "y"]] = ((table[["x", "y"]] + 0.5) / cells_per_metre).round(3)
    return table


def study(path: Path, paths: int, seed: int) -> dict[str, pd.DataFrame]:
    """The tables metrics, paths and visits of a skills file and of random skills of the same networks.

    Raises:
        SkillsError: it cannot be read. ConfigError: there are fewer than 2 paths per skill.
    """
    policy, metadata = policy_of(path)
    n = policy.num_skills
    if paths < 2 * n:
        raise ConfigError("paths", paths, f"must be at least {2 * n}, two for each of {n} skills")
    env, algo = metadata["env"], metadata["algo"]
    if algo not in STEPS or env not in VIDEO_STEPS:
        valid = f"must hold skills of {', '.join(STEPS)} for {', '.join(VIDEO_STEPS)}, not of {algo} for {env}"
        raise ConfigError("skills", path, valid)
    steps = STEPS[algo]
    policies = {("trained", 0): policy} | {
        ("random", network): untrained(metadata, seeding.torch_generator(seed, "random skills", network))
        for network in range(RANDOM_NETWORKS)
    }
    envs = make(env, 1, 0)
    names = envs.observation_names[: envs.robot_size]
    envs.close()
    metrics, rolled = [], {}
    for (group, network), each in policies.items():
        what = group if group == "trained" else f"{group} ({network + 1} of {RANDOM_NETWORKS} networks)"
        rollouts = roll_out(each, env, steps, paths, seed, what)
        metrics.append(measure(each, names, rollouts).assign(group=group, network=network))
        if network == 0:  # the others are measured, not drawn
            rolled[group] = rollouts
    measured = pd.concat(metrics)[["group", "network", "metric", "skill", "value"]]
    further = {"group": "trained", "network": 0, "metric": "skills_further_than_random", "skill": ""}
    measured = pd.concat([measured, pd.DataFrame([further | {"value": further_than_random(measured)}])])
    reach = max(float(np.abs(rollouts.place).max()) for rollouts in rolled.values())
    density = 25 / max(reach, 0.1)  # some 50 cells across the picture
    provenance = {name: metadata[name] for name in ("env", "algo", "run_id", "env_steps")}
    provenance |= {"trained_physics": metadata["physics"], "measured_physics": PHYSICS}
    return {
        "metrics": measured.assign(**provenance, skills_sha256=digest(path)),
        "paths": pd.concat([drawn_paths(group, rollouts) for group, rollouts in rolled.items()]),
        "visits": pd.concat([visits(group, rollouts, density) for group, rollouts in rolled.items()]),
    }


def untrained(metadata: dict[str, Any], generator: torch.Generator) -> SkillPolicy:
    """Skills as drawn, of the network that a skills file's metadata describe."""
    return SkillPolicy(
        metadata["obs_size"],
        metadata["num_skills"],
        metadata["action_size"],
        metadata["hidden_sizes"],
        generator,
        metadata["integration"],
        metadata["log_std_per_skill"],
    )


def digest(path: Path) -> str:
    """The start of a file's SHA-256; skills trained anew by changed code may keep their run's id."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:12]


def table_path(path: Path, folder: Path, name: str) -> Path:
    """Where a table about the skills file at `path` is."""
    return folder / f"{path.stem}.{name}.csv"


def write(path: Path, folder: Path, tables: dict[str, pd.DataFrame]) -> None:
    """Write the tables about the skills file at `path` into `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, table in tables.items():
        text = table.to_csv(index=False, lineterminator="\n", float_format="%.6g")
        write_atomically(table_path(path, folder, name), text)


def is_measured(path: Path, folder: Path) -> bool:
    """Whether the tables in `folder` are about the skills file at `path` as it is now."""
    if not path.is_file() or not all(table_path(path, folder, name).exists() for name in TABLES):
        return False
    lines = table_path(path, folder, "metrics").read_text().splitlines()
    return len(lines) > 1 and all(line.endswith(f",{digest(path)}") for line in lines[1:])


def film(path: Path, folder: Path, seed: int) -> None:
    """A short video of each skill, `folder`/<env>_skill_<z>.mp4.

    Raises:
        NoOpenGL: nothing here can draw.
    """
    policy, metadata = policy_of(path)
    act = policy.actor()
    for z in range(policy.num_skills):
        target, rng = folder / f"{metadata['env']}_skill_{z}.mp4", np.random.default_rng(seed)
        with streamed(target) as append:
            envs = Recorded(make(metadata["env"], 1, seed, physics=PHYSICS), append, VIDEO_STEPS[metadata["env"]])
            obs, _ = envs.reset(seed=seed)
            for _ in range(VIDEO_STEPS[metadata["env"]]):
                noise = rng.standard_normal((1, *envs.single_action_space.shape), np.float32)
                obs, *_ = envs.step(act(policy.see_array(obs), np.array([z]), noise))
            envs.close()
        print(f"wrote {target}", flush=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and film from the command line."""
    parser = Parser(prog="experiments.artefacts.gallery", description=__doc__.splitlines()[0])
    parser.add_argument("skills", type=Path, nargs="+", help="skills files")
    parser.add_argument("--paths", type=int, default=600, help="fresh paths of the skills, and of random ones")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="folder of the tables (default: that of the skills file)")
    parser.add_argument("--videos", type=Path, help="folder for a short video of each skill")
    parser.add_argument("--again", action="store_true", help="measure what is already measured")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    try:
        for path in options.skills:
            folder = options.out or path.parent
            if options.again or not is_measured(path, folder):
                write(path, folder, study(path, options.paths, options.seed))
            if options.videos is not None:
                film(path, options.videos, options.seed)
    except (ConfigError, SkillsError) as error:
        return bad_input(error)
    except NoOpenGL as error:
        print(f"no videos: {error}", file=sys.stderr)
        return EXIT_FAILED
    return 0


if __name__ == "__main__":
    run_command(main)
