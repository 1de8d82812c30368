"""How every figure looks: colours by method, sizes in inches at the printed scale, byte-stable files."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

WIDTH = 7.2  # in; the text width of a page, so that nothing is scaled in print
NARROW = 3.6  # in; what a phone shows without making letters small

# Okabe and Ito's palette, told apart by readers with any colour vision; a method has one colour in every figure.
COLORS = {
    "hippo_random": "#0072B2",
    "hippo_p10": "#56B4E9",
    "hippo_p1": "#CC79A7",
    "ppo": "#D55E00",
    "ppo_repeat": "#E69F00",
    "hier_vpg": "#009E73",
    "option_critic": "#000000",
    "mlsh": "#8C564B",
    "hiro": "#999933",
    "adapted_p10": "#332288",
    "adapted_random": "#44AA99",
    "hiro_xy": "#661100",
    "hiro_scratch": "#DDCC77",
    "fixed_p10": "#882255",
    "hippo_random_single": "#7B3294",
    "hippo_p10_single": "#A6761D",
}
SPARE_COLORS = ("#7F7F7F", "#17BECF", "#AA4499", "#117733")

RC: dict[str, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 8,
    "axes.titlesize": 9,
    "axes.labelsize": 8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#E6E6E6",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "lines.linewidth": 1.6,
    "pdf.fonttype": 42,
    "svg.hashsalt": "hippo-suite",
    "figure.dpi": 100,
}


def color_of(variant: str, variants: list[str]) -> str:
    """The colour of a method; one without a colour of its own takes, by its place, one that is not taken."""
    if variant in COLORS:
        return COLORS[variant]
    others = [v for v in variants if v not in COLORS]
    free = [*SPARE_COLORS, *(color for method, color in COLORS.items() if method not in variants)]
    return free[others.index(variant) % len(free)]


def use() -> None:
    """Set matplotlib up: no display, our look."""
    mpl.use("Agg")
    mpl.rcParams.update(mpl.rcParamsDefault)
    mpl.rcParams.update(RC)  # type: ignore[arg-type]


def watermark(figure: Figure, text: str) -> None:
    """Write `text` large and pale across the figure, smaller where a line is long."""
    figure.text(
        0.5,
        0.42,
        text,
        fontsize=min(80, 400 / max(map(len, text.splitlines()))),
        color="#BBBBBB",
        alpha=0.35,
        ha="center",
        va="center",
        rotation=18,
        zorder=0,
    )


def formats(stem: Path) -> list[Path]:
    """`stem`.pdf, .svg and .png."""
    return [stem.with_suffix(suffix) for suffix in (".pdf", ".svg", ".png")]


def narrow(stem: Path) -> Path:
    """Where the same picture with its panels below each other goes, for a phone."""
    return stem.with_name(f"{stem.name}.narrow.png")


def save(figure: Figure, paths: Sequence[Path], title: str, provenance: str) -> list[Path]:
    """Write a figure to `paths`, in the format of each one's suffix; the same figure gives the same bytes.

    Args:
        provenance: which runs and which commit stand behind it; goes into the files' metadata.
    """
    metadata: dict[str, dict[str, Any]] = {
        ".pdf": {"Creator": "hippo-suite", "Keywords": provenance, "CreationDate": None, "Producer": None},
        ".svg": {"Creator": "hippo-suite", "Description": provenance, "Date": None},
        ".png": {"Software": "hippo-suite", "Description": provenance},
    }
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(f"{path.stem}.tmp{path.suffix}")
        figure.savefig(temporary, metadata={"Title": title} | metadata[path.suffix], dpi=220)
        os.replace(temporary, path)
    return list(paths)
