"""Reads the transaction log of an offline wandb run: LevelDB's log framing around wandb's protobuf records."""

import json
import struct
from pathlib import Path
from typing import Any

from wandb.proto.wandb_internal_pb2 import Record

BLOCK, HEADER = 32768, 7
FULL, FIRST, MIDDLE, LAST = 1, 2, 3, 4


def records(path: Path) -> list[Record]:
    """Every complete record; what a kill cut off at the end is left out."""
    data = path.read_bytes()
    if data[:4] != b":W&B":
        raise ValueError(f"{path}: no wandb log")
    found, parts, at = [], b"", HEADER  # the file's own header is as long as a record's
    while at + HEADER <= len(data):
        if BLOCK - at % BLOCK < HEADER:  # no room for a header: the block's rest is padding
            at += BLOCK - at % BLOCK
            continue
        _, length, kind = struct.unpack_from("<IHB", data, at)
        chunk = data[at + HEADER : at + HEADER + length]
        if kind not in (FULL, FIRST, MIDDLE, LAST) or len(chunk) < length:
            break
        at += HEADER + length
        parts = chunk if kind in (FULL, FIRST) else parts + chunk
        if kind in (FULL, LAST):
            found.append(Record.FromString(parts))
    return found


def history(folder: Path) -> dict[int, dict[str, float]]:
    """Step -> metrics, the union of all offline logs in a run's folder; wandb's own keys left out.

    Raises:
        ValueError: two logs disagree about a step.
    """
    union: dict[int, dict[str, float]] = {}
    for path in sorted((folder / "wandb").glob("offline-run-*/run-*.wandb")):
        for record in records(path):
            if record.WhichOneof("record_type") != "history":
                continue
            items = {"/".join(i.nested_key) or i.key: json.loads(i.value_json) for i in record.history.item}
            row = {key: value for key, value in items.items() if not key.startswith("_")}
            if union.setdefault(items["_step"], row) != row:
                raise ValueError(f"{path}: step {items['_step']} differs from another session's")
    return union


def run_record(folder: Path) -> Any:
    """The record of the last offline log in a run's folder that names the run: id, group, tags."""
    *_, path = sorted((folder / "wandb").glob("offline-run-*/run-*.wandb"))
    (found, *_) = [record.run for record in records(path) if record.WhichOneof("record_type") == "run"]
    return found
