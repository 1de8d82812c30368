"""The report: one page, everything embedded, hostile names harmless; and Table 2's text."""

import json
import re

from analysis import report
from analysis.runs import Results
from paper_figures import table2, tabular


def test_hostile_names_are_escaped_and_nothing_is_loaded_from_elsewhere(tmp_path):
    hostile = "<script>alert(1)</script>"
    run = {"run_id": hostile, "env_label": hostile, "variant_label": "v", "seed": 0, "physics": "paper", "state": "x"}
    plan = {"figure": "fig3", "title": hostile, "claims": [hostile], "runs": [run]}
    (tmp_path / "plans/smoke").mkdir(parents=True)
    (tmp_path / "plans/smoke/fig3.json").write_text(json.dumps(plan))
    (tmp_path / "out/smoke").mkdir(parents=True)
    (tmp_path / "out/smoke/fig3.png").write_bytes(b"picture")
    (tmp_path / "out/smoke/fig3.caption.txt").write_text(hostile)
    assert report.main(["--runs-dir", str(tmp_path), "--out", str(tmp_path / "out")]) == 0
    page = (tmp_path / "out/smoke/report.html").read_text()
    assert "<script" not in page
    assert page.count("&lt;script&gt;") >= 5
    assert "data:image/png;base64,cGljdHVyZQ==" in page
    assert not re.search(r"""(src|href)=["']?(https?:)?//""", page)
    assert "default-src 'none'" in page
    targets = re.findall(r'href="#([^"]+)"', page)
    assert targets
    assert all(f'id="{target}"' in page for target in targets)
    assert "learning_rate" in page


def test_without_a_run_there_is_no_report(tmp_path, capsys):
    assert report.main(["--runs-dir", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert "make all SCALE=smoke" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_table_2_shows_every_definition_beside_the_papers_numbers():
    import pandas as pd

    values = {f"{c}_{k}": 0.9 for c in ("cosine_trajectory", "cosine_unweighted") for k in ("mean", "std")}
    values |= {"cosine_batch": 0.97, "cosine_authors": 0.5}
    for prefix, value in (("own", 0.4), ("other", 0.1)):
        for name in table2.PROBABILITIES:
            values |= {f"{prefix}_{name}_mean": value, f"{prefix}_{name}_std": 0.05}
    run = {"env": "ant_gather", "env_label": "Ant Gather", "variant": "v", "variant_label": "random_skills", "seed": 0}
    frame = pd.DataFrame(
        [
            {"env": "ant_gather", "variant": "v", "seed": 0, "run_id": "ab", "metric": m, "value": x}
            for m, x in values.items()
        ]
    )
    results = Results({"runs": [run], "title": "t"}, frame, [])
    table = table2.rows(results)
    assert len(table) == 4 + 4 * 5
    by = {(row["quantity"], row["definition"]): row for row in table}
    assert by["cosine", "whole batch, both weighted by A_k"]["ours"] == "0.970"
    own = by["own", "joint density"]
    assert (own["ours"], own["paper"]) == ("0.400 ± 0.050", "0.31 ± 0.09")
    assert by["max other^9", "joint density"]["ours"] == "1.0e-09"
    assert by["(max other / own)^10", "joint density"]["ours"] == "9.5e-07"  # 0.25 ** 10
    text = tabular.latex(table, "runs: ab")
    assert r"random\_skills" in text
    assert "% runs: ab" in text
    assert "±" not in text
    assert report.markdown_table(tabular.markdown(table))[1] == list(table[0].values())
