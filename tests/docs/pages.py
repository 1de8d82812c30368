"""Doing what a page of docs/ says: its files are written, its commands run."""

import importlib
import re
import runpy
import shlex

from tests import ROOT

BLOCK = re.compile(r"^```(\w+)(?: title=\"([^\"]+)\")?\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def blocks(page):
    """(language, title, text) of every block of docs/<page>."""
    return BLOCK.findall((ROOT / "docs" / page).read_text())


def follow(page, folder, monkeypatch, capsys):
    """Everything that was printed by doing docs/<page> in `folder`, in this process, which has torch already."""
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(str(folder))
    for kind, title, block in blocks(page):
        if kind != "sh":
            (folder / title).write_text(block)
            continue
        for line in block.splitlines():
            python, *rest = shlex.split(line)
            assert python == "python"
            if rest[0] == "-m":
                assert importlib.import_module(rest[1]).main(rest[2:]) == 0, line
            else:
                runpy.run_path(rest[0], run_name="__main__")
    return capsys.readouterr().out
