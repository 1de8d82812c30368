"""Figures: drawn from a plan and run folders, the same bytes every time, honest about what is missing."""

import json
import subprocess
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import pytest
from matplotlib.lines import Line2D
from matplotlib.text import Text

from analysis.runs import load
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
    assert {p.name for p in folder.iterdir()} == {"fig3.csv", "fig3.pdf", "fig3.svg", "fig3.png", "fig3.caption.txt"}
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


@pytest.mark.parametrize(("iterations", "lines"), [(3, 0), (6, 1)])
def test_the_last_value_of_a_method_with_a_smaller_budget_is_held_dashed_and_said(
    iterations, lines, tmp_path, monkeypatch
):
    planned(tmp_path, [3, iterations])
    path = tmp_path / "plans/smoke/fig3.json"
    plan = json.loads(path.read_text())
    plan["runs"][1] |= {"variant": "hiro", "variant_label": "HIRO", "iterations": iterations, "state": "finished"}
    path.write_text(json.dumps(plan))
    dashed, save = [], style.save

    def spy(figure, *rest):
        dashed.extend(line for line in figure.axes[0].lines if line.get_linestyle() == "--")
        return save(figure, *rest)

    monkeypatch.setattr(style, "save", spy)
    assert draw(tmp_path) == 0
    assert [line.get_xydata().tolist() for line in dashed] == [[[0.03, 0.2], [0.06, 0.2]]] * lines
    assert ("Dashed:" in (tmp_path / "out/smoke/fig3.caption.txt").read_text()) == bool(lines)


def test_a_run_that_never_started_is_named_and_the_rest_is_drawn(tmp_path):
    planned(tmp_path, [3, None])
    assert draw(tmp_path) == 0
    assert "n = 1 seeds" in (tmp_path / "out/smoke/fig3.caption.txt").read_text()


def drawn_words(monkeypatch, tmp_path):
    """Every word of the figure, in drawing order."""
    words, save = [], style.save

    def spy(figure, *rest):
        paths = save(figure, *rest)
        words.extend(text.get_text() for text in figure.findobj(Text))
        return paths

    monkeypatch.setattr(style, "save", spy)
    assert draw(tmp_path) == 0
    return words


def two_methods(tmp_path, lengths):
    """A plan of two methods with two seeds each; `lengths` counts the rows of their four progress.csv."""
    planned(tmp_path, [3, 3])
    path = tmp_path / "plans/smoke/fig3.json"
    plan = json.loads(path.read_text())
    runs = [
        run | {"variant": variant, "variant_label": variant, "run_id": f"{variant}{run['seed']}"}
        for variant in ("hippo_random", "ppo")
        for run in plan["runs"]
    ]
    path.write_text(json.dumps(plan | {"runs": runs}))
    for run, length in zip(runs, lengths, strict=True):
        (tmp_path / run["run_id"]).mkdir()
        rows = "".join(f"{i},{10 * i + 10 + run['seed']},{i}\n" for i in range(length))
        (tmp_path / run["run_id"] / "progress.csv").write_text("iteration,env_steps,return_mean\n" + rows)


def test_methods_with_different_numbers_of_seeds_each_print_their_own(tmp_path, monkeypatch):
    two_methods(tmp_path, [3, 3, 3, 0])
    words = drawn_words(monkeypatch, tmp_path)
    at = words.index("seeds:")
    assert words[at + 1 : at + 3] == ["2", "1"]
    assert "n = 1 to 2 seeds" in (tmp_path / "out/smoke/fig3.caption.txt").read_text()


def test_a_method_of_the_legend_that_has_no_run_in_a_panel_counts_none_there(tmp_path, monkeypatch):
    two_methods(tmp_path, [3, 3, 0, 0])
    words = drawn_words(monkeypatch, tmp_path)
    at = words.index("seeds:")
    assert words[at + 1 : at + 3] == ["2", "0"]


@pytest.mark.parametrize(
    ("labels", "shape"),
    [
        (["random p, skill-conditioned"] * 4, (2, 2)),
        (["manager only p = 10, fixed skills"] * 8, (3, 3)),
        (["HiPPO p = 10"] * 6, (2, 3)),
        (["PPO with action repeat 10"] * 4, (2, 2)),
    ],
)
def test_a_legend_is_even_and_fits_the_page(labels, shape):
    assert curves.legend_shape(labels, style.WIDTH) == shape
    style.use()
    figure = plt.figure(figsize=(style.WIDTH, 2))
    handles = [Line2D([], [], label=label) for label in labels]
    legend = figure.legend(handles=handles, ncols=shape[1], columnspacing=1.2)
    figure.draw_without_rendering()
    assert legend.get_window_extent().width <= figure.bbox.width
    plt.close(figure)


def test_seeds_that_report_at_different_steps_still_have_a_mean(tmp_path):
    two_methods(tmp_path, [3, 3, 3, 3])  # seed 0 at 10, 20, 30; seed 1 at 11, 21, 31
    results = load("fig3", "smoke", tmp_path, tmp_path)
    _, axes = plt.subplots()
    curves.draw_panel(axes, results, "block_hopper", 1.0)
    thick = [line for line in axes.lines if line.get_color() == style.COLORS["ppo"]][-1]
    # Both have a value from 11 to 30: at 11, seed 0 is at (11 - 10) / 10 = 0.1 and seed 1 at 0.
    assert thick.get_xdata().tolist() == [11, 20, 21, 30]
    assert thick.get_ydata().tolist() == pytest.approx([0.05, 0.95, 1.05, 1.95])
    plt.close("all")


def test_methods_that_are_all_the_same_are_said_to_be(tmp_path, monkeypatch):
    planned(tmp_path, [3, 3])
    for seed in (0, 1):
        (tmp_path / f"{seed:012x}/progress.csv").write_text("iteration,env_steps,return_mean\n0,10,0\n1,20,0\n2,30,0\n")
    assert "every run: 0 throughout" in drawn_words(monkeypatch, tmp_path)


def test_a_figure_drawn_twice_is_the_same_file(tmp_path):
    planned(tmp_path, [3, 3])
    draw(tmp_path, "a")
    draw(tmp_path, "b")
    for name in ("fig3.csv", "fig3.pdf", "fig3.svg", "fig3.png", "fig3.caption.txt"):
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


@pytest.mark.parametrize("figure", sorted(p.stem for p in (ROOT / "paper_figures").glob("fig*.py") if p.stem != "fig2"))
def test_a_figure_needs_neither_torch_nor_mujoco(figure):
    heavy = ("torch", "mujoco", "hydra")
    code = f"import sys; import paper_figures.{figure}; print([m for m in {heavy} if m in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert result.stdout.strip() == "[]"
