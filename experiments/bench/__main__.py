"""How fast are we, as ratios within one run: physics, environments, whole iterations, peers, scaling, memory.

    python -m experiments.bench [--quick] [--only PART ...] [--write]

Absolute numbers depend on the machine and on what else it does; ratios of what took turns hardly do. One thread unless
the row says otherwise.
"""

import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch

from experiments.bench import environments, iterations, learning, memory, peers, scaling, sweeps, targets
from experiments.bench.measure import Row
from experiments.command_line import Parser, clock, duration, run_command
from experiments.status import write_atomically


@dataclass(frozen=True)
class Part:
    """One part: `rows(quick)` measures and yields lines as they come."""

    rows: Callable[[bool], Iterator[Row | str]]
    seconds: float  # it takes about this on two busy cores
    quick_seconds: float


PARTS = {
    "iterations": Part(iterations.rows, 640, 60),
    "environments": Part(environments.rows, 80, 20),
    "peers": Part(peers.rows, 150, 20),
    "scaling": Part(scaling.rows, 220, 60),
    "memory": Part(memory.rows, 140, 30),
    "workers": Part(sweeps.rows, 140, 30),
    "fig3": Part(sweeps.front_door, 220, 0),
    "learning": Part(learning.rows, 3000, 60),
}
APART = ("learning",)  # too long for the whole: done only where it is named


def measure(names: list[str], quick: bool, show: Callable[[str], None]) -> dict[str, float]:
    """Do the parts and `show` the lines of their table; what was measured of the targets by key."""
    expected = {name: PARTS[name].quick_seconds if quick else PARTS[name].seconds for name in names}
    print(f"{len(names)} parts, about {duration(sum(expected.values()))} on two busy cores: {', '.join(names)}")
    measured, start, done = {}, time.perf_counter(), 0.0
    for number, name in enumerate(names, 1):
        elapsed, left = time.perf_counter() - start, sum(expected.values()) - done
        eta = left * (elapsed / done if done else 1.0)
        print(
            f"\npart {number} of {len(names)}: {name}   elapsed {clock(elapsed)}, left about {clock(eta)}", flush=True
        )
        show("")
        for row in PARTS[name].rows(quick):
            show(str(row))
            if isinstance(row, Row) and row.key:
                measured[row.key] = row.value
        done += expected[name]
    print(f"\ndone after {clock(time.perf_counter() - start)}")
    return measured


def main(arguments: list[str] | None = None) -> int:
    """Print the table, and put it into docs/performance.md if asked to."""
    parser = Parser(prog="experiments.bench", description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="few and short measurements, to see that all works")
    parser.add_argument("--only", nargs="+", choices=PARTS, metavar="PART", help=f"some of: {', '.join(PARTS)}")
    parser.add_argument("--write", action="store_true", help=f"put the table into docs/{targets.PAGE.name}")
    options = parser.parse_args(arguments)
    if options.write and (options.quick or options.only):
        parser.error("--write: needs the whole benchmark, without --quick and --only")
    if options.write:
        targets.with_block(targets.PAGE.read_text(), "", [])  # refuses a page without marks now, not later
    torch.set_num_threads(1)
    lines: list[str] = []

    def show(line: str) -> None:
        print(line, flush=True)
        lines.append(line)

    about = targets.machine()
    print(about)
    try:
        measured = measure(options.only or [name for name in PARTS if name not in APART], options.quick, show)
    except KeyboardInterrupt:
        print("\nstopped; nothing was written", file=sys.stderr)
        return 130
    show("")
    for line in targets.closing(measured):
        show(line)
    if options.write:
        page = targets.PAGE
        write_atomically(page, targets.with_block(page.read_text(), about, lines[1:]))
        print(f"wrote {page}")
    return 0


if __name__ == "__main__":
    run_command(main)
