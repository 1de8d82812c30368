"""Pictures: what a person must be able to tell apart is there, in the colours and places it has; videos; pages."""

import os
import shutil
import subprocess
import sys
import tracemalloc

import gymnasium as gym
import numpy as np
import pytest

import hippo.envs
from experiments import train, video
from experiments.artefacts import environment_pages, fidelity
from experiments.config import compose_run
from hippo.envs import make
from hippo.envs.rendering import NoOpenGL, Renderer, follow, open_gl
from paper_figures import fig1, fig2
from tests import ROOT

try:
    BACK_END = open_gl()
except NoOpenGL:
    BACK_END = ""
needs_gl = pytest.mark.skipif(not BACK_END, reason="no OpenGL here (make install-render)")


def count(frame, colour, by=100):
    """Pixels in which `colour` (0 red, 1 green, 2 blue) rules by so much; the Ant's orange is red by about 70."""
    others = [c for c in range(3) if c != colour]
    return int((frame[..., colour].astype(int) - frame[..., others].max(-1) > by).sum())


@needs_gl
def test_apples_are_green_bombs_are_red_and_caught_ones_are_gone():
    envs = make("ant_gather", 2, 0)
    envs.reset(seed=0)
    renderer = Renderer(envs)
    everything = renderer.frame(1)
    envs.task.present[1, :8] = False
    no_apples = renderer.frame(1)
    envs.task.present[1] = False
    nothing = renderer.frame(1)
    renderer.close()
    assert count(everything, 1) > 500
    assert count(everything, 0) > 500
    assert count(no_apples, 1) == 0
    assert count(no_apples, 0) > 500
    assert max(count(nothing, 0), count(nothing, 1)) < 20


@needs_gl
@pytest.mark.parametrize("name", ["block_hopper", "block_half_cheetah"])
def test_walls_are_drawn_as_high_as_they_are(name):
    envs = make(name, 1, 0)
    envs.reset(seed=0)
    renderer = Renderer(envs)
    envs.task.heights[:] = 0.1
    envs.task.raise_walls(np.array([0]))
    low = count(renderer.frame(0), 2, by=40)
    envs.task.heights[:] = 0.3
    envs.task.raise_walls(np.array([0]))
    high = count(renderer.frame(0), 2, by=40)
    renderer.close()
    assert 0 < low < high


@needs_gl
def test_drawing_changes_nothing_in_the_simulation():
    drawn, plain = make("block_hopper", 1, 0), make("block_hopper", 1, 0)
    renderer = Renderer(drawn)
    for envs in (drawn, plain):
        envs.reset(seed=0)
    for _ in range(20):
        action = np.full((1, 3), 0.5)
        renderer.frame(0)
        np.testing.assert_array_equal(drawn.step(action)[0], plain.step(action)[0])
    np.testing.assert_array_equal(drawn.physics.get_state(), plain.physics.get_state())
    renderer.close()


@needs_gl
@pytest.mark.parametrize("name", hippo.envs.ENVIRONMENTS)
def test_every_registered_id_renders(name):
    env = gym.make(hippo.envs.gymnasium_id(name), render_mode="rgb_array")
    env.reset(seed=0)
    frame = env.render()
    assert (frame.shape, frame.dtype) == ((480, 640, 3), np.uint8)
    assert len(np.unique(frame.reshape(-1, 3), axis=0)) > 20
    env.close()


def test_a_window_without_a_display_is_refused_in_words(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    env = gym.make("hippo/BlockHopper-v0", render_mode="human", disable_env_checker=True)
    with pytest.raises(NoOpenGL, match="needs a display"):
        env.reset(seed=0)
    env.close()


@pytest.fixture(scope="module")
def display():
    """The name of a display without a screen."""
    if not shutil.which("Xvfb"):
        pytest.skip("no Xvfb here (apt-get install xvfb libgl1)")
    read, write = os.pipe()
    command = ["Xvfb", "-displayfd", str(write), "-screen", "0", "800x600x24", "-nolisten", "tcp"]
    server = subprocess.Popen(command, pass_fds=[write], stderr=subprocess.DEVNULL)
    os.close(write)
    with os.fdopen(read) as lines:
        number = lines.readline().strip()
    if not number:
        pytest.skip("Xvfb does not start here")
    yield f":{number}"
    server.terminate()
    server.wait()


IN_A_WINDOW = """
import sys, time
import gymnasium, mujoco, numpy
import hippo.envs
from hippo.envs.rendering import NoOpenGL
try:
    env = gymnasium.make("hippo/BlockHopper-v0", render_mode="human", disable_env_checker=True)
    env.reset(seed=0)
except NoOpenGL as error:
    sys.exit(f"skip: {error}")
renderer = env.unwrapped._viewer._renderer
renderer.put(renderer.frame(0))
seen = numpy.empty((renderer._rectangle.height, renderer._rectangle.width, 3), numpy.uint8)
mujoco.mjr_readPixels(seen, None, renderer._rectangle, renderer._mujoco)
numpy.save(sys.argv[1], seen[::-1])
start = time.perf_counter()
for _ in range(6):
    env.step(numpy.zeros(3))
print(time.perf_counter() - start)
if sys.argv[2] == "close":
    env.close()
    env.close()
"""


@needs_gl
@pytest.mark.parametrize("end", ["close", "leave open"])
def test_a_window_shows_the_frames_at_their_pace_and_ends_without_a_crash(end, display, tmp_path):
    path = tmp_path / "seen.npy"
    command = [sys.executable, "-c", IN_A_WINDOW, str(path), end]
    result = subprocess.run(command, env=os.environ | {"DISPLAY": display}, capture_output=True, text=True, cwd=ROOT)
    if result.stderr.startswith("skip: "):
        pytest.skip(result.stderr)
    assert (result.returncode, result.stderr) == (0, "")
    assert float(result.stdout) > 5 / 50  # six steps of 0.02 s, of which the first is shown at once
    env = gym.make("hippo/BlockHopper-v0", render_mode="rgb_array")
    env.reset(seed=0)
    assert np.abs(env.render().astype(int) - np.load(path)).mean() < 1
    env.close()
    with pytest.raises(gym.error.ClosedEnvironmentError):
        env.render()


def test_without_opengl_the_error_names_the_remedy_and_figure_2_shows_committed_frames(tmp_path):
    script = (
        "import sys; from hippo.envs.rendering import open_gl, NoOpenGL; from paper_figures import fig2\n"
        "try: open_gl()\nexcept NoOpenGL as error: print(error)\nsys.exit(fig2.main(['--out', sys.argv[1]]))"
    )
    environment = {"MUJOCO_GL": "disabled", "PATH": "/usr/bin:/bin", "HOME": str(tmp_path)}
    command = [sys.executable, "-c", script, str(tmp_path)]
    result = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=True)
    assert "run `make install-render`" in result.stdout
    assert "committed frames" in (tmp_path / "smoke/fig2.caption.txt").read_text()


@pytest.mark.parametrize("figure", [fig1, fig2])
def test_a_figure_drawn_twice_is_the_same_bytes(figure, tmp_path):
    for folder in "ab":
        assert figure.main(["--out", str(tmp_path / folder)]) == 0
    for path in (tmp_path / "a/smoke").iterdir():
        assert path.read_bytes() == (tmp_path / "b/smoke" / path.name).read_bytes()


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    budget = ["iterations=1", "batch_size=400", "env.horizon=100", f"runs_dir={folder}"]
    run = compose_run(["env=snake_gather", "algo=hippo", "scale=smoke", *budget])
    assert train.execute(run) == "finished"
    return run


@needs_gl
def test_a_video_is_written_and_can_be_read_again(trained, capsys):
    import imageio.v3 as imageio

    assert video.main([str(trained.folder), "--perturbation", "mass"]) == 0
    frames = imageio.imread(trained.folder / "video.mp4")
    assert frames.shape == (100, 480, 640, 3)  # 20 control steps a second, all drawn
    assert "return" in capsys.readouterr().out
    assert not list(trained.folder.glob("*.part*"))


@needs_gl
def test_a_videos_memory_does_not_grow_with_its_length(tmp_path):
    frame = np.zeros((480, 640, 3), np.uint8)
    peaks = []
    for length in (20, 200):
        tracemalloc.start()
        with video.streamed(tmp_path / "v.mp4") as write:
            for _ in range(length):
                write(frame)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < peaks[0] + 2 * frame.nbytes


def test_a_video_of_nothing_is_refused(tmp_path, capsys):
    assert video.main([str(tmp_path)]) == 2
    assert "is no run folder" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"), [(["--out", "film.xyz"], "must end in .mp4"), (["--seed", "-1"], "must be at least 0")]
)
def test_a_wrong_option_of_a_video_is_refused_in_a_line_and_nothing_is_written(arguments, message, trained, capsys):
    before = set(trained.folder.iterdir())
    assert video.main([str(trained.folder), *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert set(trained.folder.iterdir()) == before


@needs_gl
def test_the_camera_looks_at_the_arena_until_the_robot_leaves_it_and_then_follows():
    envs = make("snake_gather", 1, 0)
    envs.reset(seed=0)
    renderer = Renderer(envs)
    looks = []
    for x in (5.0, 9.5):
        envs.physics.com[0, :2] = (x, 0.0)
        follow(renderer.camera, envs, 0)
        looks.append(renderer.camera.lookat[0])
    renderer.close()
    assert looks == [0.0, 3.0]


def test_speeds_leave_out_the_way_back_to_the_start():
    com = np.zeros((4, 1, 3))
    com[:, 0, 0] = [0.0, 0.1, 0.4, 0.05]  # ends at 0.4 m; the next episode starts anew
    rolled = fidelity.Trajectories(com, np.zeros((3, 1, 1)), np.array([[False], [True], [False]]), dt=0.1)
    np.testing.assert_allclose(rolled.speeds(), [1.0, 3.0])


def test_trajectories_are_compared_only_where_nothing_has_ended(monkeypatch):
    monkeypatch.setattr(fidelity, "INSTANTS", (0.2,))
    com = np.zeros((3, 2, 3))
    apart = com.copy()
    apart[2, :, 0] = [0.5, 99.0]
    going, one_ended = np.zeros((2, 2), bool), np.array([[False, True], [False, False]])
    paper = fidelity.Trajectories(com, np.zeros((2, 2, 1)), going, dt=0.1)
    fast = fidelity.Trajectories(apart, np.zeros((2, 2, 1)), one_ended, dt=0.1)
    assert fidelity.divergence_row("ant", paper, fast) == "| Ant | 0.5000 (0.000) | 1 of 2 |"


def test_fidelity_refuses_a_run_of_a_task_with_one_kind_of_physics(tmp_path, capsys):
    run = compose_run(["env=block_hopper", "algo=hippo", "scale=smoke", f"runs_dir={tmp_path}"])
    run.folder.mkdir(parents=True)
    (run.folder / "config.yaml").write_text(run.to_yaml())
    assert fidelity.main(["--run", str(run.folder)]) == 2
    assert "only ant_gather, snake_gather have two kinds of physics" in capsys.readouterr().err


@pytest.mark.parametrize("page", sorted(environment_pages.FOLDER.glob("*.md")), ids=lambda path: path.stem)
def test_the_tables_of_the_environment_pages_are_fresh(page):
    assert environment_pages.renewed(page) == page.read_text(), "run python -m experiments.artefacts.environment_pages"


def test_every_environment_has_a_page_and_every_option_is_on_it():
    for name, environment in hippo.envs.ENVIRONMENTS.items():
        page = environment_pages.FOLDER / f"{name}.md"
        text = (page if page.exists() else environment_pages.FOLDER / "robots_alone.md").read_text()
        for option in environment.options:
            assert f"`{option}`" in text
