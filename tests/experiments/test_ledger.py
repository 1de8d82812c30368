"""The hyper-parameter ledger: complete, and the committed files are what the code says."""

import re

import pytest

from experiments.artefacts import ledger
from tests.hippo.test_training import LEARNERS, learner
from tests.hippo.toy import run


def test_every_setting_has_a_meaning_and_a_source():
    for row in ledger.rows():
        assert row["meaning"], row
        assert row["paper"] or row["authors_code"] or row["ours"], row


def test_the_committed_ledger_is_fresh():
    for name, content in (("hyperparameters.csv", ledger.as_csv()), ("hyperparameters.md", ledger.as_markdown())):
        assert (ledger.DOCS / name).read_text() == content, "run `python -m experiments.artefacts.ledger`"


def test_the_papers_appendix_a_is_in_it():
    values = {(row["algorithm"], row["setting"]): row["default"] for row in ledger.rows()}
    for algorithm in ("hippo", "ppo"):
        assert values[algorithm, "learning_rate"] == "0.003"
        assert values[algorithm, "clip_range"] == "0.1"
        assert values[algorithm, "updates"] == "10"
        assert values[algorithm, "gamma"] == "0.999"
    assert values["hippo", "num_skills"] == "6"
    assert (values["hippo", "period_min"], values["hippo", "period_max"]) == ("5", "15")
    assert values["ppo", "hidden_sizes"] == "[256, 64]"


@pytest.mark.parametrize("name", LEARNERS)
def test_every_column_that_a_learner_writes_is_explained(name, tmp_path):
    text = (ledger.DOCS / "metrics.md").read_text()
    train, config = learner(name, iterations=1, batch_size=200)
    run(train, config, tmp_path)
    for file in ("progress.csv", "timing.csv"):
        columns = (tmp_path / file).read_text().splitlines()[0].split(",")
        unexplained = [c for c in columns if f"`{re.sub('skill_[0-9]+_usage', 'skill_0_usage', c)}`" not in text]
        assert not unexplained
