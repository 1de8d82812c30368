"""Golden trajectories: 200 steps of every environment, as text; a change of them needs a new revision.

python -m tests.envs.test_env_golden    # rewrites them
"""

import json

import mujoco
import numpy as np
import pytest

from hippo.envs import ENVIRONMENTS, make
from tests import ROOT

FOLDER = ROOT / "tests/golden/envs"
STEPS = 200


def trajectory(name):
    """Rewards, ends and every tenth observation of one environment under fixed actions."""
    envs = make(name, 1, 0, horizon=150)
    rng = np.random.default_rng(7)
    rows = [[float(x) for x in envs.reset(seed=11)[0][0]]]
    rewards, ends = [], []
    for step in range(STEPS):
        obs, reward, terminated, truncated, _ = envs.step(0.7 * rng.uniform(-1, 1, envs.action_space.shape))
        rewards.append(float(reward[0]))
        ends.append(int(terminated[0]) + 2 * int(truncated[0]))
        if step % 10 == 9:
            rows.append([float(x) for x in obs[0]])
    return {"observations": rows, "rewards": rewards, "ends": ends}


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_a_trajectory_is_as_it_was_or_the_revision_is_new(name):
    golden = json.loads((FOLDER / f"{name}.json").read_text())
    assert golden["revision"] == ENVIRONMENTS[name].revision, "rewrite the golden trajectories"
    assert golden["mujoco"] == mujoco.__version__, "golden trajectories are for another MuJoCo"
    now = trajectory(name)
    for key, values in now.items():
        # Observations are in single precision: where another libm's 1e-16 crosses a boundary, their last bit turns.
        last_bit = np.finfo(np.float32).eps if key == "observations" else 0
        np.testing.assert_allclose(values, golden[key], rtol=last_bit, atol=1e-9, err_msg=key)


if __name__ == "__main__":
    FOLDER.mkdir(parents=True, exist_ok=True)
    for name, environment in ENVIRONMENTS.items():
        content = {"revision": environment.revision, "mujoco": mujoco.__version__, **trajectory(name)}
        (FOLDER / f"{name}.json").write_text(json.dumps(content, indent=1) + "\n")
        print(f"wrote {FOLDER / name}.json")
