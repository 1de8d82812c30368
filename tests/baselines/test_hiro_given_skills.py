"""HIRO from given skills: rows that agree with themselves where goals leave their box, what a correction shares."""

import pytest
import torch

from baselines import hiro
from baselines.hiro import HiroConfig
from hippo.core.goals import Memory
from hippo.core.td3 import Actor
from tests.hippo.toy import TargetEnv, given_skills

PERIOD, T, N = 5, 18, 3


def rows_of_cloning(tmp_path, half_range):
    """Both buffers' rows after one roll-out of given skills, and the goals' box."""
    given_skills(tmp_path / "skills.pt")
    settings = {"hidden_sizes": [16, 16], "minibatch_size": 20, "goal_space": "xy", "period": PERIOD}
    config = HiroConfig(
        iterations=1, batch_size=T, horizon=T, position_range=half_range, skills=str(tmp_path / "skills.pt"), **settings
    )
    agents = hiro.make_agents(config, envs := TargetEnv(N, 0, horizon=T, death_rate=0.05), 0)
    memory = Memory(1000, N, (PERIOD, 2, 2, 2))
    hiro.skill_rollouts(config, agents, memory, envs, 0)
    low = {name: column[: T * N].view(T, N, *column.shape[1:]) for name, column in memory.low.columns.items()}
    return low, {name: column[: memory.manager.added] for name, column in memory.manager.columns.items()}


@pytest.mark.parametrize("half_range", [10.0, 0.02])
def test_a_cloned_row_is_paid_for_the_goal_that_it_stores(tmp_path, half_range):
    low, decisions = rows_of_cloning(tmp_path, half_range)
    # r = -|S(s) + g - S(s')|, with the very g of the row.
    missed = low["obs"] + low["goal"] - low["next_obs"]
    torch.testing.assert_close(low["reward"], -missed.norm(dim=-1), rtol=0, atol=2e-5)
    largest = decisions["goal"].abs().amax(-1)
    assert bool((largest <= half_range + 1e-6).all())
    assert bool((largest > half_range - 1e-6).any()) == (half_range == 0.02)


def test_a_clipped_goal_is_carried_along_as_a_managers_would_be(tmp_path):
    low, _ = rows_of_cloning(tmp_path, 0.02)
    carried = new = 0
    remaining = low["obs"] + low["goal"] - low["next_obs"]
    for n in range(N):
        for t in range(T - 1):
            if torch.equal(low["obs"][t + 1, n], low["next_obs"][t, n]):  # no new episode in between
                torch.testing.assert_close(low["next_goal"][t, n], low["goal"][t + 1, n])
                same = torch.allclose(low["next_goal"][t, n], remaining[t, n], atol=1e-6)
                carried, new = carried + same, new + (not same)
    assert carried >= 2 * new > 0


def test_what_candidates_share_is_what_each_would_be_alone():
    generator = torch.Generator().manual_seed(0)
    B, c, D, k, M = 4, 3, 7, 2, 5
    actor = Actor(D, torch.tensor([1.0, 0.5, 2.0]), [16, 8], generator).double()
    x, shifts = (torch.randn(*shape, generator=generator).double() for shape in ((B, c, D), (B, M, k)))
    shared = list(actor.of_shifted(x, shifts))
    assert len(shared) == M
    for i in range(M):
        for b in range(B):
            for t in range(c):
                one = x[b, t].clone()
                one[-k:] += shifts[b, i]
                torch.testing.assert_close(shared[i][b, t], actor(one), rtol=0, atol=1e-12)
    first = x.clone()
    first[..., :k] += shifts[:, :1]  # the wrong entries
    assert not torch.allclose(shared[0], actor(first))
