"""The hyper-parameter ledger: complete, and the committed files are what the code says."""

from experiments import ledger


def test_every_setting_has_a_meaning_and_a_source():
    for row in ledger.rows():
        assert row["meaning"], row
        assert row["paper"] or row["authors_code"] or row["ours"], row


def test_the_committed_ledger_is_fresh():
    for name, content in (("hyperparameters.csv", ledger.as_csv()), ("hyperparameters.md", ledger.as_markdown())):
        assert (ledger.DOCS / name).read_text() == content, "run `python -m experiments.ledger`"


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
