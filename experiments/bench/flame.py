"""A flame graph of one HiPPO iteration on Ant Gather as a picture for the docs; `make profile`.

py-spy samples this process from outside during its second iteration, at the paper's batch. Its SVG has no labels until
a script puts them in, which no browser runs for a picture inside a page: here they are put in and the script goes.
"""

import ctypes
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import xml.sax.saxutils
from collections.abc import Sequence
from pathlib import Path

from experiments.bench.iterations import Iteration, training
from experiments.choices import ROOT
from experiments.command_line import EXIT_FAILED, run_command

PICTURE = ROOT / "docs" / "pictures" / "profile_ant_gather.svg"
TITLE = "One HiPPO iteration, Ant Gather at the paper's batch: share of its wall time by function (py-spy)"
RUN = ("env=ant_gather", "algo=hippo", "scale=paper")
WIDTH, CHARACTER = 1180, 7.2  # pixels: of the whole graph, of a letter in its monospaced font of 12
PR_SET_PTRACER, ANYONE = 0x59616D61, ctypes.c_ulong(-1)  # where Linux has Yama, a process may not trace its parent


class _Done(BaseException):
    """Leaves the training after its second iteration."""


def record(spy: str, target: Path, overrides: Sequence[str]) -> None:
    """Train two iterations, the second one under py-spy, which writes an SVG."""
    ctypes.CDLL(None).prctl(PR_SET_PTRACER, ANYONE, 0, 0, 0)
    command = [spy, "record", "--pid", str(os.getpid()), "--output", str(target), "--function"]
    sampler: subprocess.Popen | None = None

    def report(_: Iteration) -> None:
        nonlocal sampler
        if sampler is not None:
            sampler.send_signal(signal.SIGINT)
            raise _Done
        sampler = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert sampler.stdout is not None
        sampler.stdout.readline()  # it says when it samples

    try:
        training(overrides, report)
    except _Done:
        assert sampler is not None
        sampler.communicate()


def labelled(svg: str) -> str:
    """py-spy's SVG with a label, as much of it as fits, in every frame, and without its script and buttons."""

    def label(match: re.Match[str]) -> str:
        title, between, width, start = match.groups()
        name = re.sub(r" \(\d[\d,]* samples.*", "", xml.sax.saxutils.unescape(title))
        room = int(float(width) / 100 * WIDTH / CHARACTER)
        shown = name if len(name) <= room else "" if room < 4 else name[: room - 2] + ".."
        return f"<title>{title}</title>{between}{start}{xml.sax.saxutils.escape(shown)}</text>"

    frame = r'<title>([^<]*)</title>(<rect [^>]*?width="([\d.]+)%"[^>]*/>)(<text [^>]*>)</text>'
    svg = re.sub(frame, label, svg)
    svg = re.sub(r'(<text id="title"[^>]*>)[^<]*', rf"\1{TITLE}", svg)
    svg = re.sub(r"<script.*?</script>", "", svg, flags=re.DOTALL)
    svg = re.sub(r'<text id="(?:details|unzoom|search|matched)"[^>]*>[^<]*</text>', "", svg)
    return re.sub(r' onload="[^"]*"| fg:[xw]="\d+"', "", svg)


def main() -> int:
    """Draw the picture anew."""
    spy = shutil.which("py-spy", path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', '')}")
    if spy is None:
        print("error: py-spy is not installed; it comes with the dev extra and requirements.lock", file=sys.stderr)
        return EXIT_FAILED
    with tempfile.TemporaryDirectory() as folder:
        raw = Path(folder) / "raw.svg"
        record(spy, raw, RUN)
        if not raw.exists():
            print("error: py-spy wrote nothing; why is above", file=sys.stderr)
            return EXIT_FAILED
        PICTURE.write_text(labelled(raw.read_text()))
    print(f"wrote {PICTURE}")
    return 0


if __name__ == "__main__":
    run_command(main)
