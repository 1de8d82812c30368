"""The import table of the architecture: which room may never import which (walks the syntax trees), and its page."""

import pytest

from experiments.artefacts import architecture
from experiments.artefacts.architecture import ROOMS, imported, within


@pytest.mark.parametrize("room", ROOMS)
def test_no_room_imports_what_it_must_not(room):
    assert architecture.files()[room]
    assert architecture.wrong_imports(room) == []


def test_every_exception_is_needed():
    for file, (modules, _) in architecture.EXCEPTIONS.items():
        needed = {name for name in imported(architecture.ROOT / file) if within(name, modules)}
        assert all(any(within(name, (module,)) for name in needed) for module in modules), file


def test_the_walk_sees_imports_inside_functions_and_of_submodules(tmp_path):
    (tmp_path / "m.py").write_text("def f():\n    from hippo import hippo\n    import torch.nn\n")
    found = imported(tmp_path / "m.py")
    assert within("torch.nn", ROOMS["analysis"].never)
    assert any(within(name, ROOMS["baselines"].never) for name in found)


def test_a_file_belongs_to_the_room_that_names_it_most_closely():
    assert architecture.room_of("hippo/hippo.py") == "the method"
    assert architecture.room_of("hippo/agent.py") == "hippo"
    assert architecture.room_of("experiments/bench/peers.py") == "experiments.bench"
    assert architecture.room_of("experiments/train.py") == "experiments"


def test_a_circle_of_imports_is_named(monkeypatch):
    circle = {("baselines", "hippo.core"): True, ("hippo.core", "baselines"): True}
    monkeypatch.setattr(architecture, "arrows", lambda: circle)
    with pytest.raises(ValueError, match=r"baselines -> hippo.core -> baselines"):
        architecture.floor("baselines")


def test_the_page_and_its_picture_are_what_the_imports_say():
    assert architecture.renewed() == architecture.PAGE.read_text(), "run python -m experiments.artefacts.architecture"
    assert architecture.picture() == architecture.PICTURE.read_text(), (
        "run python -m experiments.artefacts.architecture"
    )
