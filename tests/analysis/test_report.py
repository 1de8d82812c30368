"""The report without a browser: what it says of runs, costs and gaps, its Markdown version, errors; Table 2's text."""

import re
from html import unescape
from html.parser import HTMLParser

import pandas as pd
import pytest
from markdown_it import MarkdownIt

from analysis import report
from analysis.edition import Edition
from analysis.report_data import Table, folders, gather, markdown_table, natural
from analysis.runs import Results
from paper_figures import table2, tabular
from tests.report import artefacts
from tests.report.artefacts import ATTACK, BREAKOUT, RUNS


def arguments(root):
    return ["--runs-dir", str(root / "runs"), "--out", str(root / "out")]


def pages(root):
    """report.html and report.md of what lies in `root`."""
    assert report.main(arguments(root)) == 0
    return tuple((root / "out/smoke" / name).read_text() for name in ("report.html", "report.md"))


def facts(root):
    """The report's data."""
    return gather(Edition("smoke"), root / "runs", root / "data", root / "out")


def rendered(markdown):
    """The Markdown version as a forge shows it, HTML within it let through."""
    return MarkdownIt("commonmark", {"html": True}).enable("table").render(markdown)


def attributes(page):
    """Names of all attributes of all elements."""
    found = []
    parser = HTMLParser()
    parser.handle_starttag = lambda tag, attrs: found.extend(name for name, _ in attrs)
    parser.feed(page)
    return found


def test_hostile_names_are_escaped_and_nothing_is_loaded_from_elsewhere(tmp_path):
    report.main(artefacts.hostile(tmp_path))
    page = (tmp_path / "out/smoke/report.html").read_text()
    assert "<script" not in page
    assert "<img src=x" not in page
    assert page.count("&lt;script&gt;") >= 5
    assert not re.search(r"""(src|href)=["'](?!data:|#)""", page)
    assert "url(" not in page
    policy = unescape(re.search(r'Security-Policy" content="([^"]*)"', page)[1])
    assert policy.startswith("default-src 'none'; style-src 'sha256-")
    assert "unsafe" not in policy
    assert "script-src" not in policy  # so that default-src holds for scripts
    targets = re.findall(r'href="#([^"]+)"', page)
    assert len(targets) >= 8
    assert all(page.count(f'id="{target}"') == 1 for target in targets)
    assert "learning_rate" in page


def test_hostile_names_are_text_in_the_markdown_version_too(tmp_path):
    report.main(artefacts.hostile(tmp_path))
    shown = rendered((tmp_path / "out/smoke/report.md").read_text())
    assert "<script" not in shown
    assert "onerror" in shown  # as text
    assert set(attributes(shown)) <= {"src", "alt", "href", "style"}  # the last from the columns' alignment
    assert "<code>d</code>" not in shown
    assert set(re.findall(r'<(?:a|img) (?:href|src)="([^"]*)"', shown)) == {
        "fig1.png", "fig3.png", "gallery.png", "table1.md"
    }  # fmt: skip
    assert "a|b](https://example.org/x) **c** `d` www.example.org" in re.sub(r"\s+", " ", shown)
    assert "onerror" in attributes(rendered(f"| a |\n|---|\n| {ATTACK} |\n"))  # what no escaping would have shown


@pytest.mark.parametrize(
    "text", [ATTACK, "# no heading", "1. no list", "- no list", "a|b", "\\", "**a**", "=", "--", "&lt;"]
)
def test_markdown_shows_a_text_letter_by_letter(text):
    escaped = report.markdown_text(text)
    for shown in (rendered(escaped), rendered(f"- {escaped}"), rendered(f"| x |\n|---|\n| {escaped} |")):
        inner = re.sub(r"</?(p|ul|li|table|thead|tbody|tr|th|td)>", "", shown).replace("x\n", "").strip()
        expected = text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
        assert inner == expected


def test_a_row_of_a_markdown_table_keeps_its_cells_and_its_bold(tmp_path):
    artefacts.table(tmp_path, "table1", [r"a\|b | **1.5 ± 0.2 (-3 %)** ="])
    _, page = pages(tmp_path)
    assert r"| a\|b | **1.5 ± 0.2 (-3 %)** = |" in page
    cells = re.findall(r"<td[^>]*>(.*?)</td>", rendered(page))
    assert cells[:2] == ["a|b", "<strong>1.5 ± 0.2 (-3 %)</strong> ="]


def test_a_table_is_read_back_as_it_was_written():
    table = [{"name": "a|b", "value": "**1**"}, {"name": "", "value": "x"}]
    read = markdown_table(tabular.markdown(table))
    assert read == Table(["name", "value"], [["a|b", "**1**"], ["", "x"]])
    assert read.numeric() == [False, False]
    assert Table(["n", "id"], [["1.5 ± 0.2", "12ab"], ["**-3e-4**", "7"], ["", "8"]]).numeric() == [True, False]


def test_runs_are_listed_once_with_where_they_come_from_and_what_they_cost(tmp_path):
    artefacts.plan(tmp_path, "fig3", [artefacts.planned(RUNS[0], 0), artefacts.planned(RUNS[1], 1, "missing")])
    artefacts.plan(tmp_path, "fig4", [artefacts.planned(RUNS[0], 0), artefacts.planned(RUNS[2], 2, "committed")])
    artefacts.folder(tmp_path, RUNS[0], git_difference="e" * 64)
    artefacts.picture(tmp_path / "out/smoke/fig3.png", "fig3: A title", RUNS[:1])
    found = facts(tmp_path)
    assert [run.run_id for run in found.runs] == list(RUNS)
    trained = found.runs[0]
    assert (trained.algo, trained.commit, trained.dirty, trained.lock) == ("hippo", "c" * 40, True, "d" * 64)
    assert trained.used_in == ["fig3", "fig4"]
    assert found.seconds == trained.seconds == 1.25 + 2.25
    assert found.states == {"finished": 1, "missing": 1, "committed": 1}
    assert found.origin.rows == [["fig3", "2", "0", "1", "1"], ["fig4", "2", "1", "1", "0"]]
    html, markdown = pages(tmp_path)
    row = f"| {RUNS[0]} | hippo | HiPPO random p | 0 | finished | {'c' * 10} + changes | {'d' * 10} | 4 | paper |"
    assert f"{row} fig3, fig4 |" in markdown
    assert "4 core-s" in html
    assert "1 of 3 runs timed" in html
    assert "a-secret-host" not in html + markdown  # whose machine it was is nobody's business


def test_a_run_is_as_its_own_folder_says_not_as_it_was_planned(tmp_path):
    artefacts.plan(tmp_path, "fig3", [artefacts.planned(RUNS[0], 0, "missing"), artefacts.planned(RUNS[1], 1)])
    artefacts.folder(tmp_path, RUNS[0], state="finished")
    artefacts.folder(tmp_path, RUNS[1], state="diverged")
    artefacts.picture(tmp_path / "out/smoke/fig3.png", "fig3: A title", RUNS[:1])
    (found,) = facts(tmp_path).artefacts
    assert found.absent == ["Ant Gather, HiPPO random p, seed 1: diverged"]
    assert (found.behind, found.planned) == ({RUNS[0]}, set(RUNS[:2]))
    html, markdown = pages(tmp_path)
    for page in (html, markdown):
        assert "Ant Gather, HiPPO random p, seed 1: diverged" in page
        assert "Drawn from 1 run: 1 of the 2 that are planned." in page


def test_a_second_torn_by_a_kill_is_not_counted(tmp_path):
    artefacts.plan(tmp_path, "fig3", [artefacts.planned(RUNS[0], 0)])
    with (artefacts.folder(tmp_path, RUNS[0]) / "timing.csv").open("a") as file:
        file.write("2,99")
    assert facts(tmp_path).seconds == 3.5


def test_an_ancestor_is_listed_and_its_cost_counted(tmp_path):
    artefacts.plan(tmp_path, "fig6", [artefacts.planned(RUNS[0], 0) | {"ancestors": [RUNS[1]]}])
    for run_id in RUNS[:2]:
        artefacts.folder(tmp_path, run_id)
    found = facts(tmp_path)
    assert found.seconds == 7.0
    assert found.runs[0].run_id == RUNS[1]
    assert (found.runs[0].env, found.runs[0].used_in, found.runs[0].state) == ("ant_gather", ["fig6"], "finished")
    artefacts.plan(tmp_path, "fig6", [artefacts.planned(RUNS[0], 0) | {"ancestors": [RUNS[2]]}])
    assert facts(tmp_path).states == {"not trained here": 1, "finished": 1}  # not "missing": skills may be committed


def test_an_id_with_a_path_in_it_reads_no_folder_elsewhere(tmp_path):
    artefacts.folder(tmp_path, RUNS[0])
    artefacts.plan(tmp_path, "fig3", [artefacts.planned(f"../runs/{RUNS[0]}", 0, "missing")])
    (run,) = facts(tmp_path).runs
    assert (run.state, run.seconds, run.commit) == ("missing", None, "")


def test_what_is_missing_is_named(tmp_path, capsys):
    artefacts.plan(tmp_path, "fig8", [], scales=("laptop", "paper"))
    artefacts.plan(tmp_path, "fig4", [artefacts.planned(RUNS[0], 0, "missing")])
    artefacts.plan(tmp_path, "fig5", [artefacts.planned(RUNS[1], 0, "committed")])
    artefacts.picture(tmp_path / "out/smoke/fig10.png", "fig10: later")
    artefacts.picture(tmp_path / "out/smoke/fig3.png", "fig3: A title")
    html, markdown = pages(tmp_path)
    said = capsys.readouterr().out
    assert "missing: fig1: not drawn; make draw-fig1 SCALE=smoke\n" in said
    assert "missing: fig4: nothing to draw yet; make fig4 SCALE=smoke trains it\n" in said
    assert "missing: fig5: not drawn; make draw-fig5 SCALE=smoke\n" in said
    assert "fig3: not drawn" not in said
    nowhere = "fig8: not trained at scale smoke; make fig8 SCALE=laptop or make fig8 SCALE=paper"
    assert f"missing: {nowhere}\n" in said
    assert nowhere in html
    assert f"- {nowhere}" in markdown
    assert [a.name for a in facts(tmp_path).artefacts] == ["fig3", "fig10"]
    assert sorted(["table1", "fig10", "gallery", "fig2"], key=natural) == ["fig2", "fig10", "table1", "gallery"]


def test_where_nothing_was_trained_the_page_says_so_instead_of_a_cost_of_nothing(tmp_path):
    artefacts.plan(tmp_path, "fig3", [artefacts.planned(RUNS[0], 0, "committed")])
    artefacts.picture(tmp_path / "out/smoke/fig3.png", "fig3: A title", RUNS[:1])
    for page in pages(tmp_path):
        assert "nothing was trained here" in page
        assert "runs timed" not in page
    artefacts.folder(tmp_path, RUNS[0])
    for page in pages(tmp_path):
        assert "nothing was trained here" not in page
        assert "1 of 1 runs timed" in page


def test_a_phone_gets_the_picture_whose_panels_stack(tmp_path):
    artefacts.picture(tmp_path / "out/smoke/fig3.png", "fig3: A title", RUNS)
    artefacts.picture(tmp_path / "out/smoke/fig3.narrow.png", "fig3: A title", RUNS, (400, 900))
    artefacts.picture(tmp_path / "out/smoke/fig1.png", "fig1: A diagram")
    html, _ = pages(tmp_path)
    assert [a.name for a in facts(tmp_path).artefacts] == ["fig1", "fig3"]
    ((size, _),) = re.findall(r'<source media="\(max-width: 34rem\)".*? (width="\d+" height="\d+")>(\s*)<img', html)
    assert size == 'width="400" height="900"'


def test_methods_that_are_missing_alike_share_a_line(tmp_path):
    runs = [
        artefacts.planned(f"{i:012x}", seed, "missing", label)
        for i, (label, seed) in enumerate((label, seed) for label in ("A", "B", "C") for seed in (0, 1))
    ]
    artefacts.picture(tmp_path / "out/smoke/fig3.png", "fig3: A title")
    artefacts.plan(tmp_path, "fig3", runs)
    assert facts(tmp_path).artefacts[0].absent == ["Ant Gather, every method, seed 0, 1: missing"]
    runs[0]["state"] = runs[1]["state"] = "committed"
    artefacts.plan(tmp_path, "fig3", runs)
    assert facts(tmp_path).artefacts[0].absent == ["Ant Gather, B; C, seed 0, 1: missing"]


def test_an_artefact_of_other_runs_says_so(tmp_path):
    artefacts.picture(tmp_path / "out/smoke/fig3.png", "fig3: A title", RUNS)
    artefacts.picture(tmp_path / "out/smoke/fig1.png", "fig1: A diagram")
    html, _ = pages(tmp_path)
    other = "and 3 that the list of runs on this page lacks."
    assert f"Drawn from 3 runs: 0 of the 0 that are planned, {other}" in html
    artefacts.plan(tmp_path, "fig3", [artefacts.planned(run, 0) for run in ("1" * 12, "2" * 12, "3" * 12)])
    assert f"Drawn from 3 runs: 0 of the 3 that are planned, {other}" in pages(tmp_path)[0]  # as many, but not these
    assert "No run stands behind it." in html


def test_each_verdict_has_its_own_look_and_smoke_has_none(tmp_path):
    artefacts.picture(tmp_path / "out/smoke/fig3.png", "fig3: A title")
    artefacts.claims(tmp_path, ("reproduced", "not reproduced", "inconclusive", "no data"))
    html, _ = pages(tmp_path)
    looks = dict(re.findall(r'<span class="badge (\w*)">([^<]*)</span>', html))
    assert looks == {
        "good": "reproduced", "bad": "not reproduced", "open": "inconclusive", "": "no data"
    }  # fmt: skip
    artefacts.claims(tmp_path, ("smoke: no verdicts",) * 3)
    html, _ = pages(tmp_path)
    assert re.findall(r'class="badge (\w*)">', html) == [""]
    assert "3 smoke: no verdicts" in html


def test_same_artefacts_same_bytes(tmp_path):
    for place in ("one", "two"):
        report.main(artefacts.hostile(tmp_path / place))
    for name in ("report.html", "report.md"):
        first, second = ((tmp_path / place / "out/smoke" / name).read_bytes() for place in ("one", "two"))
        assert first == second
        assert str(tmp_path).encode() not in first
    before = (tmp_path / "one/out/smoke/report.html").read_bytes()
    report.main(arguments(tmp_path / "one"))  # its own earlier output is no artefact
    assert (tmp_path / "one/out/smoke/report.html").read_bytes() == before


def test_with_nothing_to_report_there_is_one_line_and_exit_code_2(tmp_path, capsys):
    assert report.main(arguments(tmp_path)) == 2
    said = capsys.readouterr()
    assert said.err.count("\n") == 1
    assert "scale smoke: nothing" in said.err
    assert "make draw-all SCALE=smoke" in said.err
    assert said.out == ""
    assert not (tmp_path / "out").exists()
    artefacts.claims(tmp_path)  # claims alone, without a run or a picture, are no report
    assert report.main(arguments(tmp_path)) == 2
    artefacts.picture(tmp_path / "out/smoke/fig1.png", "fig1: x")
    assert report.main([*arguments(tmp_path), "--scale", "paper"]) == 2
    assert "(there is something in: smoke)" in capsys.readouterr().err
    (tmp_path / "out/laptop").mkdir()
    assert folders(tmp_path / "runs", tmp_path / "out") == ["smoke"]
    artefacts.plan(tmp_path, "fig3", [])
    (tmp_path / "runs/plans/smoke").rename(tmp_path / "runs/plans/paper")
    assert folders(tmp_path / "runs", tmp_path / "out") == ["paper", "smoke"]


@pytest.mark.parametrize(
    ("where", "content", "message"),
    [
        ("runs/plans/smoke/fig3.json", "{", "is no JSON"),
        ("runs/plans/smoke/fig3.json", "[]", "must hold a JSON object"),
        ("runs/plans/smoke/fig3.json", "{}", "lacks figure, runs, scale, title"),
        ("runs/plans/smoke/fig3.json", '{"figure": "", "runs": [], "title": "", "scale": "paper"}', "of scale paper"),
        ("out/smoke/fig1.png", "no picture", "is no picture"),
        ("out/smoke/table1.md", "| a | b |\n|---|---|\n| 1 |\n", "a row of another length"),
    ],
)
def test_a_damaged_file_is_named_in_one_line_and_nothing_is_written(tmp_path, capsys, where, content, message):
    path = tmp_path / where
    path.parent.mkdir(parents=True)
    path.write_text(content)
    assert report.main(arguments(tmp_path)) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert str(path) in said
    assert message in said
    assert not list(tmp_path.rglob("report.*"))


def test_a_breakout_in_a_title_stays_in_the_alternative_text(tmp_path):
    artefacts.picture(tmp_path / "out/smoke/fig1.png", f"fig1: {BREAKOUT}")
    html, _ = pages(tmp_path)
    assert 'alt="&#34;&gt;&lt;script&gt;alert(2)&lt;/script&gt;' in html


def test_table_2_shows_every_definition_beside_the_papers_numbers():
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
    assert len(table) == 4 + 4 * 5 + 1
    by = {(row["quantity"], row["definition"]): row for row in table}
    assert by["cosine", "whole batch, both weighted by A_k"]["ours"] == "0.970"
    own = by["own", "joint density"]
    assert (own["ours"], own["paper"]) == ("0.400 ± 0.050", "0.31 ± 0.09")
    assert by["mean other", "posterior over skills, uniform manager"]["ours"] == "0.120"  # five share 0.6
    assert by["max other^9", "joint density"]["ours"] == "1.0e-09"
    assert by["(max other / own)^10", "joint density"]["ours"] == "9.5e-07"  # 0.25 ** 10
    text = tabular.latex(table, "runs: ab")
    assert r"random\_skills" in text
    assert "% runs: ab" in text
    assert "±" not in text
    assert markdown_table(tabular.markdown(table)).rows[0] == list(table[0].values())
