"""Figures: drawn from a plan and run folders, the same bytes every time, honest about what is missing."""

import subprocess
import sys
from pathlib import Path

import pytest

from paper_figures import curves, style
from tests.test_analysis import planned

ROOT = Path(__file__).parent.parent


def draw(tmp_path, out="out"):
    arguments = ["--scale", "smoke", "--runs-dir", str(tmp_path), "--data", str(tmp_path / "data")]
    return curves.main("fig3", [*arguments, "--out", str(tmp_path / out)])


def test_a_figure_is_drawn_with_its_numbers_and_its_caption(tmp_path, capsys):
    planned(tmp_path, [3, 2])
    assert draw(tmp_path) == 0
    folder = tmp_path / "out/smoke"
    assert {p.name for p in folder.iterdir()} == {"fig3.csv", "fig3.pdf", "fig3.png", "fig3.caption.txt"}
    caption = (folder / "fig3.caption.txt").read_text()
    for part in (
        "A title",
        "n = 2 seeds",
        "95%",
        "2000 resamples",
        "Scale: smoke",
        "paper physics",
        "ppo seed 1 (failed)",
    ):
        assert part in caption
    assert "says nothing about the methods" in caption
    assert "missing or incomplete: block_hopper ppo seed 1" in capsys.readouterr().out
    assert (folder / "fig3.csv").read_text().count("\n") == 1 + 5
    assert f"{0:012x}".encode() in (folder / "fig3.png").read_bytes()  # provenance


def test_a_run_that_never_started_is_named_and_the_rest_is_drawn(tmp_path):
    planned(tmp_path, [3, None])
    assert draw(tmp_path) == 0
    assert "n = 1 seeds" in (tmp_path / "out/smoke/fig3.caption.txt").read_text()


def test_a_figure_drawn_twice_is_the_same_file(tmp_path):
    planned(tmp_path, [3, 3])
    draw(tmp_path, "a")
    draw(tmp_path, "b")
    for name in ("fig3.csv", "fig3.pdf", "fig3.png", "fig3.caption.txt"):
        assert (tmp_path / "a/smoke" / name).read_bytes() == (tmp_path / "b/smoke" / name).read_bytes()


def test_without_data_there_is_a_message_and_no_empty_figure(tmp_path, capsys):
    assert draw(tmp_path) == 2
    assert capsys.readouterr().err.startswith("error: fig3: no plan at scale smoke")
    assert not (tmp_path / "out").exists()


def test_two_kinds_of_physics_end_in_one_line(tmp_path, capsys):
    planned(tmp_path, [3, 3], physics=("paper", "fast"))
    assert draw(tmp_path) == 2
    assert "mixes two kinds of physics" in capsys.readouterr().err


def test_a_method_has_one_colour_and_no_two_methods_share_one():
    assert len(set(style.COLORS.values()) | set(style.SPARE_COLORS)) == len(style.COLORS) + len(style.SPARE_COLORS)
    variants = ["ppo", "new", "other"]
    assert style.color_of("ppo", variants) == style.COLORS["ppo"]
    assert style.color_of("new", variants) != style.color_of("other", variants)


@pytest.mark.parametrize("figure", sorted(p.stem for p in (ROOT / "paper_figures").glob("fig*.py")))
def test_a_figure_needs_neither_torch_nor_mujoco(figure):
    heavy = ("torch", "mujoco", "hydra")
    code = f"import sys; import paper_figures.{figure}; print([m for m in {heavy} if m in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert result.stdout.strip() == "[]"
