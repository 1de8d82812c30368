"""One self-contained page with everything drawn at one scale: `python -m analysis.report --scale smoke`.

Pictures are embedded, nothing is loaded from elsewhere, and every text is escaped.
"""

import argparse
import base64
import csv
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jinja2 import Environment

HERE = Path(__file__).parent
ROOT = HERE.parent


def markdown_table(text: str) -> list[list[str]]:
    """The cells of the first Markdown table in `text`, header first."""
    lines = [line.strip().strip("|") for line in text.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.split("|")] for i, line in enumerate(lines) if i != 1]


def artefact(plan: dict[str, Any], folder: Path) -> dict[str, Any]:
    """What is there of one figure or table."""
    stem = folder / plan["figure"]
    png, caption, table = stem.with_suffix(".png"), stem.with_suffix(".caption.txt"), stem.with_suffix(".md")
    return {
        "name": plan["figure"],
        "title": plan["title"],
        "png": base64.b64encode(png.read_bytes()).decode() if png.exists() else "",
        "rows": markdown_table(table.read_text()) if table.exists() else [],
        "caption": caption.read_text() if caption.exists() else "",
        "claims": plan["claims"],
        "runs": plan["runs"],
    }


def render(scale: str, runs_dir: Path, out: Path) -> str:
    """The page as HTML.

    Raises:
        FileNotFoundError: nothing was planned at this scale.
    """
    plans = [json.loads(path.read_text()) for path in sorted((runs_dir / "plans" / scale).glob("*.json"))]
    if not plans:
        raise FileNotFoundError(f"nothing was run at scale {scale} in {runs_dir}; run `make all SCALE={scale}` first")
    with (ROOT / "docs" / "hyperparameters.csv").open() as file:
        ledger = list(csv.reader(file))
    artefacts = [artefact(plan, out / scale) for plan in plans]
    template = Environment(autoescape=True).from_string((HERE / "report.html.j2").read_text())
    claims = out / scale / "claims.md"
    rows = markdown_table(claims.read_text()) if claims.exists() else []
    return template.render(scale=scale, artefacts=artefacts, ledger=ledger, claims=rows)


def main(arguments: Sequence[str] | None = None) -> int:
    """Write report.html."""
    parser = argparse.ArgumentParser(prog="analysis.report", description=__doc__.splitlines()[0])
    parser.add_argument("--scale", default="smoke", help="smoke, laptop or paper")
    parser.add_argument("--runs-dir", type=Path, default=Path("runs"))
    parser.add_argument("--out", type=Path, default=ROOT / "paper_figures" / "out")
    options = parser.parse_args(arguments)
    try:
        page = render(options.scale, options.runs_dir, options.out)
    except FileNotFoundError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    path = options.out / options.scale / "report.html"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(page)
    print(f"wrote {path}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
