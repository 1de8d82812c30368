"""How every table is written: csv, Markdown, and LaTeX (booktabs) that compiles alone."""

from collections.abc import Sequence
from pathlib import Path

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


def latex(table: Sequence[Row], comment: str) -> str:
    """The table as a LaTeX document that compiles alone.

    Args:
        comment: what stands behind the numbers, as the document's first line.
    """
    lines = [
        f"% {comment}",
        r"\documentclass{article}\usepackage{booktabs,longtable}\usepackage[margin=1cm,landscape]{geometry}",
        r"\begin{document}\footnotesize",
        rf"\begin{{longtable}}{{{'l' * len(table[0])}}}\toprule",
        " & ".join(escaped(head) for head in table[0]) + r" \\ \midrule \endhead",
        *(" & ".join(escaped(cell) for cell in row.values()) + r" \\" for row in table),
        r"\bottomrule\end{longtable}\end{document}",
    ]
    return "\n".join(lines) + "\n"


def write(stem: Path, title: str, note: str, table: Sequence[Row], comment: str) -> str:
    """Write `stem`.md and `stem`.tex; returns the Markdown."""
    stem.parent.mkdir(parents=True, exist_ok=True)
    text = f"{title}. {note}\n\n{markdown(table)}"
    stem.with_suffix(".md").write_text(text)
    stem.with_suffix(".tex").write_text(latex(table, comment))
    return text
