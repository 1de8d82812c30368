"""RobotTaskEnv: N copies of one robot on one task behind Gymnasium's vector interface, stepped as one batch.

What a step does around the physics, here and in the tasks, are kernels compiled by numba: plain loops that write into
arrays they are given. numpy needs a hundred calls for it, each of them slow while the caches hold MuJoCo's data. Sines,
cosines and matrix products are left to numpy, so that results have the bits that they had before there were kernels.
"""

from typing import Any

import gymnasium as gym
import mujoco
import numba
import numpy as np
from gymnasium.vector import AutoresetMode

from hippo.envs.arguments import natural, real, reset_ids, seeds
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
    """A vector environment in one of Gymnasium's three modes of autoreset.

    SAME_STEP: when an episode ends in a step, the observation returned is the next episode's first, and the last one of
    the ended episode is in `info["final_obs"]` (rows where `info["_final_obs"]`). NEXT_STEP: the step returns the last
    one, and the next step begins the next episode, whatever the action, for no reward. DISABLED: the caller begins it,
    with `reset(options={"reset_mask": ended})`.

    `terminated` is the task's end, `truncated` the horizon or a diverged simulation (`info["diverged"]`: reward 0, its
    last observation the last finite one). The reward's terms are in `info` under their names.

    It can be pickled and copied; the copy continues bit-identically.

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
        autoreset: AutoresetMode = AutoresetMode.SAME_STEP,
    ) -> None:
        self.num_envs, self.horizon, self.revision, self.options = num_envs, horizon, revision, options
        self.num_threads, self.autoreset = num_threads, autoreset
        self.robot, self.task = robot, task_class(robot, options, num_envs)
        spec = robot.spec(options.physics)
        self.task.build(spec)
        if options.perturbation is not None:
            perturb(spec, robot.name, options.perturbation, options.strength)
        model = spec.compile()
        timing, centre = robot.timing(options.physics), None
        fps = round(1 / (timing.timestep * timing.frame_skip))
        self.metadata = {"render_modes": list(RENDER_MODES), "render_fps": fps, "autoreset_mode": autoreset}
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
        self._layout_seeds: list[int | None] = [None] * num_envs
        self._started = False
        self._waiting = np.zeros(0, np.int64)  # environments whose next episode begins with the next step: NEXT_STEP
        self._rngs = [np.random.Generator(np.random.PCG64(s)) for s in seeds(seed, num_envs)]

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

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Start new episodes, everywhere unless a mask says where.

        Args:
            seed: restarts the generators: environment i's with `seed + i`, or with item i of `seed` (N,) unless that is
                None. None goes on with them.
            options: `layout_seed`, an integer that fixes object positions or wall heights of this and all later
                episodes of the environments reset (the pose stays random), or None to make them random again;
                `reset_mask` (N,) of bools, the environments to reset, the others stay as they are.
        """
        self.check_open()
        options = options or {}
        unknown = set(options) - {"layout_seed", "reset_mask"}
        if unknown:
            raise ValueError(f"reset option {sorted(unknown)[0]}: must be layout_seed or reset_mask")
        new_seeds = [None] * self.num_envs if seed is None else seeds(seed, self.num_envs)
        layout_seed = natural("layout_seed", options.get("layout_seed"), may_be_none=True)
        ids = np.arange(self.num_envs)
        if options.get("reset_mask") is not None:
            ids = reset_ids(options["reset_mask"], self.num_envs)
        if not (self._started or len(ids) == self.num_envs):
            raise gym.error.ResetNeeded("reset_mask before the first reset: call reset() without it first")
        for i in ids:
            if "layout_seed" in options:
                self._layout_seeds[i] = layout_seed
            if new_seeds[i] is not None:
                self._rngs[i] = np.random.Generator(np.random.PCG64(new_seeds[i]))
        self._started = True
        self._waiting = np.setdiff1d(self._waiting, ids)
        self._new_episodes(ids)
        self._obs[ids] = self._observe()[ids]
        return self._obs.copy(), {"diverged": np.zeros(self.num_envs, bool)}

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One control step of every environment; actions (N, A) are clipped to [-1, 1] and mapped to the controls."""
        self.check_open()
        if not self._started:
            raise gym.error.ResetNeeded("step() before reset(): call reset() first")
        actions = real(actions)
        if actions.shape != self.action_space.shape:
            raise ValueError(f"actions have shape {actions.shape}; expected {self.action_space.shape}")
        wrong = _control(actions, self._middle, self._half, self.physics.ctrl)
        if wrong:
            raise ValueError(f"actions hold {wrong} non-finite numbers")
        com_before, beginning = self.com.copy(), self._waiting
        self.physics.step()
        if len(beginning):  # they were stepped without being asked; the task must not read where that led
            self.physics.reset(beginning, self._qpos, np.zeros_like(self.physics.qvel[beginning]))
            self.physics.forward(beginning)

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
        if len(beginning):
            self._new_episodes(beginning)
            self._clock[beginning] = -1  # the step of the reset is none of the episode
            com[beginning], obs[beginning] = self.com[beginning], self._observe()[beginning]
            for array in (reward, terminated, *info.values()):
                array[beginning] = 0
        any_ended = _truncate(self._clock, self.horizon, terminated, diverged, truncated)
        info |= {"diverged": diverged, "com": com}
        if self.autoreset is AutoresetMode.NEXT_STEP:
            self._waiting = np.flatnonzero(terminated | truncated)
        elif any_ended and self.autoreset is AutoresetMode.SAME_STEP:
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
        fixed = self._layout_seeds
        self.task.reset(ids, [self._rngs[i] if fixed[i] is None else np.random.default_rng(fixed[i]) for i in ids])
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
            "layout_seeds": [-1 if seed is None else seed for seed in self._layout_seeds],
            "started": int(self._started),
            "waiting": self._waiting.copy(),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Continue from what `get_state` returned, here or in another process."""
        self.check_open()
        self._restore(state)

    def _restore(self, state: dict[str, Any]) -> None:
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
        self._layout_seeds = [None if seed < 0 else int(seed) for seed in state["layout_seeds"]]
        self._started, self._waiting = bool(state["started"]), np.array(state["waiting"])
        self.physics.set_state(state["physics"])

    def __reduce__(self) -> tuple:
        """How it is pickled and copied: built anew, then given its state."""
        first = (self.robot, type(self.task), self.options, self.num_envs, 0)
        arguments = (*first, self.horizon, self.revision, self.num_threads, self.autoreset)
        attributes = {name: value for name, value in vars(self).items() if name not in ("physics", "task")}
        return type(self), arguments, (attributes, self.get_state())

    def __setstate__(self, state: tuple[dict[str, Any], dict[str, Any]]) -> None:
        attributes, simulation = state
        vars(self).update(attributes)
        self._restore(simulation)

    def check_open(self) -> None:
        """Raise ClosedEnvironmentError after `close`."""
        if self.closed:
            raise gym.error.ClosedEnvironmentError("this environment is closed")
