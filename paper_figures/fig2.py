"""Figure 2: the four environments, rendered from the simulations themselves.

Without OpenGL the committed frames are shown, and the caption says so; `python -m paper_figures.fig2 --commit` renews
them.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from analysis.edition import chosen
from hippo.envs import make
from hippo.envs.rendering import NoOpenGL, Renderer
from paper_figures import style
from paper_figures.command_line import parse

TITLE = "The environments"
CAPTION = (
    "Environments used to evaluate the methods. Every episode has a different configuration: wall heights for (a) and "
    "(b), positions of apples (green balls) and bombs (red cubes) for (c) and (d); a thin ray is a lidar reading, "
    "along the middle of its bin and as long as the nearest object is far."
)
PANELS = {
    "block_hopper": "(a) Block Hopper",
    "block_half_cheetah": "(b) Block Half-Cheetah",
    "snake_gather": "(c) Snake Gather",
    "ant_gather": "(d) Ant Gather",
}
FRAMES = Path(__file__).parent / "data" / "frames"
STEPS = 12  # a little of random motion, so that no robot stands at attention
SEED = 4


def render(name: str) -> np.ndarray:
    """(480, 640, 3) uint8 frame of an environment shortly after a reset."""
    envs = make(name, 1, SEED)
    envs.reset(seed=SEED)
    rng = np.random.default_rng(SEED)
    for _ in range(STEPS):
        envs.step(0.3 * rng.uniform(-1, 1, envs.action_space.shape or ()))
    renderer = Renderer(envs)
    frame = renderer.frame(0)
    renderer.close()
    return frame


def frames() -> tuple[dict[str, np.ndarray], str]:
    """A frame per environment, and where they come from."""
    try:
        return {name: render(name) for name in PANELS}, "rendered here"
    except NoOpenGL as error:
        committed = {name: (plt.imread(FRAMES / f"{name}.png") * 255).astype(np.uint8) for name in PANELS}
        return committed, f"committed frames ({error})"


def main(arguments: Sequence[str] | None = None) -> int:
    """Draw the four panels; every scale gives the same figure."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    commit = "--commit" in arguments
    options = parse("fig2", [a for a in arguments if a != "--commit"])
    style.use()
    pictures, source = frames()
    if commit:
        FRAMES.mkdir(parents=True, exist_ok=True)
        for name, picture in pictures.items():
            plt.imsave(FRAMES / f"{name}.png", picture)
    stem, written = options.out / chosen(options).folder / "fig2", []
    for shape, size, paths in (
        ((1, 4), (style.WIDTH, 1.6), style.formats(stem)),
        ((4, 1), (style.NARROW, 12.0), [style.narrow(stem)]),
    ):
        figure, grid = plt.subplots(*shape, figsize=size, layout="constrained")
        for axes, (name, label) in zip(grid, PANELS.items(), strict=True):
            axes.imshow(pictures[name])
            axes.set_title(label, fontsize=8)
            axes.axis("off")
        written += style.save(figure, paths, TITLE, source)
        plt.close(figure)
    caption = stem.with_suffix(".caption.txt")
    caption.write_text(f"{TITLE}. {CAPTION} Frames: {source}.\n")
    print("wrote", *written, caption, f"({source})")
    return 0


if __name__ == "__main__":
    sys.exit(main())
