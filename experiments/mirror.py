"""Mirror finished runs to Weights & Biases or TensorBoard, for instance those that were trained without.

    python -m experiments.mirror runs/<run_id> ... [--mode offline] [--project hippo]
    python -m experiments.mirror runs/<run_id> ... --to tensorboard

What they get is what they would have got during training: docs/wandb.md.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

from experiments.command_line import EXIT_FAILED, Parser, bad_input, run_command
from experiments.evaluate import load_finished_run
from experiments.schema import WANDB_MODES, WandbConfig
from hippo.core.mirror import log_of, start_mirror
from hippo.core.settings import ConfigError


def main(arguments: Sequence[str] | None = None) -> int:
    """Mirror from the command line; nothing is sent unless all of `runs` are finished."""
    parser = Parser(prog="experiments.mirror", description=__doc__.splitlines()[0])
    parser.add_argument("runs", type=Path, nargs="+", help="run folders")
    parser.add_argument("--to", choices=("wandb", "tensorboard"), default="wandb")
    parser.add_argument("--mode", choices=WANDB_MODES[1:], default="online", help="offline: `wandb sync` uploads later")
    parser.add_argument("--project", default=WandbConfig.project)
    options = parser.parse_args(arguments)
    try:
        for folder in options.runs:
            load_finished_run(folder)
    except ConfigError as error:
        return bad_input(error)
    codes, how = [], (options.mode, options.project) if options.to == "wandb" else ()
    for folder in options.runs:
        codes.append(start_mirror(folder, options.to, *how).wait())
        if codes[-1]:
            print(f"error: {folder} is not mirrored (log: {log_of(folder, options.to)})", file=sys.stderr)
        else:
            print(f"mirrored {folder}", flush=True)
    return EXIT_FAILED if any(codes) else 0


if __name__ == "__main__":
    run_command(main)
