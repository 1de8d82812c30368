"""What a user's environment variables and folders must not break: MuJoCo's import and numba's cache.

Imported before everything else that imports MuJoCo or compiles a kernel.
"""

import atexit
import os
import shutil
import tempfile
from pathlib import Path

from numba import config


def import_mujoco_without_opengl() -> None:
    """Import MuJoCo so that a MUJOCO_GL that does not work here, or is misspelt, matters to drawing only."""
    wanted = os.environ.get("MUJOCO_GL")
    os.environ["MUJOCO_GL"] = "disable"
    try:
        import mujoco  # noqa: F401
    finally:
        del os.environ["MUJOCO_GL"]
        if wanted is not None:
            os.environ["MUJOCO_GL"] = wanted


def place_for_kernels(source: Path) -> str:
    """Where numba is to keep compiled kernels: "" for its own choice, else a folder that goes when this process ends.

    Args:
        source: the folder of the code, beside which numba keeps them where it can.
    """
    chosen: str = config.CACHE_DIR  # type: ignore[attr-defined]
    if chosen or _takes_files(source / "__pycache__") or _takes_files(Path("~/.cache").expanduser()):
        return ""
    place = tempfile.mkdtemp(prefix="hippo-kernels-")
    atexit.register(shutil.rmtree, place, ignore_errors=True)
    return place


def _takes_files(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except (OSError, RuntimeError):
        return False


import_mujoco_without_opengl()
if place := place_for_kernels(Path(__file__).parent):
    config.CACHE_DIR = place  # type: ignore[attr-defined]
