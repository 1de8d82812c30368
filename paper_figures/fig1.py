"""Figure 1: the temporal hierarchy - a manager that commits to a skill every p steps, a skill that acts in between."""

import sys
from collections.abc import Sequence
from typing import Any

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

from analysis.edition import chosen
from paper_figures import style
from paper_figures.command_line import parse

TITLE = "The temporal hierarchy"
CAPTION = (
    "A latent code z is sampled from the manager policy every p steps from the current observation; the actions are "
    "sampled from the sub-policy conditioned on the same code until the next decision. Drawn by code after Figure 1 of "
    "the paper."
)
MANAGER, SKILL, STATE = "#0072B2", "#D55E00", "#F2F2F2"
TOP, MIDDLE, BOTTOM = 3.0, 1.5, 0.0  # rows: manager, skill, environment
COLUMNS = (0.0, 1.7, 4.3, 6.8, 8.5)  # s_kp, s_kp+1, the end of the commitment, the next decision, after it
DOTS, LABELS = 3.0, -2.3  # where columns are left out; where the rows' names begin
HALVES = ((LABELS, 4.93), (3.2, 10.43))  # of the narrow picture; the second takes up the first's last column


def box(axes: Axes, x: float, y: float, text: str, face: str, ink: str = "white") -> None:
    """A rounded box around `text`."""
    patch = FancyBboxPatch(
        (x - 0.6, y - 0.3), 1.2, 0.6, "round,pad=0.02,rounding_size=0.12", fc=face, ec="#555555", lw=0.8
    )
    axes.add_patch(patch)
    axes.text(x, y, text, ha="center", va="center", color=ink, fontsize=8)


def arrow(axes: Axes, start: tuple[float, float], end: tuple[float, float], **how: Any) -> None:
    """An arrow between two points."""
    look: dict[str, Any] = {
        "arrowstyle": "-|>",
        "mutation_scale": 9,
        "color": "#333333",
        "lw": 1.0,
        "shrinkA": 0,
        "shrinkB": 0,
    } | how
    axes.add_patch(FancyArrowPatch(start, end, **look))


def draw(axes: Axes, left: float = LABELS, right: float = COLUMNS[-1] + 0.8) -> None:
    """One commitment of p steps and the beginning of the next, from `left` to `right`."""
    states = ["$s_{kp}$", "$s_{kp+1}$", "$s_{(k+1)p-1}$", "$s_{(k+1)p}$", "$s_{(k+1)p+1}$"]
    actions = ["$a_{kp}$", "$a_{kp+1}$", "$a_{(k+1)p-1}$", "$a_{(k+1)p}$", ""]
    for i, (x, state, action) in enumerate(zip(COLUMNS, states, actions, strict=True)):
        box(axes, x, BOTTOM, state, STATE, "black")
        if not action:
            continue
        box(axes, x, MIDDLE, r"$\pi_{\theta_l}(a|s,z)$", SKILL)
        arrow(axes, (x - 0.3, BOTTOM + 0.33), (x - 0.3, MIDDLE - 0.33))
        # an action goes into the transition to the next state
        arrow(axes, (x + 0.3, MIDDLE - 0.33), (x + 0.8, BOTTOM + 0.05))
        axes.text(x + 0.64, (MIDDLE + BOTTOM) / 2, action, va="center", fontsize=8)
        following = DOTS - 0.25 if i == 1 else COLUMNS[i + 1] - 0.63
        arrow(axes, (x + 0.63, BOTTOM), (following, BOTTOM))
    for y in (BOTTOM, MIDDLE):
        axes.text(DOTS, y, r"$\cdots$", ha="center", va="center", fontsize=12)
    arrow(axes, (DOTS + 0.25, BOTTOM), (COLUMNS[2] - 0.63, BOTTOM))

    rail = (TOP + MIDDLE) / 2 + 0.1
    for x, z, end in ((COLUMNS[0], "$z_{kp}$", COLUMNS[2]), (COLUMNS[3], "$z_{(k+1)p}$", COLUMNS[4])):
        box(axes, x, TOP, r"$\pi_{\theta_h}(z|s)$", MANAGER)
        arrow(axes, (x - 0.5, BOTTOM + 0.33), (x - 0.5, TOP - 0.33), connectionstyle="arc3,rad=-0.28")
        axes.plot([x, x], [TOP - 0.33, rail], color=MANAGER, lw=1.4)
        axes.plot([x, end], [rail, rail], color=MANAGER, lw=1.4, ls="-" if end == COLUMNS[2] else (0, (4, 2)))
        axes.text(x + 0.1, rail + 0.14, z, va="center", fontsize=8, color=MANAGER)
    for x in COLUMNS[:4]:
        arrow(axes, (x, rail), (x, MIDDLE + 0.33), color=MANAGER)
    arrow(axes, (COLUMNS[0] - 0.6, -0.72), (COLUMNS[2] + 0.6, -0.72), arrowstyle="<->")
    axes.text((COLUMNS[0] + COLUMNS[2]) / 2, -0.98, "time commitment: $p$ steps", ha="center", va="center", fontsize=8)
    for y, role in ((TOP, "manager"), (MIDDLE, "sub-policy\n(skill)"), (BOTTOM, "environment")):
        axes.text(LABELS, y, role, ha="left", va="center", fontsize=8, color="#555555")
    axes.set_xlim(left, right)
    for text in axes.texts:  # which the panel's edges would not cut off
        text.set_visible(left <= text.get_position()[0] <= right)
    axes.set_ylim(-1.2, TOP + 0.5)
    axes.set_aspect("equal")
    axes.axis("off")


def main(arguments: Sequence[str] | None = None) -> int:
    """Draw it; there is no data behind it, so every scale gives the same figure."""
    options = parse("fig1", arguments)
    style.use()
    figure, axes = plt.subplots(figsize=(style.WIDTH, 3.1), layout="constrained")
    draw(axes)
    stem = options.out / chosen(options).folder / "fig1"
    written = style.save(figure, style.formats(stem), TITLE, "no data: a diagram")
    figure, rows = plt.subplots(2, 1, figsize=(style.NARROW, 5.2), layout="constrained")
    for axes, half in zip(rows, HALVES, strict=True):
        draw(axes, *half)
    written += style.save(figure, [style.narrow(stem)], TITLE, "no data: a diagram")
    plt.close("all")
    caption = stem.with_suffix(".caption.txt")
    caption.write_text(f"{TITLE}. {CAPTION}\n")
    print("wrote", *written, caption)
    return 0


if __name__ == "__main__":
    sys.exit(main())
