"""What a sweep and the drawing code leave behind, tiny and written by hand: two figures, a table, claims, runs."""

import json
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
from PIL import Image, PngImagePlugin

ATTACK = "<img src=x onerror=alert(1)>"
BREAKOUT = '"><script>alert(2)</script>'
MARKDOWN_ATTACK = "a|b](https://example.org/x) **c** `d` www.example.org"
RUNS = ("0123456789ab", "0123456789ac", "0123456789ad")


def picture(path: Path, title: str, runs: tuple[str, ...] = (), size: tuple[int, int] = (1600, 500)) -> None:
    """A PNG with the metadata that paper_figures.style gives it."""
    information = PngImagePlugin.PngInfo()
    information.add_text("Title", title)
    if runs:
        information.add_text("Description", f"{len(runs)} runs, set 0123456789ab: {' '.join(runs)}")
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", size, "#88aacc").save(path, pnginfo=information)


def planned(run_id: str, seed: int, state: str = "finished", label: str = "HiPPO random p") -> dict:
    """A run as it stands in a plan."""
    labels = {"env": "ant_gather", "env_label": "Ant Gather", "variant": "hippo_random", "variant_label": label}
    rest = {"iterations": 2, "batch_size": 10, "physics": "paper", "kind": "train", "ancestors": [], "state": state}
    return {"run_id": run_id, "seed": seed} | labels | rest


def plan(
    root: Path,
    figure: str,
    runs: list[dict],
    title: str = "A title",
    claims: tuple[str, ...] = (),
    scales: tuple[str, ...] = ("smoke",),
) -> None:
    """A plan as a sweep writes it."""
    path = root / "runs/plans/smoke" / f"{figure}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    content = {"figure": figure, "scale": "smoke", "title": title, "runs": runs, "claims": list(claims), "notes": []}
    content["scales"] = list(scales)
    path.write_text(json.dumps(content))


def folder(root: Path, run_id: str, state: str = "finished", **manifest: object) -> Path:
    """A run folder: its status, manifest and clocks (3.5 s in two iterations)."""
    path = root / "runs" / run_id
    path.mkdir(parents=True)
    (path / "status.json").write_text(json.dumps({"state": state, "host": "a-secret-host"}))
    identity = {"algo": "hippo", "env": "ant_gather", "seed": 0}
    content = {"identity": identity, "git_commit": "c" * 40, "git_difference": None, "lock": "d" * 64, "cpu": "A CPU"}
    (path / "manifest.json").write_text(json.dumps(content | manifest))
    (path / "timing.csv").write_text("iteration,seconds,steps_per_second\n0,1.25,10\n1,2.25,10\n")
    return path


def table(root: Path, name: str, rows: list[str], header: str = "method | return") -> None:
    """A table as paper_figures.tabular writes it."""
    lines = ["A table. With a note.", "", f"| {header} |", "|" + "---|" * (header.count("|") + 1)]
    path = root / "out/smoke" / f"{name}.md"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join([*lines, *(f"| {row} |" for row in rows)]) + "\n")


def claims(root: Path, verdicts: tuple[str, ...] = ("reproduced", "not reproduced")) -> None:
    """claims.md as analysis.claims writes it."""
    columns = ("claim", "where", "sentence", "verdict", "why", "differences [90 % interval]", "the paper's own numbers")
    head = f"| {' | '.join(columns)} |\n|---|---|---|---|---|---|---|\n"
    rows = "".join(
        f"| name_{i} | section 5 | {ATTACK} | {verdict} | because | ant +1 [0, 2] | |\n"
        for i, verdict in enumerate(verdicts)
    )
    path = root / "out/smoke/claims.md"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"{head}{rows}\nMeasured coverage: 0.95.\n")


def hostile(root: Path) -> list[str]:
    """Everything at once, hostile wherever a name may come from elsewhere; the arguments of analysis.report."""
    runs = [planned(RUNS[0], 0, label=ATTACK), planned(RUNS[1], 1, "missing", BREAKOUT), planned(ATTACK, 2)]
    plan(root, "fig3", runs, BREAKOUT, (ATTACK, MARKDOWN_ATTACK))
    plan(root, "table1", [planned(RUNS[0], 0, label=BREAKOUT)])
    film = folder(root, RUNS[0], git_difference="e" * 64) / "video.gif"
    Image.new("RGB", (64, 48), "#556677").save(film)
    imageio.mimwrite(film.with_suffix(".mp4"), [np.full((48, 64, 3), 30 * i, np.uint8) for i in range(5)], fps=5)
    folder(root, ATTACK, state=BREAKOUT, git_commit=BREAKOUT)
    picture(root / "out/smoke/fig3.png", "fig3: x", RUNS[:1])
    (root / "out/smoke/fig3.caption.txt").write_text(f"{ATTACK}\n{BREAKOUT}\n{MARKDOWN_ATTACK}\n")
    picture(root / "out/smoke/fig1.png", f"fig1: {ATTACK}", size=(800, 800))
    picture(root / "out/smoke/gallery.png", BREAKOUT)
    wide = ["a very long name of a method that does not fit", *(["0.123 ± 0.045"] * 14)]
    table(root, "table1", [f"**{ATTACK}** | 1.0" + " | x" * 13, " | ".join(wide)], " | ".join("abcdefghijklmno"))
    claims(root, ("reproduced", "not reproduced", "inconclusive", BREAKOUT))
    return ["--runs-dir", str(root / "runs"), "--out", str(root / "out")]
