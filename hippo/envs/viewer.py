"""A window that shows one simulation in the colours and at the pace of the frames.

It draws in the caller's own thread. MuJoCo's viewer has a thread of its own, which is still drawing when Python frees
what it draws: it crashes where a program ends soon after it closed the window.
"""

import time
import warnings
import weakref
from typing import Any

import glfw

from hippo.envs.rendering import NoOpenGL, Renderer, Scene

WIDTH, HEIGHT = 640, 480


class Window:
    """A GLFW window as the OpenGL context of a Renderer.

    Raises:
        NoOpenGL: there is no display, or none that OpenGL can draw on.
    """

    def __init__(self) -> None:
        with warnings.catch_warnings():  # GLFW's own words for what is raised below
            warnings.simplefilter("ignore", glfw.GLFWError)
            if not glfw.init():
                raise NoOpenGL("render_mode=human needs a display; use rgb_array, or `make video RUN=...`")
            glfw.window_hint(glfw.RESIZABLE, False)
            self.handle: Any = glfw.create_window(WIDTH, HEIGHT, "HiPPO", None, None)
        if not self.handle:
            raise NoOpenGL("render_mode=human needs a display that OpenGL can draw on; use rgb_array")
        self.size = glfw.get_framebuffer_size(self.handle)  # more than asked for where pixels are small

    def make_current(self) -> None:
        """Draw here from now on."""
        glfw.make_context_current(self.handle)

    def free(self) -> None:
        """Close the window."""
        glfw.destroy_window(self.handle)


class Viewer:
    """Shows a simulation of `envs`, `fps` pictures a second.

    Raises:
        NoOpenGL: there is no display, or none that OpenGL can draw on.
    """

    def __init__(self, envs: Scene, fps: int) -> None:
        self._window, self._seconds, self._next = Window(), 1 / fps, 0.0
        glfw.set_window_title(self._window.handle, envs.robot.name)
        self._renderer = Renderer(envs, *self._window.size, context=self._window)
        self.close = weakref.finalize(self, self._renderer.close)  # at the end of the program, too

    def show(self, env: int) -> None:
        """Show simulation `env` as it is now, when its time has come; nothing once the user has closed the window."""
        if not self.close.alive:
            return
        frame = self._renderer.frame(env)
        self._renderer.put(frame)
        time.sleep(max(self._next - time.perf_counter(), 0.0))
        self._next = max(self._next, time.perf_counter()) + self._seconds
        glfw.swap_buffers(self._window.handle)
        glfw.poll_events()
        if glfw.window_should_close(self._window.handle):
            self.close()
