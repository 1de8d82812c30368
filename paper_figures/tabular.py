"""How every table is written: csv, Markdown, and LaTeX (booktabs) that compiles alone."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from analysis.runs import Results

TEX = {
    "\\": r"\textbackslash{}",
    "_": r"\_",
    "%": r"\%",
    "&": r"\&",
    "#": r"\#",
    "$": r"\$",
    "{": r"\{",
    "}": r"\}",
    "^": r"\^{}",
    "~": r"\~{}",
    "±": r"$\pm$",
    "≥": r"$\geq$",
    "<": r"$<$",
    ">": r"$>$",
}
Row = dict[str, str]
LINE = 180  # letters of LaTeX's scriptsize beside each other on a landscape page
LONG = 33  # letters above which a column may be wrapped


def escaped(text: str) -> str:
    """`text` as LaTeX shows it; what stands between ** is bold."""
    parts = text.split("**")
    safe = ["".join(TEX.get(character, character) for character in part) for part in parts]
    return "".join(rf"\textbf{{{part}}}" if i % 2 else part for i, part in enumerate(safe))


def markdown(table: Sequence[Row]) -> str:
    """The table as Markdown."""
    head = list(table[0])
    cells = [[cell.replace("|", r"\|") for cell in row.values()] for row in table]
    lines = [
        "| " + " | ".join(head) + " |",
        "|" + "---|" * len(head),
        *("| " + " | ".join(row) + " |" for row in cells),
    ]
    return "\n".join(lines) + "\n"


def columns(table: Sequence[Row]) -> str:
    """LaTeX's column types: as wide as their text or, if the page is too narrow, long ones share what is left of it."""
    names = list(table[0])
    widths = [max(len(cell.replace("**", "")) for cell in (name, *(row[name] for row in table))) + 2 for name in names]
    if sum(widths) <= LINE:
        return "l" * len(names)
    long = sum(width for width in widths if width > LONG)
    left = (LINE - sum(width for width in widths if width <= LONG)) / LINE
    paragraph = r">{\raggedright\arraybackslash}p{%.3f\linewidth}"
    return "".join(paragraph % (left * width / long) if width > LONG else "l" for width in widths)


def latex(table: Sequence[Row], comment: str) -> str:
    """The table as a LaTeX document that compiles alone.

    Args:
        comment: what stands behind the numbers, as the document's first line.
    """
    lines = [
        f"% {' '.join(comment.split())}",
        r"\documentclass{article}\usepackage{array,booktabs,longtable}\usepackage[margin=1cm,landscape]{geometry}",
        r"\begin{document}\scriptsize\setlength\tabcolsep{3pt}",
        rf"\begin{{longtable}}{{{columns(table)}}}\toprule",
        " & ".join(escaped(head) for head in table[0]) + r" \\ \midrule \endhead",
        *(" & ".join(escaped(cell) for cell in row.values()) + r" \\" for row in table),
        r"\bottomrule\end{longtable}\end{document}",
    ]
    return "\n".join(lines) + "\n"


def publish(results: Results, options: argparse.Namespace, table: Sequence[Row], note: str = "") -> str:
    """Write the table of `results` as csv (its raw rows), Markdown and LaTeX; returns what to print."""
    stem, smoke = results.stem(options.out), " It says nothing about the methods." * (options.scale == "smoke")
    note = f"Scale: {options.scale}.{smoke} {note}From {results.origin()}."
    text = write(stem, results.plan["title"], note, table, results.provenance())
    results.frame.to_csv(stem.with_suffix(".csv"), index=False, lineterminator="\n")
    return f"{text}\nwrote {stem}.csv {stem}.md {stem}.tex"


def write(stem: Path, title: str, note: str, table: Sequence[Row], comment: str) -> str:
    """Write `stem`.md and `stem`.tex; returns the Markdown."""
    stem.parent.mkdir(parents=True, exist_ok=True)
    text = f"{title}. {note}\n\n{markdown(table)}"
    stem.with_suffix(".md").write_text(text)
    stem.with_suffix(".tex").write_text(latex(table, comment))
    return text
