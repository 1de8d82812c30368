"""Files that survive a power cut, and JSON that is checked where it is read.

After a power cut a file holds what was synced, and perhaps more; a folder names the files that it named when it was
synced itself, and perhaps others. So what must be there is written, synced, renamed into place, and the folder synced.
"""

import errno
import json
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any


class DamagedFile(ValueError):
    """A file does not hold what it must; the message names the file and what is wrong."""


def sync_folder(folder: Path) -> None:
    """Make it last which files are in `folder`; a file system that cannot is left as it is."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # some network file systems
            raise
    finally:
        os.close(descriptor)


def write_synced(path: Path, content: bytes) -> None:
    """Write a file whose content is on the disk when this returns; its name is when its folder was synced."""
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def set_aside(path: Path, why: str) -> None:
    """Rename a damaged file to <name>.damaged, so that it can be made again, and say so on stderr."""
    kept = path.with_name(f"{path.name}.damaged")
    path.replace(kept)
    print(f"warning: {path}: {why}; set aside as {kept.name}", file=sys.stderr, flush=True)


def printable(text: str) -> str:
    """Text from a file as a terminal may take it: without its escapes."""
    return "".join(c if c.isprintable() else f"\\x{ord(c):02x}" for c in text)


def read_json(path: Path, schema: Mapping[str, type | tuple[type, ...]]) -> dict[str, Any]:
    """The JSON object in a file.

    Args:
        schema: keys that it must have, with the types of their values; a number may be an int where it is a float.

    Raises:
        DamagedFile: it is no JSON object, lacks a key or has a value of another type. OSError: it cannot be read.
    """
    try:
        content = json.loads(path.read_bytes())
    except ValueError as error:  # no JSON, or bytes that are no text
        raise DamagedFile(f"{path}: is no JSON ({' '.join(str(error).split())})") from None
    except RecursionError:
        raise DamagedFile(f"{path}: is no JSON that can be read (nested too deeply)") from None
    check_object(path, content, schema)
    return content


def check_object(path: Path, content: Any, schema: Mapping[str, type | tuple[type, ...]], where: str = "") -> None:
    """Raise DamagedFile unless `content`, read from `path`, is an object as `read_json` demands.

    Args:
        where: of the file's content it is, e.g. "runs[3]: ".
    """
    if not isinstance(content, dict):
        raise DamagedFile(f"{path}: {where}must be an object, is {type(content).__name__}")
    for key, kinds in schema.items():
        if key not in content:
            raise DamagedFile(f"{path}: {where}has no {key}")
        kinds = kinds if isinstance(kinds, tuple) else (kinds,)
        taken = (*kinds, int) if float in kinds else kinds
        value = content[key]
        if not isinstance(value, taken) or (isinstance(value, bool) and bool not in kinds):
            names = " or ".join("null" if kind is type(None) else kind.__name__ for kind in kinds)
            raise DamagedFile(f"{path}: {where}{key} must be {names}, is {value!r:.60}")
