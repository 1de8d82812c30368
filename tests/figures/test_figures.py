"""Figures: drawn from a plan and run folders, the same bytes every time, honest about what is missing."""

import json
import subprocess
import sys

import matplotlib.pyplot as plt
import pytest
from matplotlib.lines import Line2D
from matplotlib.text import Text

from analysis.runs import load
from paper_figures import curves, fig4, style
from paper_figures import draw as draw_all
from tests import ROOT
from tests.analysis.test_analysis import planned


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


def test_a_method_without_data_is_neither_counted_nor_in_the_legend(tmp_path, monkeypatch):
    two_methods(tmp_path, [3, 3, 0, 0])
    words = drawn_words(monkeypatch, tmp_path)
    assert words[words.index("seeds:") + 1] == "2"
    assert "0" not in words[words.index("seeds:") :][:3]
    assert "hippo_random" in words
    assert "ppo" not in words


def two_places(tmp_path, lengths, **changes):
    """A plan of one method in Block Hopper and in Ant Gather, one seed each; `lengths` counts their rows."""
    planned(tmp_path, lengths)
    path = tmp_path / "plans/smoke/fig3.json"
    plan = json.loads(path.read_text())
    plan["runs"][1] |= {"env": "ant_gather", "env_label": "Ant Gather", "seed": 0}
    path.write_text(json.dumps(plan | changes))


def saved(monkeypatch):
    """The figures that are written from here on, each with its paths."""
    figures, save = [], style.save

    def spy(figure, paths, *rest):
        figures.append((figure, [path.name for path in paths]))
        return save(figure, paths, *rest)

    monkeypatch.setattr(style, "save", spy)
    return figures


def test_a_panel_without_data_is_left_out_and_one_line_under_the_picture_says_why(tmp_path, monkeypatch):
    two_places(tmp_path, [3, None], not_trained=[{"env": "snake_gather", "env_label": "Snake Gather"}])
    figures, old = saved(monkeypatch), tmp_path / "out/smoke/fig3.narrow.png"
    old.parent.mkdir(parents=True)
    old.touch()
    assert draw(tmp_path) == 0
    ((figure, _),) = figures
    assert not old.exists()  # one panel needs no second picture, and that of other data would be wrong
    assert [axes.get_title() for axes in figure.axes] == ["Block Hopper"]
    said = "Not shown: Ant Gather (no results yet); Snake Gather (not trained at this scale)."
    assert figure.get_supxlabel() == said
    assert said in (tmp_path / "out/smoke/fig3.caption.txt").read_text().splitlines()


def test_panels_are_wider_when_fewer_are_drawn_and_stack_on_a_phone(tmp_path, monkeypatch):
    two_places(tmp_path, [3, 3])
    figures = saved(monkeypatch)
    assert draw(tmp_path) == 0
    (wide, paths), (narrow, narrow_paths) = figures
    assert (paths[-1], narrow_paths) == ("fig3.png", ["fig3.narrow.png"])
    left, right = (axes.get_position() for axes in wide.axes)
    assert left.width > 0.4  # of the page; four panels have less than a quarter each
    assert left.y0 == right.y0
    above, below = (axes.get_position() for axes in narrow.axes)
    assert above.y0 > below.y1
    assert above.x0 == pytest.approx(below.x0, abs=0.02)
    assert narrow.get_figwidth() == style.NARROW


@pytest.mark.parametrize(
    ("iterations", "share", "points"), [(12, 0.05, 1), (120, 0.05, 7), (100, 0.05, 5), (2000, 0.05, 101), (120, 0, 1)]
)
def test_the_moving_mean_takes_its_share_of_the_iterations_to_the_next_odd_number(iterations, share, points):
    assert curves.window_of(iterations, share) == points


def test_curves_are_smoothed_as_the_caption_says_and_not_at_all_if_asked(tmp_path):
    planned(tmp_path, [5, 5], iterations=5)
    for seed, values in enumerate(([0, 3, 0, 6, 0], [0, 0, 0, 0, 0])):
        rows = "".join(f"{i},{10 * i + 10},{value}\n" for i, value in enumerate(values))
        (tmp_path / f"{seed:012x}/progress.csv").write_text("iteration,env_steps,return_mean\n" + rows)
    results = load("fig3", "smoke", tmp_path, tmp_path)
    # Half of five iterations is three points; the first and the last have two.
    steps, values = curves.bundle(results, "block_hopper", "ppo", 0.5)
    assert steps.tolist() == [10, 20, 30, 40, 50]
    assert values.tolist() == [[1.5, 1, 3, 2, 3], [0] * 5]
    assert curves.bundle(results, "block_hopper", "ppo", 0)[1].tolist() == [[0, 3, 0, 6, 0], [0] * 5]
    assert "moving mean over 50% of its iterations (3 of 5;" in curves.caption(results, 0.5, None)
    assert "; not smoothed." in curves.caption(results, 0, None)
    assert results.frame["value"].tolist() == [0, 3, 0, 6, 0] + [0] * 5  # what is written as numbers is not smoothed


def test_a_share_that_is_none_is_refused(tmp_path, capsys):
    for wrong in ("1", "-0.1", "nan"):
        with pytest.raises(SystemExit) as end:
            curves.main("fig3", ["--smooth", wrong, "--out", str(tmp_path / "out")])
        assert end.value.code == 2
        assert f"{wrong} is no share" in capsys.readouterr().err


def test_the_caption_says_what_is_committed_and_what_was_trained_here(tmp_path):
    planned(tmp_path, [3, 3], states=("committed", "finished"))
    (tmp_path / "data/smoke").mkdir(parents=True)
    head = "figure,scale,env,variant,seed,run_id,env_steps,metric,value"
    rows = [f"fig3,smoke,block_hopper,ppo,0,{0:012x},{step},return_mean,1" for step in (10, 20, 30)]
    (tmp_path / "data/smoke/fig3.csv").write_text("\n".join([head, *rows]) + "\n")
    assert draw(tmp_path) == 0
    caption = (tmp_path / "out/smoke/fig3.caption.txt").read_text()
    assert "Drawn from 3 rows of 1 runs committed as results, 3 rows of 1 runs trained here." in caption
    (tmp_path / "other").mkdir()
    planned(tmp_path / "other", [3, 3])
    assert draw(tmp_path / "other") == 0
    caption = (tmp_path / "other/out/smoke/fig3.caption.txt").read_text()
    assert "Drawn from nothing committed as results, 6 rows of 2 runs trained here." in caption


def test_a_panel_of_variances_that_were_not_measured_is_left_out_and_said(tmp_path):
    planned(tmp_path, [3, 3])
    results = load("fig3", "smoke", tmp_path, tmp_path)
    assert curves.left_out(results, fig4.EXTRA) == "Block Hopper (relative gradient variance: not measured)"
    figure = curves.picture(results, 0.05, fig4.EXTRA, 1, style.NARROW)
    assert len(figure.axes) == 1
    plt.close(figure)


def test_everything_is_drawn_in_one_go_and_what_has_no_results_is_named_and_no_error(tmp_path, monkeypatch, capsys):
    planned(tmp_path, [3, 3])
    monkeypatch.setattr(draw_all, "ARTEFACTS", ["fig3", "fig5", "table3"])
    places = ["--runs-dir", str(tmp_path), "--data", str(tmp_path / "data"), "--out", str(tmp_path / "out")]
    assert draw_all.main(["all", *places]) == 0
    assert "not drawn: fig5: no plan at scale smoke" in capsys.readouterr().err
    assert {"fig3.png", "table3.md"} <= {path.name for path in (tmp_path / "out/smoke").iterdir()}
    assert draw_all.main(["fig5", *places]) == 3
    (tmp_path / "plans/smoke/fig3.json").write_text("{")
    assert draw_all.main(["all", *places]) == 2  # what is damaged is an error
    assert draw_all.main(["fig33", *places]) == 2
    assert "error: draw=fig33: valid: all, fig3" in capsys.readouterr().err


def test_a_figure_that_can_never_exist_at_a_scale_names_those_that_have_it_and_is_no_error(tmp_path, capsys):
    planned(tmp_path, [3, 3])
    path = tmp_path / "plans/smoke/fig3.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"runs": [], "scales": ["laptop", "paper"]}))
    assert draw(tmp_path) == 0
    said = capsys.readouterr()
    assert said.out == "fig3: not trained at scale smoke, only at laptop, paper\n"
    assert said.err == ""
    assert not (tmp_path / "out").exists()


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
    curves.draw_panel(axes, results, "block_hopper", 1.0, curves.command_line.SMOOTH)
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
    assert draw(tmp_path) == 3
    assert capsys.readouterr().err.startswith("not drawn: fig3: no plan at scale smoke")
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


def test_what_draws_needs_neither_torch_nor_mujoco():
    modules = sorted(
        path.stem for path in (ROOT / "paper_figures").glob("*.py") if path.stem not in ("fig2", "__init__")
    )
    assert {"fig3", "table1", "draw", "compare"} <= set(modules)
    code = f"""
import importlib, sys
for name in {modules}:
    importlib.import_module("paper_figures." + name)
    print(*[name + " needs " + heavy for heavy in ("torch", "mujoco", "hydra") if heavy in sys.modules])
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert result.stdout.strip() == ""
