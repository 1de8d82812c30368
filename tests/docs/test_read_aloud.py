"""The tables at the top of the learners: what they name is where they say."""

import importlib
import inspect
import re

import pytest

from hippo.learners import LEARNERS
from tests import ROOT

FILE = re.compile(r"(?:\w+/)*\w+\.py")


def table(text):
    """(file, names) of every line of a docstring's table: what, where and who stand two spaces apart."""
    found, place = [], None
    for line in text.splitlines():
        if not line.startswith("    ") or (line.startswith("     ") and "  " not in line.strip()):
            continue
        cells = re.split(r"\s{2,}", line.strip().replace(".py ", ".py  "))
        where = [cell for cell in cells[1:] if FILE.fullmatch(cell) or cell.startswith("here")]
        place = where[0] if where else place
        if place and len(cells) > 1 and cells[-1] not in where:
            found.append((place, re.findall(r"\b[A-Za-z_]+\.[a-z_]+|\b[a-z]+_[a-z_]+|\b[A-Z]\w+", cells[-1])))
    return found


@pytest.mark.parametrize("algo", LEARNERS)
def test_what_a_learner_s_table_names_is_where_it_says(algo):
    name = LEARNERS[algo][0]
    learner = importlib.import_module(name)
    rows = table(learner.__doc__)
    assert len(rows) >= 4
    missing = []
    for place, names in rows:
        path = FILE.match(place)
        there = learner
        if path:
            file = path[0] if "/" in path[0] else f"baselines/{path[0]}"
            assert (ROOT / file).exists(), place
            there = importlib.import_module(file.removesuffix(".py").replace("/", "."))
        source = inspect.getsource(there)
        for each in names:
            if not all(re.search(rf"\b{part}\b", source) for part in each.split(".")):
                missing.append(f"{place}: {each}")
    assert not missing


def test_a_wrong_place_would_be_found():
    assert table("    a step    here    make_it, Thing.go\n") == [("here", ["make_it", "Thing.go"])]
