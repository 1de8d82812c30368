"""Everything at one scale on one page: `python -m analysis.report --scale smoke` writes report.html and report.md.

The page carries its pictures, loads nothing and runs no script; every text is escaped, whatever a run is called.
"""

import base64
import os
import re
import sys
from collections import Counter
from collections.abc import Sequence
from hashlib import sha256
from pathlib import Path
from typing import Any
from urllib.parse import quote

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup, escape

from analysis.command_line import bad_input, parser
from analysis.edition import chosen
from analysis.report_data import Artefact, Report, Table, gather
from analysis.report_runs import RunFacts
from analysis.runs import MissingData

HERE = Path(__file__).parent
RUN_COLUMNS = ("run", "algorithm", "method", "seed", "state", "commit", "lock", "core-s", "physics", "used in")
VERDICTS = {"reproduced": "good", "not reproduced": "bad", "inconclusive": "open", "undecidable here": "open"}
UNKNOWN = "-"
MARKUP = re.compile(r"([\\`*_\[\]|~$@]|:(?=//)|(?<=www)\.)")  # the last three make links of bare addresses
OPENING = re.compile(r"^(\d*)(?=[-+#=.)]+(\s|$))")  # of a line, which makes it a list, a heading or a rule


class Plain(str):
    """Text that is Markdown already."""


def markdown_text(value: Any) -> str:
    """`value` as Markdown shows it letter by letter, on one line: nothing in it is markup, HTML or a link."""
    if isinstance(value, Plain | Markup):
        return str(value)
    return OPENING.sub(r"\1\\", _within_a_line(str(value)).strip())


def markdown_bold(cell: str) -> str:
    """A table's cell, what stands between ** in bold."""
    parts = map(_within_a_line, split_bold(cell))
    return "".join(f"**{part}**" if i % 2 else part for i, part in enumerate(parts)).strip()


def _within_a_line(text: str) -> str:
    """`text` as Markdown shows it where no line begins."""
    text = MARKUP.sub(r"\\\1", re.sub(r"\s+", " ", text))
    return text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")


def markdown_grid(table: Table) -> Plain:
    """A table as Markdown."""
    rule = "|".join(" ---: " if numeric else " --- " for numeric in table.numeric())
    rows = [" | ".join(map(markdown_bold, cells)) for cells in (table.header, *table.rows)]
    return Plain("\n".join([f"| {rows[0]} |", f"|{rule}|", *(f"| {row} |" for row in rows[1:])]) + "\n")


def html_bold(cell: str) -> Markup:
    """The same as HTML."""
    return Markup("").join(
        Markup("<strong>{}</strong>").format(part) if i % 2 else escape(part) for i, part in enumerate(split_bold(cell))
    )


def split_bold(cell: str) -> list[str]:
    """Parts of a cell, every second one bold; a cell with an unpaired ** is one part."""
    parts = re.split(r"(?:(?<=^)|(?<=\s))\*\*(?=\S)|(?<=\S)\*\*(?=\s|$)", cell)
    return parts if len(parts) % 2 else [cell]


def data_uri(path: Path, kind: str) -> str:
    """A file as an address that carries it."""
    return f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode()}"


def duration(seconds: float) -> str:
    """A cost in a larger unit, with a comma; empty where seconds say it as well."""
    for size, unit in ((3600, "core-hours"), (60, "core-minutes")):
        if seconds >= size:
            return f"{seconds / size:,.1f} {unit}, "
    return ""


def full_name(name: str) -> str:
    """ "fig3" as "Figure 3", anything else as words."""
    found = re.fullmatch(r"(fig|table)(\d+)", name)
    return f"{ {'fig': 'Figure', 'table': 'Table'}[found[1]] } {found[2]}" if found else words(name)


def words(name: str) -> str:
    """ "ant_gather" as "Ant Gather"."""
    return name.replace("_", " ").title()


def anchor(name: str) -> str:
    """An id that no name can break out of, different from those of the fixed sections."""
    return "artefact-" + re.sub(r"[^a-z0-9]", lambda found: f"-{ord(found[0]):x}", name)


def behind(artefact: Artefact) -> str:
    """Which runs an artefact states, beside those that are planned."""
    if not artefact.behind and not artefact.planned:
        return "No run stands behind it."
    drawn = f"Drawn from {len(artefact.behind)} run{'' if len(artefact.behind) == 1 else 's'}"
    if artefact.behind == artefact.planned:
        return f"{drawn}, all that are planned."
    known, unknown = len(artefact.behind & artefact.planned), len(artefact.behind - artefact.planned)
    others = f", and {unknown} that the list of runs on this page lacks" if unknown else ""
    return f"{drawn}: {known} of the {len(artefact.planned)} that are planned{others}."


def run_row(run: RunFacts) -> list[str]:
    """One run under RUN_COLUMNS."""
    commit = ", then ".join(run.code)
    cost = UNKNOWN if run.seconds is None else f"{run.seconds:,.0f}"
    method = ", ".join(run.labels) or "others start from it"
    known = (run.run_id, run.algo, method, run.seed, run.state, commit, run.lock[:10], cost, run.physics)
    return [text or UNKNOWN for text in (*known, ", ".join(run.used_in))]


def runs_by_environment(runs: Sequence[RunFacts]) -> dict[str, Table]:
    """A table of runs per environment."""
    tables: dict[str, Table] = {}
    for run in runs:
        tables.setdefault(run.env or "unknown here", Table(list(RUN_COLUMNS), [])).rows.append(run_row(run))
    return tables


def code_table(runs: Sequence[RunFacts]) -> Table:
    """Which code, versions and processors the runs were trained with, and how many runs each."""
    groups = Counter((run.commit, run.dirty, run.lock, run.cpu) for run in runs if run.dirty is not None)
    return Table(
        ["commit", "uncommitted changes", "lock file (SHA-256)", "processor", "runs"],
        [
            [c or UNKNOWN, "yes" if d else "no" if c else UNKNOWN, k[:16] or UNKNOWN, p, str(n)]
            for (c, d, k, p), n in groups.items()
        ],
    )


def ledger_by_algorithm(ledger: Table) -> dict[str, Table]:
    """The ledger, a table per algorithm."""
    tables: dict[str, Table] = {}
    for algorithm, *cells in ledger.rows:
        tables.setdefault(algorithm, Table(ledger.header[1:], [])).rows.append(cells)
    return tables


def render(report: Report) -> tuple[str, str]:
    """The page as HTML, and as Markdown."""
    style = (HERE / "report.css").read_text()
    digest = base64.b64encode(sha256(style.encode()).digest()).decode()
    content = {
        "report": report,
        "css": Markup(style),  # ours, and the policy lets this very text in
        "policy": f"default-src 'none'; style-src 'sha256-{digest}'; img-src data:; media-src data:; "
        "base-uri 'none'; form-action 'none'",
        "claims": [dict(zip(report.claims.header, row, strict=True)) for row in report.claims.rows]
        if report.claims
        else [],
        "runs": runs_by_environment(report.runs),
        "code": code_table(report.runs),
        "ledger": ledger_by_algorithm(report.ledger),
        "timed": sum(run.seconds is not None for run in report.runs),
    }
    options: dict[str, Any] = {
        "loader": FileSystemLoader(HERE),
        "undefined": StrictUndefined,
        "trim_blocks": True,
        "lstrip_blocks": True,
        "keep_trailing_newline": True,
    }
    both: dict[str, Any] = {"behind": behind, "duration": duration, "name": full_name}
    html = Environment(autoescape=True, **options)
    html.filters |= both | {"anchor": anchor, "bold": html_bold, "data_uri": data_uri, "words": words}
    html.filters["verdict_class"] = lambda verdict: VERDICTS.get(verdict, "")
    markdown = Environment(autoescape=False, finalize=markdown_text, **options)
    markdown.filters |= both | {"plain": Plain, "link": quote, "grid": markdown_grid, "html": escape}
    return (
        html.get_template("report.html.j2").render(content).lstrip(),
        re.sub(r"\n{3,}", "\n\n", markdown.get_template("report.md.j2").render(content)).strip() + "\n",
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Write report.html and report.md; exit code 2 where there is nothing to report."""
    options = parser("analysis.report", __doc__.splitlines()[0]).parse_args(arguments)
    try:
        report = gather(chosen(options), options.runs_dir, options.data, options.out)
        pages = render(report)
    except (MissingData, ValueError) as error:
        return bad_input(error)
    folder = options.out / chosen(options).folder
    folder.mkdir(parents=True, exist_ok=True)
    for line in report.not_drawn:
        print(f"missing: {line}")
    for name, page in zip(("report.html", "report.md"), pages, strict=True):
        temporary = folder / f"{name}.tmp"
        temporary.write_text(page)
        os.replace(temporary, folder / name)
    print(f"wrote {folder / 'report.html'} ({len(pages[0]) / 1e6:.1f} MB) and {folder / 'report.md'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
