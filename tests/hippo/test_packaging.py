"""What an installation holds: `hippo` alone, since others have packages called `baselines` and `experiments`."""

import json
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest

from tests import ROOT

MAKE = """
import json, hippo, hippo.envs
envs = hippo.envs.make("block_hopper", 2, seed=0)
obs, _ = envs.reset(seed=0)
print(json.dumps({"file": hippo.__file__, "shape": obs.shape}))
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """Built from a copy of the sources, because setuptools leaves its folders beside them."""
    folder = tmp_path_factory.mktemp("wheel")
    listed = [
        "git",
        "ls-files",
        "-z",
        "pyproject.toml",
        "README.md",
        "LICENSE",
        "hippo",
        "analysis",
        "baselines",
        "experiments",
    ]
    names = subprocess.run(listed, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split("\0")
    for name in filter(None, names):
        (folder / "source" / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / "source" / name).write_bytes((ROOT / name).read_bytes())
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-index", "--no-build-isolation"]
    subprocess.run([*command, "--wheel-dir", folder, folder / "source"], check=True)
    (built,) = folder.glob("*.whl")
    return built


def test_a_wheel_holds_hippo_and_nothing_else(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0] for name in names} == {"hippo", f"{wheel.name.rsplit('-', 3)[0]}.dist-info"}
    here = {path.relative_to(ROOT).as_posix() for path in (ROOT / "hippo").rglob("*") if path.suffix in (".py", ".xml")}
    assert {name for name in names if name.endswith((".py", ".xml"))} == here
    assert "hippo/py.typed" in names


def test_an_installed_wheel_makes_an_environment_far_from_the_checkout(wheel, tmp_path):
    venv.create(tmp_path / "venv", symlinks=True)
    python = tmp_path / "venv/bin/python"
    packages = Path(
        subprocess.run(
            [python, "-c", "import site; print(*site.getsitepackages())"], capture_output=True, text=True, check=True
        ).stdout.strip()
    )
    command = [sys.executable, "-m", "pip", "--python", python, "install", "--quiet", "--no-deps", "--no-index", wheel]
    subprocess.run(command, check=True)
    # What hippo needs is found where these tests find it; as a .pth line, behind what is installed here.
    (packages / "needed.pth").write_text(sysconfig.get_path("purelib") + "\n")
    said = subprocess.run([python, "-c", MAKE], cwd=tmp_path, capture_output=True, text=True, check=True).stdout
    found = json.loads(said)
    assert Path(found["file"]).is_relative_to(packages)
    assert found["shape"][0] == 2


def test_the_editable_installation_shows_hippo_alone(tmp_path):
    names = ["hippo", "baselines", "experiments", "analysis", "paper_figures"]
    code = f"import importlib.util as u; print(*[n for n in {names} if u.find_spec(n)])"
    command = [sys.executable, "-I", "-c", code]
    assert subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True).stdout.split() == ["hippo"]
