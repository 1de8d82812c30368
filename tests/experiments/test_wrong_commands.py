"""Wrong commands, generated from the parsers and the settings: exit code 2, at most three lines, nothing written."""

import dataclasses
import importlib
import shutil

import pytest

from hippo.learners import LEARNERS, config_class

COMMANDS = {
    "experiments.sweep": ["run", "fig3"],
    "paper_figures.fig3": [],
    "paper_figures.table1": [],
    "paper_figures.table3": [],
    "paper_figures.fig1": [],
    "paper_figures.fig2": [],
    "analysis.claims": [],
    "analysis.report": [],
}
BAD = {
    "--scale": ("nonsense", "../../x", "", "nan"),
    "--protocol": ("nonsense", "../x", "1"),
    "--no-such-option": ("1",),
    "--smooth": ("nan", "1", "-1", "x"),
    "--workers": ("0", "-1", "x", "1.5"),
    "--max-core-hours": ("nan", "-1", "inf", "x"),
    "--launcher": ("nonsense", ""),
    "--order": ("nonsense",),
    "--only": ("nonsense", "../x"),
    "--env": ("nonsense", ",", ""),
    "--set": ("nonsense", "x=1", "seed=1", "algo.gamma=2", "iterations=-1"),
    "--profile": ("nowhere.yaml", "/dev/null/x"),
}
ONLY_SWEEP = {"--workers", "--max-core-hours", "--launcher", "--order", "--only", "--env", "--set", "--profile"}


def wrong_commands():
    """(module, arguments) of each."""
    for module, start in COMMANDS.items():
        sweep = module == "experiments.sweep"
        for option, values in BAD.items():
            if (option in ONLY_SWEEP and not sweep) or (option == "--smooth" and module != "paper_figures.fig3"):
                continue
            more = ["--launcher", "slurm"] if option == "--profile" else []
            yield from ((module, [*start, *more, f"{option}={value}"]) for value in values)
    for algo in LEARNERS:
        for field in dataclasses.fields(config_class(algo)):
            if "low" in field.metadata and field.metadata["low"] is not None:
                yield "experiments.train", [f"algo={algo}", "scale=smoke", f"algo.{field.name}=-1"]
    for text in ("nonsense", "env=x", "algo.x=1", "seed=-1", "seed=nan", "iterations=0", "batch_size=1e30", "a b=1"):
        yield "experiments.train", [text]
    for name in ("evaluate", "video", "export", "mirror"):
        more = ["--to", "there"] if name == "export" else []
        yield from ((f"experiments.{name}", [folder, *more]) for folder in ("nowhere", "/dev/null"))
    yield from (("analysis.explain", [path]) for path in ("nowhere.pdf", "."))


def test_wrong_commands_end_with_code_2_in_at_most_three_lines_and_write_nothing(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    bad, tried = [], 0
    for module, arguments in wrong_commands():
        try:
            code = importlib.import_module(module).main(arguments)
        except SystemExit as end:
            code = end.code
        except BaseException as error:
            code = repr(error)
        tried += 1
        lines = capsys.readouterr().err.count("\n")
        left = [path.name for path in tmp_path.iterdir() if path.name != "cache"]
        if code != 2 or not 1 <= lines <= 3 or left:
            bad.append((module, arguments, code, lines, left))
            for name in left:
                shutil.rmtree(tmp_path / name)
    print(f"{tried} wrong commands")
    assert not bad
    assert tried >= 108


pytestmark = pytest.mark.slow
