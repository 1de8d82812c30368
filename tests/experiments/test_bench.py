"""The benchmark's logic: ratios of what took turns, targets, arguments and where the table goes. Nothing is timed."""

import itertools

import pytest

from experiments.bench import __main__ as bench
from experiments.bench import targets
from experiments.bench.flame import labelled
from experiments.bench.iterations import Iteration, parts
from experiments.bench.learning import Point, seconds_to, totals, walls_at
from experiments.bench.measure import Row, beside, contestants, median_ratio, median_reference, median_speed
from experiments.bench.targets import Target, closing, with_block


class Machine:
    """A machine whose speed is `speeds[k]` during the k-th measurement."""

    def __init__(self, *speeds):
        self.speeds = iter(speeds)

    def measure(self, true_speed):
        return lambda: true_speed * next(self.speeds)


def test_ratios_of_turns_do_not_see_a_machine_that_slows_down_and_ratios_of_blocks_do():
    # Bare stepping at 100, an iteration at 60: the ratio is 0.6. The machine loses 1/8 with every measurement.
    #   moment    0      1     2      3     4
    #   speed     1      7/8   6/8    5/8   4/8
    #   measured  100    52.5  75     37.5  50
    # In turns: 52.5 / mean(100, 75) = 37.5 / mean(75, 50) = 0.6.
    machine = Machine(1, 7 / 8, 6 / 8, 5 / 8, 4 / 8)
    pairs = beside(machine.measure(100), {"it": machine.measure(60)}, 2)["it"]
    assert pairs == [(52.5, 87.5), (37.5, 62.5)]
    assert median_ratio(pairs) == pytest.approx(0.6)
    assert median_speed(pairs) == pytest.approx(45)
    assert median_reference(pairs) == pytest.approx(75)
    # Bare stepping once before and both iterations after it: the mean of 52.5 and 45 over 100 is 0.49.
    machine = Machine(1, 7 / 8, 6 / 8)
    bare, first, second = machine.measure(100)(), machine.measure(60)(), machine.measure(60)()
    assert (first + second) / 2 / bare == pytest.approx(0.4875)


def test_one_disturbed_round_does_not_move_the_median():
    # Rounds at full speed give 60 / 100. In the second the machine drops to a third during the iteration: 20 / 100.
    machine = Machine(1, 1, 1, 1 / 3, 1, 1, 1)
    pairs = beside(machine.measure(100), {"it": machine.measure(60)}, 3)["it"]
    assert [speed for speed, _ in pairs] == pytest.approx([60, 20, 60])
    assert median_ratio(pairs) == pytest.approx(0.6)


def test_every_turn_has_the_reference_right_before_and_after_it():
    seen = []
    count = itertools.count(1)

    def reference():
        seen.append("ref")
        return float(next(count))

    results = beside(reference, {name: lambda name=name: seen.append(name) or name for name in "ab"}, 2)
    assert seen == ["ref", "a", "ref", "b", "ref", "a", "ref", "b", "ref"]
    assert results == {"a": [("a", 1.5), ("a", 3.5)], "b": [("b", 2.5), ("b", 4.5)]}


def count_up(start, report):
    for number in itertools.count(start):
        report(number)


def fail(report):
    report("warm")
    raise SystemExit(1)


def test_contestants_go_one_iteration_a_turn_and_the_first_is_not_counted():
    with contestants({"one": (count_up, 0), "ten": (count_up, 10)}) as turns:
        assert [turns["one"](), turns["ten"](), turns["ten"](), turns["one"]()] == [1, 11, 12, 2]


def test_a_contestant_that_dies_is_named():
    with contestants({"": (fail,)}) as turns, pytest.raises(RuntimeError, match=r"fail\(\) ended early"):
        turns[""]()


def test_the_parts_of_an_iteration_sum_to_all_of_it():
    # Collected from 1 to 6 s, of which 4 in the environments; 800 steps at a bare speed of 250 are 3.2 s of them.
    spans = {"collect": (1.0, 6.0), "improve": (6.5, 8.0), "fit": (8.25, 9.0)}
    shares = parts(Iteration(800, 10.0, 4.0, spans), bare=250.0)
    assert shares == pytest.approx(
        {
            "bare": 3.2,
            "environment": 0.8,
            "acting": 1.0,
            "advantages": 0.5,
            "gradients": 1.5,
            "fit": 0.75,
            "rest": 2.25,  # 2 before and after, 0.25 between gradients and fit
            "all": 10.0,
        }
    )
    assert sum(shares.values()) == pytest.approx(2 * shares["all"])


def test_a_target_is_met_at_its_bound_in_both_directions():
    assert Target("", ">=", 0.65).met(0.65)
    assert not Target("", ">=", 0.65).met(0.649)
    assert Target("", "<=", 1.1).met(1.1)
    assert not Target("", "<=", 1.1).met(1.101)


def test_the_closing_table_says_met_missed_and_not_measured(monkeypatch):
    aims = {
        "fast": Target("fast enough", ">=", 4),
        "slow": Target("too slow", ">=", 4),
        "small": Target("small enough", "<=", 1000),
        "large": Target("too large", "<=", 1000),
        "absent": Target("not looked at", "<=", 3),
    }
    monkeypatch.setattr(targets, "TARGETS", aims)
    _, *rows = closing({"fast": 4.5, "slow": 2.4, "small": 495, "large": 1030})
    assert [(row.split(">=")[0].split("<=")[0].strip(), row.split()[-1]) for row in rows] == [
        ("fast enough", "met"),
        ("too slow", "MISSED"),
        ("small enough", "met"),
        ("too large", "MISSED"),
        ("not looked at", "measured"),
    ]


def test_what_is_compared_with_a_target_is_the_ratio_where_there_is_one():
    assert Row("", "", 300.0, "steps/s", 0.7, "of bare").value == 0.7
    assert Row("", "", 300.0, "MB").value == 300.0


PAGE = "# Speed\n<!-- costs -->\nkept\n<!-- end -->\nbefore\n<!-- bench -->\nold\n<!-- end -->\nafter <!-- end -->\n"


def test_only_what_is_between_the_marks_is_replaced():
    expected = PAGE.replace("old\n", "A machine.\n\n```\na \\1 row\n```\n")
    assert with_block(PAGE, "A machine.", ["a \\1 row"]) == expected
    with pytest.raises(ValueError, match="has 0"):
        with_block("no marks", "", [])


def test_the_page_has_its_marks():
    with_block(targets.PAGE.read_text(), "", [])


@pytest.fixture
def short(monkeypatch, tmp_path):
    """Two parts that measure nothing, and a page of their own."""

    def rows(quick):
        yield "a line"
        yield Row("ant", "peak", 495.0, "MB", key="memory")

    def broken(quick):
        yield "a line"
        raise KeyboardInterrupt

    page = tmp_path / "performance.md"
    page.write_text(PAGE)
    monkeypatch.setattr(bench, "PARTS", {"memory": bench.Part(rows, 60, 6), "peers": bench.Part(rows, 60, 6)})
    monkeypatch.setattr(targets, "PAGE", page)
    return page, lambda: bench.PARTS.update(peers=bench.Part(broken, 60, 6))


def test_a_part_that_does_not_exist_is_refused_in_one_line_that_names_the_valid_ones(short, capsys):
    with pytest.raises(SystemExit) as stopped:
        bench.main(["--only", "memory", "speed"])
    assert stopped.value.code == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert len(err.splitlines()) == 1
    assert all(word in err for word in ("'speed'", "memory", "peers"))


def test_chosen_parts_are_shown_with_progress_and_nothing_is_written(short, capsys):
    page, _ = short
    assert bench.main(["--only", "memory"]) == 0
    out = capsys.readouterr().out
    assert "1 parts, about 1.0 minutes" in out
    assert "part 1 of 1: memory" in out
    assert "a line" in out
    assert out.splitlines()[-1].startswith("make fig3")  # the table of targets is last
    assert page.read_text() == PAGE


def test_write_puts_the_whole_table_between_the_marks(short, monkeypatch):
    page, _ = short
    monkeypatch.setattr(targets, "machine", lambda: "A machine.")
    assert bench.main(["--write"]) == 0
    text = page.read_text()
    head, tail = PAGE.split("old\n")
    assert text.startswith(head + "A machine.\n\n```\na line\n")
    assert text.endswith(tail)
    assert text.count("a line") == 2
    assert "495.00  met" in text
    assert "part 1" not in text


@pytest.mark.parametrize("with_it", ["--quick", "--only=memory"])
def test_a_part_of_the_table_is_never_written(short, capsys, with_it):
    with pytest.raises(SystemExit) as stopped:
        bench.main(["--write", with_it])
    assert stopped.value.code == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert short[0].read_text() == PAGE


def test_a_benchmark_that_is_stopped_writes_nothing(short, capsys):
    page, break_it = short
    break_it()
    assert bench.main(["--write"]) == 130
    assert capsys.readouterr().err.strip() == "stopped; nothing was written"
    assert page.read_text() == PAGE


def test_every_frame_of_the_flame_graph_that_has_room_gets_a_label():
    # 1180 px of 7.2 px a letter: 10 % hold 16 letters, 1 % one.
    frame = '<g><title>{} (7 samples, 0.51%)</title><rect x="0%" y="84" width="{}%" fg:w="7"/><text x="0"></text></g>'
    frames = frame.format("&lt;module&gt; (a.py:1)", 10) + frame.format("train", 1)
    svg = f'<svg onload="init(evt)"><script>init()</script>{frames}</svg>'
    drawn = labelled(svg)
    assert '<text x="0">&lt;module&gt; (a.py..</text>' in drawn
    assert '<text x="0"></text>' in drawn
    assert "<script" not in drawn
    assert "onload" not in drawn


def test_the_race_averages_over_a_window_and_takes_the_time_of_the_first_window_that_reaches_the_goal():
    curve = [Point(steps, steps / 1000, steps / 100_000) for steps in range(10_000, 410_000, 10_000)]
    assert walls_at(curve, 300_000) == pytest.approx(2.55)  # the ten from 2.1 to 3
    assert seconds_to(curve, 2.55) == 300
    assert seconds_to(curve, 99.0) == float("inf")
    table = {"PPO, ours": [6.0, 4.0], "PPO, Stable-Baselines3": [10.0, 10.0]}
    rows = list(totals("block_hopper", table))
    assert [row.ratio for row in rows if "SB3" in row.of] == [0.5, 1.0]
    assert [row.ratio for row in rows if "gait" in row.of] == [5 / 7.60, 10 / 7.60]


def test_the_race_is_run_only_where_it_is_named(short, monkeypatch, capsys):
    bench.PARTS["learning"] = bench.Part(lambda _: iter(["a race"]), 60, 6)
    assert bench.main([]) == 0
    assert "a race" not in capsys.readouterr().out
    assert bench.main(["--only", "learning"]) == 0
    assert "a race" in capsys.readouterr().out
