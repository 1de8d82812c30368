"""BatchPhysics: many simulations of one compiled model, a thin adapter over mujoco.batch.Batch."""

import mujoco
import numba
import numpy as np
from mujoco.batch import Batch

from hippo.envs.mass_centre import MassCentre

MAX_SPEED = 1e4  # |qvel| beyond this, in m/s or rad/s, is a diverged simulation (ours)


@numba.njit(cache=True, error_model="numpy")
def _diverged(qpos: np.ndarray, qvel: np.ndarray, out: np.ndarray) -> bool:
    """Write to out (N,) which of qpos (N, nq) are not finite or qvel (N, nv) beyond MAX_SPEED, and return if any is."""
    any_diverged = False
    for i in range(len(out)):
        fine = True
        for j in range(qpos.shape[1]):
            fine &= np.isfinite(qpos[i, j])
        for j in range(qvel.shape[1]):
            fine &= abs(qvel[i, j]) <= MAX_SPEED  # NaN compares false
        out[i] = not fine
        any_diverged |= not fine
    return any_diverged


class BatchPhysics:
    """N simulations stepped together, bit-identical to a plain `mj_step` loop at any number of threads.

    `qpos` (N, nq), `qvel` (N, nv), `ctrl` (N, nu) and, with mocap bodies, `mocap_pos` (N, nmocap, 3) are live views of
    the simulations' states. `com` (N, 3) is the whole robot's centre of mass in the *new* state after `step` and
    `forward`, and so are the derived fields bound with `bind`, unless `mass_centre` is given.

    Args:
        mass_centre: computes the centre of mass from qpos, so that nothing is asked of MuJoCo after a step.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        num_envs: int,
        frame_skip: int,
        num_threads: int = 1,
        mass_centre: MassCentre | None = None,
    ) -> None:
        # MuJoCo would reset a diverged simulation silently.
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self.model, self.num_envs, self.frame_skip = model, num_envs, frame_skip
        self._mass_centre = mass_centre
        stage = mujoco.mjtStage.mjSTAGE_VEL if mass_centre is None else mujoco.mjtStage.mjSTAGE_NONE
        self._stage = stage.value
        # A persistent batch goes on from the stages computed at the new state, so asking for them costs nothing (but
        # with RK4 it does, see mass_centre.py).
        self._batch = Batch(model, num_envs, num_threads, persistent=mass_centre is None)
        self.qpos, self.qvel = self._batch.bind("qpos"), self._batch.bind("qvel")
        self.ctrl, self.mocap_pos = self._batch.bind("ctrl"), self._batch.bind("mocap_pos")
        self.com, self._subtree_com = np.zeros((num_envs, 3)), self._batch.bind("subtree_com")[:, 1]
        self._initial = np.zeros(self._batch.nstate)
        self._batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
        self._initial[:] = self._batch.state[0]

    def bind(self, field: str) -> np.ndarray:
        """A live, read-only (N, ...) view of an MjData field that position or velocity determine."""
        return self._batch.bind(field)

    def step(self) -> None:
        """Advance every simulation by one control step of `frame_skip` physics steps."""
        self._batch.step(nstep=self.frame_skip, stage=self._stage)
        self._update_com()

    def reset(self, ids: np.ndarray, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """Put simulations `ids` (n,) into the model's initial state, but at `qpos` (n, nq) and `qvel` (n, nv)."""
        self._batch.state[ids] = self._initial
        self.qpos[ids], self.qvel[ids] = qpos, qvel

    def forward(self, ids: np.ndarray) -> None:
        """Compute the derived fields of simulations `ids` (n,) after their state was written."""
        self._batch.forward(ids, stage=mujoco.mjtStage.mjSTAGE_VEL)
        self._update_com()

    def _update_com(self) -> None:
        if self._mass_centre is None:
            np.copyto(self.com, self._subtree_com)
        else:
            self._mass_centre(self.qpos, out=self.com)

    def diverged(self, out: np.ndarray) -> bool:
        """Whether a simulation has a position or velocity that is not finite or a velocity beyond MAX_SPEED.

        Which ones is written to out (N,) bool.
        """
        return bool(_diverged(self.qpos, self.qvel, out))

    def get_state(self) -> np.ndarray:
        """(N, mj_stateSize(mjSTATE_INTEGRATION)) everything that the continuation depends on, warm start included."""
        return self._batch.state.copy()

    def set_state(self, state: np.ndarray) -> None:
        """Continue bit-identically from what `get_state` returned."""
        self._batch.state[:] = state
        self.forward(np.arange(self.num_envs))

    def data(self, env: int) -> mujoco.MjData:
        """An MjData of one simulation, e.g. to render it."""
        return self._batch.get_data(env)
