"""What a fresh clone draws of the committed rows: every picture that the README and the results page show."""

import re

import matplotlib.pyplot as plt
import numpy as np
import pytest

from analysis.edition import PAPER, Edition
from experiments import costs, sweep, train
from paper_figures import draw
from tests import ROOT

SHOWN = re.compile(r"pictures/(?:(modern)_)?([a-z]+)_((?:fig|table)\d+)\.png")


@pytest.mark.slow
def test_a_fresh_clone_draws_every_picture_that_is_shown_and_trains_and_measures_nothing(tmp_path, monkeypatch):
    for module, name in ((costs, "measure"), (train, "execute"), (sweep, "run_figure")):
        monkeypatch.setattr(module, name, lambda *arguments: pytest.fail("measured or trained something"))
    text = (ROOT / "README.md").read_text() + (ROOT / "docs/results.md").read_text()
    shown = {(Edition(scale, protocol or PAPER), figure) for protocol, scale, figure in SHOWN.findall(text)}
    for edition in {edition for edition, _ in shown} | {Edition("paper")}:  # which has tables
        places = [*edition.options.split(), "--runs-dir", str(tmp_path / "runs")]
        assert sweep.main(["write", "all", *places]) == 0
        assert draw.main(["all", *places, "--out", str(tmp_path / "out")]) == 0
    assert len(shown) >= 3
    for edition, figure in shown:
        drawn = plt.imread(tmp_path / "out" / edition.folder / f"{figure}.png")
        committed = plt.imread(ROOT / "docs/pictures" / "_".join([*edition.folder.parts, f"{figure}.png"]))
        assert drawn.shape == committed.shape, f"{edition} {figure}: run `make results`"
        # Processors round differently, which moves a line by less than a pixel; another line changes far more of them.
        assert np.abs(drawn - committed).mean() < 0.002, f"{edition} {figure}: run `make results`"
    assert list((tmp_path / "runs").iterdir()) == [tmp_path / "runs/plans"]
    table = (tmp_path / "out/paper/table2.md").read_text()
    assert "From 1,200 rows of 40 runs committed as results, nothing trained here." in table
