"""GAE and segment GAE against numbers worked by hand and against the definition written out as nested loops."""

import pytest
import torch

from hippo.core.gae import gae, segment_gae


def column(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64).unsqueeze(1)


def flags(*values: int) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.bool).unsqueeze(1)


def reference(reward, value, next_value, terminated, done, gamma, lam):
    """The definition, one sum per step."""
    T, N = reward.shape
    out = torch.zeros(T, N, dtype=torch.float64)
    for n in range(N):
        for t in range(T):
            weight = 1.0
            for k in range(t, T):
                follow = 0.0 if terminated[k, n] else float(next_value[k, n])
                out[t, n] += weight * (float(reward[k, n]) + gamma * follow - float(value[k, n]))
                if done[k, n] or terminated[k, n]:
                    break
                weight *= gamma * lam
    return out


def test_gae_of_three_steps_worked_by_hand():
    # gamma 0.5, lambda 0.5, V = (1, 2, 3), next V = (2, 3, 4), the batch cuts after the last step:
    # delta = (1 + 1 - 1, 2 + 1.5 - 2, 3 + 2 - 3) = (1, 1.5, 2)
    # A2 = 2, A1 = 1.5 + 0.25 * 2 = 2, A0 = 1 + 0.25 * 2 = 1.5
    advantage = gae(
        column(1, 2, 3), column(1, 2, 3), column(2, 3, 4), flags(0, 0, 0), flags(0, 0, 0), gamma=0.5, lam=0.5
    )
    assert advantage.squeeze().tolist() == [1.5, 2.0, 2.0]


def test_a_cut_bootstraps_but_termination_does_not():
    # One step, r = 1, V = 1, next V = 4, gamma 0.5: cut 1 + 2 - 1 = 2, terminated 1 - 1 = 0.
    cut = gae(column(1), column(1), column(4), flags(0), flags(1), 0.5, 0.9)
    end = gae(column(1), column(1), column(4), flags(1), flags(1), 0.5, 0.9)
    assert (cut.item(), end.item()) == (2.0, 0.0)


def test_nothing_flows_back_over_an_episodes_end():
    # An end after step 0; the reward of 100 belongs to the next episode.
    for terminated in (0, 1):
        advantage = gae(
            column(1, 100), column(0, 0), column(0, 0), flags(terminated, 1), flags(1, 1), gamma=0.9, lam=1.0
        )
        assert advantage[0].item() == 1.0


def test_what_follows_a_terminated_step_may_be_nan():
    advantage = gae(column(1), column(0), column(float("nan")), flags(1), flags(1), 0.9, 1.0)
    assert advantage.item() == 1.0


def test_gae_equals_its_definition_on_random_patterns():
    g = torch.Generator().manual_seed(0)
    reward, value, next_value = torch.randn(3, 30, 4, generator=g, dtype=torch.float64)
    done = torch.rand(30, 4, generator=g) < 0.2
    terminated = done & (torch.rand(30, 4, generator=g) < 0.5)
    for gamma, lam in ((0.999, 1.0), (0.9, 0.7), (1.0, 0.0)):
        expected = reference(reward, value, next_value, terminated, done, gamma, lam)
        torch.testing.assert_close(
            gae(reward, value, next_value, terminated, done, gamma, lam), expected, rtol=0, atol=1e-12
        )
        wrong = gae(reward, value, next_value, done, done, gamma, lam)  # treats a cut as an end
        assert (wrong - expected).abs().max() > 0.1


def test_lambda_one_is_discounted_return_minus_value():
    g = torch.Generator().manual_seed(1)
    reward, value = torch.randn(2, 10, 1, generator=g, dtype=torch.float64)
    terminated = torch.zeros(10, 1, dtype=torch.bool)
    terminated[-1] = True
    advantage = gae(reward, value, value, terminated, terminated, 0.9, 1.0)
    discounted = sum(0.9**t * float(reward[t]) for t in range(10))
    # With next_value = value of the *same* row the telescoping fails, so use the shifted one.
    shifted = torch.cat([value[1:], torch.zeros(1, 1, dtype=torch.float64)])
    assert advantage[0].item() != pytest.approx(discounted - value[0].item(), abs=1e-9)
    advantage = gae(reward, value, shifted, terminated, terminated, 0.9, 1.0)
    assert advantage[0].item() == pytest.approx(discounted - value[0].item(), abs=1e-12)


def test_shapes_must_agree():
    with pytest.raises(ValueError, match="one shape"):
        gae(column(1, 2), column(1), column(1, 2), flags(0, 1), flags(0, 1), 0.9, 1.0)


def test_segments_of_two_steps_worked_by_hand():
    # Decisions at steps 0 and 2, rewards 1, 2, 4, 8, V = 10 at 0 and 20 at 2, next V after the last step 16, a cut.
    # Semi-Markov, gamma 0.5: R0 = 1 + 0.5 * 2 = 2, R1 = 4 + 0.5 * 8 = 8, discount 0.25 each.
    #   delta1 = 8 + 0.25 * 16 - 20 = -8;  delta0 = 2 + 0.25 * 20 - 10 = -3;  lambda 1: A0 = -3 + 0.25 * -8 = -5
    # Held actions (macro gamma 0.5): R0 = 3, R1 = 12; delta1 = 12 + 8 - 20 = 0; delta0 = 3 + 10 - 10 = 3; A0 = 3
    reward, value, following = column(1, 2, 4, 8), column(10, 0, 20, 0), column(0, 20, 0, 16)
    nowhere, decisions = flags(0, 0, 0, 0), flags(1, 0, 1, 0)
    smdp = segment_gae(reward, value, following, nowhere, nowhere, decisions, 0.5, 1.0)
    held = segment_gae(reward, value, following, nowhere, nowhere, decisions, 0.5, 1.0, discount_inside=False)
    assert smdp.squeeze().tolist() == [-5.0, 0.0, -8.0, 0.0]
    assert held.squeeze().tolist() == [3.0, 0.0, 0.0, 0.0]


def test_segments_of_one_step_are_ordinary_gae():
    g = torch.Generator().manual_seed(2)
    reward, value, next_value = torch.randn(3, 12, 3, generator=g, dtype=torch.float64)
    done = torch.rand(12, 3, generator=g) < 0.3
    everywhere = torch.ones_like(done)
    plain = gae(reward, value, next_value, done, done, 0.9, 0.8)
    for inside in (True, False):
        segments = segment_gae(reward, value, next_value, done, done, everywhere, 0.9, 0.8, discount_inside=inside)
        torch.testing.assert_close(segments, plain, rtol=0, atol=1e-12)


def test_semi_markov_and_per_step_advantages_agree_at_decisions_for_lambda_one_only():
    g = torch.Generator().manual_seed(3)
    reward, value = torch.randn(2, 20, 5, generator=g, dtype=torch.float64)
    next_value = torch.cat([value[1:], torch.randn(1, 5, generator=g, dtype=torch.float64)])
    done = torch.rand(20, 5, generator=g) < 0.1
    decision = torch.rand(20, 5, generator=g) < 0.3
    decision[0] = True
    decision[1:] |= done[:-1]
    for lam, equal in ((1.0, True), (0.5, False)):
        step = gae(reward, value, next_value, done, done, 0.99, lam)[decision]
        smdp = segment_gae(reward, value, next_value, done, done, decision, 0.99, lam)[decision]
        assert torch.allclose(step, smdp, rtol=0, atol=1e-10) is equal
