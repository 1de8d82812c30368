"""A video of a trained policy: one episode of a run, drawn frame by frame and written as it is drawn.

    python -m experiments.video runs/<run_id> [--out video.mp4] [--seed 0] [--greedy] [--perturbation mass]

Needs EGL or OSMesa (`make install-render`).
"""

import contextlib
import os
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
import torch
from gymnasium.error import DependencyNotInstalled

from experiments.command_line import EXIT_FAILED, Parser, bad_input, clock, run_command
from experiments.config import Run
from experiments.evaluate import environments, in_flags, load_run, trained
from hippo.core import seeding
from hippo.core.acting import rollout
from hippo.core.checkpoint import CheckpointError
from hippo.core.settings import ConfigError
from hippo.envs import foreign
from hippo.envs.rendering import NoOpenGL, Renderer, open_gl
from hippo.learners import learner_of

FRAMES_PER_SECOND = 25


class Recorded:
    """A vector environment of one that hands a frame to `write` every few steps, up to the end of the episode."""

    def __init__(self, envs: Any, write: Any, horizon: int) -> None:
        self._envs, self._write, self._horizon = envs, write, horizon
        self._renderer = envs if isinstance(envs, foreign.GymnasiumEnv) else Renderer(envs)
        self._every = max(1, round(envs.metadata["render_fps"] / FRAMES_PER_SECOND))
        self._steps, self._over = 0, False
        self._last_line = time.monotonic()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._envs, name)

    def step(self, actions: np.ndarray) -> tuple[Any, ...]:
        """As the environment's own; draws before the step, so that the first pose is seen."""
        if not self._over and self._steps % self._every == 0:
            self._write(self._renderer.frame(0))
        result = self._envs.step(actions)
        self._steps += 1
        self._over = self._over or bool(result[2][0] or result[3][0])
        if time.monotonic() - self._last_line > 5:
            self._last_line = time.monotonic()
            print(f"step {self._steps} of at most {self._horizon}", flush=True)
        return result

    def close(self) -> None:
        """Release the graphics memory and the environment."""
        self._renderer.close()
        if self._renderer is not self._envs:
            self._envs.close()


@contextlib.contextmanager
def streamed(path: Path) -> Iterator[Any]:
    """A function that appends a frame (H, W, 3) to the video at `path`; a part of a video is never left there."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{path.stem}.part{path.suffix}")
    try:
        writer: Any = imageio.get_writer(part, fps=FRAMES_PER_SECOND, macro_block_size=None)
        with writer:
            yield writer.append_data
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def record(run: Run, path: Path, seed: int, greedy: bool, **changes: Any) -> float:
    """Write a video of one episode of `run`'s policy; returns the episode's return.

    Raises:
        ConfigError: there is nothing trained, or no such option. NoOpenGL: nothing here can draw.
    """
    render_mode = None
    if foreign.is_foreign(run.env):  # draws itself
        os.environ.setdefault("MUJOCO_GL", open_gl())
        render_mode = "rgb_array"
    envs = environments(run, 1, seed, render_mode, **changes)
    with streamed(path) as write:
        recorded = Recorded(envs, write, run.config.horizon)
        streams = seeding.integer(seed, "evaluation of a policy")
        steps = rollout(learner_of(run.algo), run.restored_config, recorded, streams, trained(run), greedy)
    end = int(steps.done[:, 0].nonzero()[0]) + 1
    return float(steps.reward[:end, 0].sum())


def main(arguments: Sequence[str] | None = None) -> int:
    """Record from the command line."""
    parser = Parser(prog="experiments.video", description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path, help="a run folder")
    parser.add_argument("--out", type=Path, help="video to write (default: video.mp4 in the run's folder)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--greedy", action="store_true", help="most likely choices instead of samples")
    parser.add_argument("--perturbation", help="mass, damping, inertia or friction")
    parser.add_argument("--strength", help="original (default) or all")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    start = time.monotonic()
    try:
        run = load_run(options.run)
        path = options.out or options.run / "video.mp4"
        if path.suffix != ".mp4":
            raise ConfigError("out", path, "must end in .mp4")
        if options.seed < 0:
            raise ConfigError("seed", options.seed, "must be at least 0")
        changes = {"perturbation": options.perturbation, "strength": options.strength}
        total = record(run, path, options.seed, options.greedy, **changes)
    except ConfigError as error:
        return bad_input(in_flags(error))
    except CheckpointError as error:
        return bad_input(error)
    except (NoOpenGL, DependencyNotInstalled) as error:
        print(f"error: {error}", file=sys.stderr)
        return EXIT_FAILED
    print(f"{path}: return {total:.2f}, drawn in {clock(time.monotonic() - start)}")
    return 0


if __name__ == "__main__":
    run_command(main)
