"""What a power cut may leave of a folder: the order of writes, syncs and renames is recorded, and cut at every point.

The model is the weakest that a file system may keep: a file's content lasts from its last fsync on, a folder's entries
from the folder's last fsync on. What came after may be there, in part, or not at all.
"""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

Files = dict[str, bytes]


class Recorder:
    """Records what could be found after a power cut in one folder, at every sync, rename and removal in it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.names: dict[str, int] = {}  # name -> file, as processes see it
        self.content: dict[int, bytes] = {}
        self.lasting_names: dict[str, int] = {}
        self.lasting_content: dict[int, bytes] = {}
        self.cuts: list[Files] = []
        self.number_of_files = 0

    def look(self) -> None:
        """Take in what was written since the last look."""
        there = {p.name: p.read_bytes() for p in self.folder.iterdir() if p.name != ".lock"} if self.exists else {}
        for name, content in there.items():
            if name not in self.names:
                self.number_of_files += 1
                self.names[name] = self.number_of_files
            self.content[self.names[name]] = content
        self.names = {name: file for name, file in self.names.items() if name in there}

    @property
    def exists(self) -> bool:
        """Whether the folder is there."""
        return self.folder.is_dir()

    def cut(self) -> None:
        """Note what a power cut now may leave, in its kinds: synced only, names without content, torn content, all."""
        self.look()
        synced = {file: self.lasting_content.get(file, b"") for file in self.content}
        longer = {file: now != synced[file] and now.startswith(synced[file]) for file, now in self.content.items()}
        torn = {
            file: now[: (len(synced[file]) + len(now)) // 2] if longer[file] else synced[file]
            for file, now in self.content.items()
        }
        zeros = {
            file: synced[file] + bytes(len(now) - len(synced[file])) if longer[file] else synced[file]
            for file, now in self.content.items()
        }
        for names in (self.lasting_names, self.names):
            for content in (synced, torn, zeros, self.content):
                found = {name: content.get(file, b"") for name, file in names.items()}
                if found not in self.cuts:
                    self.cuts.append(found)

    @contextlib.contextmanager
    def recording(self, monkeypatch: object) -> Iterator[None]:
        """Record while the block runs."""
        real = {name: getattr(os, name) for name in ("fsync", "replace", "rename", "unlink")}

        def fsync(descriptor: int) -> None:
            self.cut()
            path = Path(os.readlink(f"/proc/self/fd/{descriptor}"))
            if path == self.folder:
                self.lasting_names = dict(self.names)
            elif path.parent == self.folder and path.name in self.names:
                self.lasting_content[self.names[path.name]] = path.read_bytes()
            self.cut()

        def replace(source: object, target: object, **_: object) -> None:
            self.cut()
            real["replace"](source, target)
            if Path(target).parent == self.folder:
                self.names[Path(target).name] = self.names.pop(Path(source).name)
            self.cut()

        def unlink(path: object, **options: object) -> None:
            self.cut()
            real["unlink"](path, **options)
            self.cut()

        with monkeypatch.context() as patch:
            for name, function in (("fsync", fsync), ("replace", replace), ("rename", replace), ("unlink", unlink)):
                patch.setattr(os, name, function)
            yield


def put(folder: Path, files: Files) -> None:
    """Make `folder` hold `files` and nothing else."""
    folder.mkdir(parents=True, exist_ok=True)
    for path in folder.iterdir():
        path.unlink()
    for name, content in files.items():
        (folder / name).write_bytes(content)
