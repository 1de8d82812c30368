"""Final policies small enough to be committed: what evaluating and filming a run needs, without what training needs.

    python -m experiments.export runs/<run_id> ... --to paper_figures/data/laptop/policies

writes <run_id>/config.yaml, manifest.json and a checkpoint.pt that holds the networks that act and nothing else. Such a
folder is a run folder to `experiments.evaluate` and `experiments.video`; training does not go on from it.
"""

import shutil
from collections.abc import Sequence
from pathlib import Path

from experiments.command_line import Parser, bad_input, run_command
from experiments.evaluate import load_finished_run, name_of
from hippo.core import checkpoint
from hippo.core.acting import parts_that_act
from hippo.core.checkpoint import CheckpointError
from hippo.core.settings import ConfigError

COPIED = ("config.yaml", "manifest.json")


def export(folder: Path, target: Path) -> Path:
    """Write the run in `folder` to `target`/<run_id>; returns that folder.

    Raises:
        ConfigError: `folder` is no run's, or its run is not finished. CheckpointError: its checkpoint is damaged.
    """
    run = load_finished_run(folder)
    kept = parts_that_act(folder / "checkpoint.pt")
    place = target / name_of(run)
    place.mkdir(parents=True, exist_ok=True)
    for name in COPIED:
        shutil.copyfile(folder / name, place / name)
    checkpoint.save(place / "checkpoint.pt", kept)
    return place


def main(arguments: Sequence[str] | None = None) -> int:
    """Export from the command line."""
    parser = Parser(prog="experiments.export", description=__doc__.splitlines()[0])
    parser.add_argument("runs", type=Path, nargs="+", help="run folders")
    parser.add_argument("--to", type=Path, required=True, help="folder to write to")
    options = parser.parse_args(arguments)
    try:
        for folder in options.runs:
            place = export(folder, options.to)
            print(f"wrote {place}: {sum(path.stat().st_size for path in place.iterdir()) / 1000:.0f} kB")
    except (ConfigError, CheckpointError) as error:
        return bad_input(error)
    return 0


if __name__ == "__main__":
    run_command(main)
