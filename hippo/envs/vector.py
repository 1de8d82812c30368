"""RobotTaskEnv: N copies of one robot on one task behind Gymnasium's vector interface, stepped as one batch.

What a step does around the physics, here and in the tasks, are kernels compiled by numba: plain loops that write into
arrays they are given. numpy needs a hundred calls for it, each of them slow while the caches hold MuJoCo's data. Sines,
cosines and matrix products are left to numpy, so that results have the bits that they had before there were kernels.
"""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import mujoco
import numba
import numpy as np

from hippo.envs.mass_centre import MassCentre
from hippo.envs.perturb import perturb
from hippo.envs.physics import BatchPhysics
from hippo.envs.robots import Robot

RENDER_MODES = ("rgb_array", "human")
POSE_NOISE, VELOCITY_NOISE = 0.01, 0.1  # std of the initial qpos and qvel around the model's (rllab)
RNG_WORDS = 6  # uint64 words that hold one PCG64 generator
SOURCES = ("qpos", "qvel", "com", "task")  # what observations are made of


@numba.njit(cache=True, error_model="numpy")
def _control(actions: np.ndarray, middle: np.ndarray, half: np.ndarray, ctrl: np.ndarray) -> int:
    """Write middle + half clip(actions, -1, 1) to ctrl (N, A) unless some actions (N, A) are not finite; how many."""
    N, A = actions.shape
    wrong = 0
    for i in range(N):
        for j in range(A):
            wrong += not np.isfinite(actions[i, j])
    if wrong == 0:
        for i in range(N):
            for j in range(A):
                ctrl[i, j] = middle[j] + half[j] * min(max(actions[i, j], -1.0), 1.0)
    return wrong


@numba.njit(cache=True, error_model="numpy")
def _truncate(
    clock: np.ndarray, horizon: int, terminated: np.ndarray, diverged: np.ndarray, truncated: np.ndarray
) -> bool:
    """Count a step in clock (N,); truncated (N,): diverged, or at the horizon and not terminated. Whether any ended."""
    ended = False
    for i in range(len(clock)):
        clock[i] += 1
        truncated[i] = diverged[i] or (clock[i] >= horizon and not terminated[i])
        ended |= terminated[i] or truncated[i]
    return ended


@numba.njit(cache=True, error_model="numpy")
def _fill(
    qpos: np.ndarray,
    qvel: np.ndarray,
    com: np.ndarray,
    task: np.ndarray,
    source: np.ndarray,
    column: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    out: np.ndarray,
) -> None:
    """out (N, D) float32: entry d is column[d] of SOURCES[source[d]], each (N, ...), within low[d] and high[d]."""
    for i in range(len(out)):
        for d in range(len(source)):
            if source[d] == 0:
                value = qpos[i, column[d]]
            elif source[d] == 1:
                value = qvel[i, column[d]]
            elif source[d] == 2:
                value = com[i, column[d]]
            else:
                value = task[i, column[d]]
            single = np.float32(value)
            if single < low[d]:  # NaN stays NaN
                single = low[d]
            elif single > high[d]:
                single = high[d]
            out[i, d] = single


class RobotTaskEnv(gym.vector.VectorEnv):
    """A vector environment with same-step autoreset.

    When an episode ends in a step, the observation returned is the next episode's first, and the last one of the ended
    episode is in `info["final_obs"]` (rows where `info["_final_obs"]`). `terminated` is the task's end, `truncated` the
    horizon or a diverged simulation (`info["diverged"]`: reward 0, `final_obs` its last finite observation). The
    reward's terms are in `info` under their names.

    Without `autoreset` an environment whose episode ended stays as it is until `reset`, and `info` has no final_*.

    Environment i draws from its own generator, seeded with `seed + i`, so it does not depend on its neighbours.
    """

    def __init__(
        self,
        robot: Robot,
        task_class: Any,
        options: Any,
        num_envs: int,
        seed: int,
        horizon: int,
        revision: int,
        num_threads: int = 1,
        autoreset: bool = True,
    ) -> None:
        self.num_envs, self.horizon, self.revision, self.options = num_envs, horizon, revision, options
        self.robot, self.task = robot, task_class(robot, options, num_envs)
        spec = robot.spec(options.physics)
        self.task.build(spec)
        if options.perturbation is not None:
            perturb(spec, robot.name, options.perturbation, options.strength)
        model = spec.compile()
        timing, centre = robot.timing(options.physics), None
        mode = gym.vector.AutoresetMode.SAME_STEP if autoreset else gym.vector.AutoresetMode.DISABLED
        fps = round(1 / (timing.timestep * timing.frame_skip))
        self.metadata = {"render_modes": list(RENDER_MODES), "render_fps": fps, "autoreset_mode": mode}
        slow = timing.integrator == mujoco.mjtIntegrator.mjINT_RK4 and not model.nsensor
        if robot.com_features is not None and slow and not self.task.pays_for_speed:
            centre = MassCentre(model, robot.com_features, is_free=model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE)
        self.physics = BatchPhysics(model, num_envs, timing.frame_skip, num_threads, centre)
        self.task.attach(self.physics)

        self.quantities = robot.observations[options.observation]
        entries = [
            (name, unit, -bound, bound)
            for q in self.quantities
            for name, unit, bound in zip(q.names, q.units, q.bound, strict=True)
        ]
        self.robot_size = len(entries)
        entries += self.task.entries
        columns = [(SOURCES.index(q.source), i) for q in self.quantities for i in q.index]
        columns += [(SOURCES.index("task"), i) for i in range(len(self.task.entries))]
        self._source, self._column = np.array(columns, np.int64).T.copy()
        self.observation_names = [name for name, *_ in entries]
        self.observation_units = [unit for _, unit, *_ in entries]
        self._low, self._high = (np.array([e[i] for e in entries], np.float32) for i in (2, 3))
        self.single_observation_space = gym.spaces.Box(self._low, self._high, dtype=np.float32)
        self.single_action_space = gym.spaces.Box(-1.0, 1.0, (model.nu,), np.float32)
        self.observation_space = gym.vector.utils.batch_space(self.single_observation_space, num_envs)
        self.action_space = gym.vector.utils.batch_space(self.single_action_space, num_envs)

        control_low, control_high = model.actuator_ctrlrange.T
        self._middle, self._half = (control_high + control_low) / 2, (control_high - control_low) / 2
        self._qpos = model.key_qpos[0].copy() if model.nkey else model.qpos0.copy()
        self._clock = np.zeros(num_envs, np.int64)
        self._obs = np.zeros((num_envs, len(entries)), np.float32)
        self.autoreset = autoreset
        self._layout_seed: int | None = None
        self._started = False
        self._seed(seed)

    @property
    def robot_name(self) -> str:
        """ant, snake, hopper or half_cheetah."""
        return self.robot.name

    @property
    def observation_variant(self) -> str:
        """Which of the robot's observations this is, "paper" or "ego"."""
        return self.options.observation

    @property
    def com(self) -> np.ndarray:
        """(N, 3) m, whole-robot centres of mass now; after a step, `info["com"]` has those before any autoreset."""
        return self.physics.com

    def _seed(self, seed: int | Sequence[int | None]) -> None:
        if isinstance(seed, Sequence):
            seeds = [_natural("seed", s, may_be_none=True) for s in seed]
        else:
            first = _natural("seed", seed)
            assert first is not None
            seeds = [first + i for i in range(self.num_envs)]
        if len(seeds) != self.num_envs:
            raise ValueError(f"seed={seed}: give one integer or {self.num_envs} of them")
        rngs = getattr(self, "_rngs", [None] * self.num_envs)
        self._rngs = [
            old if s is None and old is not None else np.random.Generator(np.random.PCG64(s))
            for s, old in zip(seeds, rngs, strict=True)
        ]

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start a new episode everywhere.

        Args:
            seed: restarts the generators; None goes on with them.
            options: `layout_seed`, an integer that fixes object positions or wall heights of this and all later
                episodes in every environment (the pose stays random), or None to make them random again.
        """
        self._check_open()
        unknown = set(options or {}) - {"layout_seed"}
        if unknown:
            raise ValueError(f"reset option {sorted(unknown)[0]}: the only one is layout_seed")
        if options is not None and "layout_seed" in options:
            self._layout_seed = _natural("layout_seed", options["layout_seed"], may_be_none=True)
        if seed is not None:
            self._seed(seed)
        self._started = True
        self._new_episodes(np.arange(self.num_envs))
        self._obs = self._observe()
        return self._obs.copy(), {"diverged": np.zeros(self.num_envs, bool)}

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One control step of every environment; actions (N, A) are clipped to [-1, 1] and mapped to the controls."""
        self._check_open()
        if not self._started:
            raise gym.error.ResetNeeded("step() before reset(): call reset() first")
        # One type and layout, whatever the caller's, since numba compiles for each.
        actions = np.array(actions, np.float64, order="C")
        if actions.shape != self.action_space.shape:
            raise ValueError(f"actions have shape {actions.shape}; expected {self.action_space.shape}")
        wrong = _control(actions, self._middle, self._half, self.physics.ctrl)
        if wrong:
            raise ValueError(f"actions hold {wrong} non-finite numbers")
        com_before = self.com.copy()
        self.physics.step()

        diverged, truncated = np.empty(self.num_envs, bool), np.empty(self.num_envs, bool)
        any_diverged = self.physics.diverged(diverged)
        if any_diverged:  # these simulations end here; the task must not read what is not finite
            self._pose(np.flatnonzero(diverged))
        reward, terminated, info = self.task.step()
        com, obs = self.com.copy(), self._observe()
        if any_diverged:
            reward, terminated = np.where(diverged, 0.0, reward), terminated & ~diverged
            info = {name: np.where(diverged, 0.0, term) for name, term in info.items()}
            com[diverged], obs[diverged] = com_before[diverged], self._obs[diverged]
        any_ended = _truncate(self._clock, self.horizon, terminated, diverged, truncated)
        info |= {"diverged": diverged, "com": com}
        if any_ended and self.autoreset:
            done = terminated | truncated
            info |= {
                "final_obs": obs.copy(),
                "_final_obs": done,
                "final_info": {name: term.copy() for name, term in info.items()},
                "_final_info": done,
            }
            self._new_episodes(np.flatnonzero(done))
            obs[done] = self._observe()[done]
        self._obs = obs
        return obs.copy(), reward, terminated, truncated, info

    def _pose(self, ids: np.ndarray) -> None:
        """Put the robots of simulations `ids` into their noisy initial pose."""
        model = self.physics.model
        qpos, qvel = np.empty((len(ids), model.nq)), np.empty((len(ids), model.nv))
        for row, i in enumerate(ids):
            qpos[row] = self._qpos + POSE_NOISE * self._rngs[i].standard_normal(model.nq)
            qvel[row] = VELOCITY_NOISE * self._rngs[i].standard_normal(model.nv)
        self.physics.reset(ids, qpos, qvel)
        self.physics.forward(ids)

    def _new_episodes(self, ids: np.ndarray) -> None:
        self._pose(ids)
        fixed = self._layout_seed
        self.task.reset(ids, [self._rngs[i] if fixed is None else np.random.default_rng(fixed) for i in ids])
        self._clock[ids] = 0

    def _observe(self) -> np.ndarray:
        """(N, D) float32 observation of the current state, within its bounds."""
        physics, obs = self.physics, np.empty(self._obs.shape, np.float32)
        columns, bounds = (self._source, self._column), (self._low, self._high)
        _fill(physics.qpos, physics.qvel, physics.com, self.task.observe(), *columns, *bounds, obs)
        return obs

    def get_state(self) -> dict[str, Any]:
        """Everything a bit-identical continuation needs, as arrays and integers."""
        rngs = np.zeros((self.num_envs, RNG_WORDS), np.uint64)
        for i, rng in enumerate(self._rngs):
            s: Any = rng.bit_generator.state
            words = [s["state"]["state"], s["state"]["inc"]]
            split = [w for value in words for w in (value >> 64, value & (2**64 - 1))]
            rngs[i] = [*split, s["has_uint32"], s["uinteger"]]
        return {
            "physics": self.physics.get_state(),
            "task": {name: array.copy() for name, array in self.task.state.items()},
            "clock": self._clock.copy(),
            "obs": self._obs.copy(),
            "rngs": rngs,
            "layout_seed": -1 if self._layout_seed is None else self._layout_seed,
            "started": int(self._started),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Continue from what `get_state` returned, here or in another process."""
        self._check_open()
        for name, array in self.task.state.items():
            array[:] = state["task"][name]
        self._clock[:], self._obs = state["clock"], np.array(state["obs"])
        for rng, row in zip(self._rngs, np.asarray(state["rngs"]).tolist(), strict=True):
            high, low, inc_high, inc_low, has_uint32, uinteger = row
            rng.bit_generator.state = {
                "bit_generator": "PCG64",
                "state": {"state": high << 64 | low, "inc": inc_high << 64 | inc_low},
                "has_uint32": has_uint32,
                "uinteger": uinteger,
            }
        self._layout_seed = None if state["layout_seed"] < 0 else int(state["layout_seed"])
        self._started = bool(state["started"])
        self.physics.set_state(state["physics"])

    def _check_open(self) -> None:
        if self.closed:
            raise gym.error.ClosedEnvironmentError("this environment is closed")


def _natural(name: str, value: Any, may_be_none: bool = False) -> int | None:
    """`value` if it is an integer of at least 0 (or None where that is allowed); a ValueError that names it if not."""
    if value is None and may_be_none:
        return None
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 0:
        raise ValueError(f"{name}={value}: must be an integer of at least 0{' or None' if may_be_none else ''}")
    return int(value)
