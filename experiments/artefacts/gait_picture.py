"""The blind gaits of gaits.json as a picture: a strip of frames per task, around the clearing of a wall.

    python -m experiments.artefacts.gait_picture docs/pictures/gaits.png

Needs EGL or OSMesa (`make install-render`).
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import imageio.v2 as imageio
import numpy as np

from experiments.artefacts.calibration import blind_gait
from experiments.artefacts.gait_search import TASKS
from experiments.command_line import EXIT_FAILED, Parser, bad_input, check_writable, run_command
from hippo.core import seeding
from hippo.core.settings import ConfigError
from hippo.envs import make
from hippo.envs.rendering import NoOpenGL, Renderer

FRAMES, WIDTH, HEIGHT = 6, 320, 240
APART = 0.1  # s between frames
WALL = 2  # the one whose clearing is shown: the robot is under way by then
SEED = 0


def frames_of(task: str) -> np.ndarray:
    """(HEIGHT, FRAMES * WIDTH, 3) uint8: the frames, of which wall WALL is paid for between the middle two."""
    cleared = steps_until(task, WALL)
    envs = make(task, 1, SEED)
    every = round(APART * envs.metadata["render_fps"])
    shown = [cleared + round((i - (FRAMES - 1) / 2) * every) for i in range(FRAMES)]
    act = blind_gait(task)(envs, seeding.numpy_generator(SEED, "calibration"))
    obs, _ = envs.reset(seed=SEED)
    renderer = Renderer(envs, WIDTH, HEIGHT)
    frames = []
    for step in range(shown[-1] + 1):
        if step in shown:
            frames.append(renderer.frame(0))
        obs, *_ = envs.step(act(step, obs))
    renderer.close()
    return np.concatenate(frames, 1)


def steps_until(task: str, walls: int) -> int:
    """After how many steps the gait of `task` has cleared so many."""
    envs = make(task, 1, SEED)
    act = blind_gait(task)(envs, seeding.numpy_generator(SEED, "calibration"))
    obs, _ = envs.reset(seed=SEED)
    paid, step = 0.0, 0
    while paid < walls and step < envs.horizon:
        obs, reward, *_ = envs.step(act(step, obs))
        paid, step = paid + float(reward[0]), step + 1
    return step


def main(arguments: Sequence[str] | None = None) -> int:
    """Draw from the command line."""
    parser = Parser(prog="experiments.artefacts.gait_picture", description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, help="png to write")
    options = parser.parse_args(arguments)
    try:
        if options.out.suffix != ".png":
            raise ConfigError("out", options.out, "must end in .png")
        check_writable("out", options.out)
        imageio.imwrite(options.out, np.concatenate([frames_of(task) for task in TASKS]))
    except ConfigError as error:
        return bad_input(error)
    except NoOpenGL as error:
        print(f"error: {error}", file=sys.stderr)
        return EXIT_FAILED
    return 0


if __name__ == "__main__":
    run_command(main)
