"""Pictures of a simulation: the robot, and drawn over it what the task knows - apples, bombs and lidar readings.

    renderer = Renderer(envs)          # a RobotTaskEnv; needs EGL or OSMesa (`make install-render`)
    image = renderer.frame(i)          # (H, W, 3) uint8 of simulation i as it is now
    renderer.close()

Nothing is added to the simulated model: what is drawn for the viewer's sake lives in MuJoCo's scene only.
"""

import copy
import importlib
import os
from typing import Any, Protocol

import mujoco
import numpy as np

from hippo.envs.gather import NUM_APPLES, NUM_BINS, SENSOR_RANGE, Gather

APPLE, BOMB = np.array([0.25, 0.75, 0.25, 1.0], np.float32), np.array([0.85, 0.15, 0.15, 1.0], np.float32)
OBJECT_RADIUS = 0.35  # m; they are caught from 1 m away
WALL, WALL_HALF_WIDTH = np.array([0.25, 0.42, 0.68, 1.0]), 0.8  # m; the real ones cross the whole track
RAY_RADIUS = 0.035  # m
SKY = (250, 250, 252)  # where nothing is
LINE, LINE_REACH, LINE_HALF_WIDTH = np.array([0.72, 0.74, 0.77, 1.0], np.float32), 16, 0.012  # m; every metre
LINE_HEIGHT = 0.004  # m; the floor's own surface would flicker through
SHADOW_PIXELS = 1024  # a side of the shadow map; MuJoCo's 4096 take most of the time where a CPU draws
ARENA = 6.5  # m from the middle to the walls


class Scene(Protocol):
    """What of a RobotTaskEnv is drawn."""

    physics: Any
    task: Any
    robot: Any


class NoOpenGL(RuntimeError):
    """There is nothing here that can draw; the message says what to install."""


def open_gl() -> str:
    """The name of the first OpenGL back end that works without a display: egl or osmesa.

    Raises:
        NoOpenGL: neither does.
    """
    wanted = os.environ.get("MUJOCO_GL")
    with_display = "DISPLAY" in os.environ or "WAYLAND_DISPLAY" in os.environ
    valid = ["egl", "osmesa", *(["glfw"] if with_display else [])]  # without one, glfw ends the process
    for name in [name for name in valid if name == (wanted or name)]:
        try:
            context = importlib.import_module(f"mujoco.{name}").GLContext(64, 64)
        except (ImportError, AttributeError, RuntimeError, OSError):
            continue
        context.free()
        return str(name)
    raise NoOpenGL(f"no OpenGL to draw with (MUJOCO_GL={wanted or 'egl, then osmesa'}): run `make install-render`")


class Renderer:
    """Frames of one simulation at a time, off screen.

    Args:
        context: an OpenGL context to draw in instead of one of its own.
    """

    def __init__(self, envs: Scene, width: int = 640, height: int = 480, context: Any = None) -> None:
        self.envs, self._model = envs, lit(envs.physics.model)
        model = self._model
        if context is None:
            context = importlib.import_module(f"mujoco.{open_gl()}").GLContext(width, height)
        self._context = context
        self._context.make_current()
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        self._scene = mujoco.MjvScene(model, maxgeom=1000)
        self._mujoco = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        self._option, self._rectangle = mujoco.MjvOption(), mujoco.MjrRect(0, 0, width, height)
        self.camera = mujoco.MjvCamera()
        aim(self.camera, envs)

    def frame(self, env: int) -> np.ndarray:
        """(H, W, 3) uint8 picture of simulation `env`."""
        data, model = self.envs.physics.data(env), self._model
        mujoco.mj_forward(model, data)
        follow(self.camera, self.envs, env)
        self._context.make_current()
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._mujoco)
        every = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(model, data, self._option, None, self.camera, every, self._scene)
        shade(self._scene, has_shadows=not isinstance(self.envs.task, Gather))  # rays would throw them too
        draw_floor(self._scene, self.envs, env)
        draw_task(self._scene, self.envs, env)
        mujoco.mjr_render(self._rectangle, self._scene, self._mujoco)
        image = np.empty((self._rectangle.height, self._rectangle.width, 3), np.uint8)
        depth = np.empty(image.shape[:2], np.float32)
        mujoco.mjr_readPixels(image, depth, self._rectangle, self._mujoco)
        image[depth == 1] = SKY
        return image[::-1].copy()

    def put(self, image: np.ndarray) -> None:
        """Draw a frame into the context's window."""
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_WINDOW, self._mujoco)
        mujoco.mjr_drawPixels(image[::-1].ravel(), None, self._rectangle, self._mujoco)

    def close(self) -> None:
        """Release the graphics memory."""
        self._context.make_current()
        self._mujoco.free()
        self._context.free()


def lit(model: mujoco.MjModel) -> mujoco.MjModel:
    """A copy for the eye: bright, with a floor that reaches the horizon and walls that do not hide what is behind."""
    bright = copy.deepcopy(model)
    bright.vis.headlight.ambient[:], bright.vis.headlight.diffuse[:] = 0.45, 0.25
    bright.vis.quality.shadowsize = SHADOW_PIXELS
    bright.geom("floor").size[:2] = 0  # drawn without end
    for i in range(bright.ngeom):
        if bright.geom(i).name.startswith("block_"):
            bright.geom(i).size[1], bright.geom(i).rgba[:] = WALL_HALF_WIDTH, WALL
    return bright


def aim(camera: mujoco.MjvCamera, envs: Scene) -> None:
    """From above where the task is in the plane, from the side along a track."""
    camera.type = mujoco.mjtCamera.mjCAMERA_FREE
    if isinstance(envs.task, Gather):
        camera.distance, camera.elevation, camera.azimuth = 20.0, -58.0, 90.0
    elif envs.robot.yaw is not None:
        camera.distance, camera.elevation, camera.azimuth = 6.0, -30.0, 90.0
    else:
        camera.distance, camera.elevation, camera.azimuth = 4.8, -16.0, 80.0


def follow(camera: mujoco.MjvCamera, envs: Scene, env: int) -> None:
    """Look at the robot, along a track a little ahead of it; in the arena at its middle, as long as the robot is there.

    The Snake passes through the arena's walls unless the task has them solid.
    """
    x, y = envs.physics.com[env, :2]
    if isinstance(envs.task, Gather):
        camera.lookat[:] = (x - np.clip(x, -ARENA, ARENA), y - np.clip(y, -ARENA, ARENA), 0.0)
    elif envs.robot.yaw is not None:
        camera.lookat[:] = (x, y, 0.3)
    else:
        camera.lookat[:] = (x + 1.0, y, 0.5)


def shade(scene: mujoco.MjvScene, has_shadows: bool) -> None:
    """A lamp from above and behind the camera's shoulder; shadows tell whether a foot stands on the floor."""
    light = scene.lights[scene.nlight]
    light.type, light.castshadow, light.headlight = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, has_shadows, 0
    light.dir[:] = np.array([0.25, 0.35, -0.9]) / np.linalg.norm([0.25, 0.35, -0.9])
    light.pos[:] = scene.camera[0].pos
    light.ambient[:], light.diffuse[:], light.specular[:] = 0.0, 0.45, 0.1
    scene.nlight += 1


def draw_floor(scene: mujoco.MjvScene, envs: Scene, env: int) -> None:
    """Lines across the floor at every whole metre where the camera follows the robot, so that it is seen to move."""
    if isinstance(envs.task, Gather):
        return
    floor = float(envs.physics.model.geom("floor").pos[2])
    middle = np.rint(envs.physics.com[env, :2])
    for axis in (0, 1):
        size = np.full(3, LINE_REACH, float)
        size[axis], size[2] = LINE_HALF_WIDTH, LINE_HEIGHT
        for offset in range(-LINE_REACH, LINE_REACH + 1):
            centre = np.array([*middle, floor])
            centre[axis] += offset
            _add_geom(scene, mujoco.mjtGeom.mjGEOM_BOX, size, centre, LINE)


def draw_task(scene: mujoco.MjvScene, envs: Scene, env: int) -> None:
    """Add to `scene` the objects that are left and, as thin rays, the lidar readings."""
    task = envs.task
    if not isinstance(task, Gather):
        return
    for k in np.flatnonzero(task.present[env]):
        x, y = task.objects[env, k]
        _add_object(scene, np.array([x, y, OBJECT_RADIUS]), is_apple=bool(k < NUM_APPLES))
    x, y = envs.physics.com[env, :2]
    yaw = float(envs.robot.yaw(envs.physics.qpos[env : env + 1])[0])
    readings = task.readings()[env]
    for k in np.flatnonzero(readings):
        angle = yaw - np.pi + (k % NUM_BINS + 0.5) * 2 * np.pi / NUM_BINS
        reach = (1 - readings[k]) * SENSOR_RANGE
        start, end = np.array([x, y, 0.3]), np.array([x + reach * np.cos(angle), y + reach * np.sin(angle), 0.3])
        _add_ray(scene, start, end, APPLE if k < NUM_BINS else BOMB)


def _add_object(scene: mujoco.MjvScene, centre: np.ndarray, is_apple: bool) -> None:
    """An apple is a green ball, a bomb a red cube."""
    kind, colour = (mujoco.mjtGeom.mjGEOM_SPHERE, APPLE) if is_apple else (mujoco.mjtGeom.mjGEOM_BOX, BOMB)
    size = np.full(3, OBJECT_RADIUS if is_apple else 0.8 * OBJECT_RADIUS)
    _add_geom(scene, kind, size, centre, colour)


def _add_geom(scene: mujoco.MjvScene, kind: int, size: np.ndarray, centre: np.ndarray, colour: np.ndarray) -> None:
    mujoco.mjv_initGeom(scene.geoms[scene.ngeom], kind, size, centre, np.eye(3).ravel(), colour)
    scene.ngeom += 1


def _add_ray(scene: mujoco.MjvScene, start: np.ndarray, end: np.ndarray, colour: np.ndarray) -> None:
    geom, kind = scene.geoms[scene.ngeom], mujoco.mjtGeom.mjGEOM_CAPSULE
    mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.zeros(9), colour)
    mujoco.mjv_connector(geom, kind, RAY_RADIUS, start, end)
    scene.ngeom += 1
