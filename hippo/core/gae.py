"""Generalised advantage estimation over (T, N) arrays of steps (Schulman et al. 2016, equation 16)."""

import torch
from torch import Tensor


def gae(
    reward: Tensor,
    value: Tensor,
    next_value: Tensor,
    terminated: Tensor,
    done: Tensor,
    gamma: float | Tensor,
    lam: float,
) -> Tensor:
    """Advantages A_t = sum_l (gamma lam)^l delta_{t+l} with delta_t = r_t + gamma V(s_{t+1}) - V(s_t).

    Args:
        reward: (T, N) rewards.
        value: (T, N) V(s_t).
        next_value: (T, N) V of the state that followed step t, before any reset; read only where not terminated.
        terminated: (T, N) bool; nothing follows the step, so it bootstraps nothing. The paper's MDP has a finite
            horizon, so on-policy learners pass its end here as well.
        done: (T, N) bool; the episode ended or was cut after the step, so the lambda sum stops there. A step that is
            cut but not terminated bootstraps `next_value`. The last row is always an end.
        gamma: discount per step, a number or a (T, N) tensor. lam: GAE lambda; 1 gives discounted return minus value.

    Returns:
        (T, N) advantages.
    """
    shape = reward.shape
    if not (shape == value.shape == next_value.shape == terminated.shape == done.shape) or reward.dim() != 2:
        raise ValueError("gae: reward, value, next_value, terminated and done must share one shape (T, N)")
    # where, not a product: what follows a terminated step may be anything, NaN included
    delta = reward + gamma * next_value.masked_fill(terminated, 0.0) - value
    decay = (gamma * lam) * (~(done | terminated)).to(delta.dtype)
    rows, factor = delta.numpy(), decay.numpy()  # the same memory; a loop over numpy rows is five times as fast
    for t in range(shape[0] - 2, -1, -1):
        rows[t] += factor[t] * rows[t + 1]
    return delta


def segment_gae(
    reward: Tensor,
    value: Tensor,
    next_value: Tensor,
    terminated: Tensor,
    done: Tensor,
    is_decision: Tensor,
    gamma: float,
    lam: float,
    discount_inside: bool = True,
) -> Tensor:
    """GAE in which one step is a whole segment, from a decision to the next decision or the episode's end.

    With `discount_inside` this is the semi-Markov estimator (Sutton, Precup and Singh 1999): rewards inside a segment
    are discounted per environment step and what follows a segment of p steps by gamma^p. Without it, rewards inside a
    segment are summed as they are and gamma applies once per segment, as in the authors' action-repeat wrapper.

    Args: as `gae`, and is_decision, (T, N) bool: a new segment starts here. Every episode starts with a decision.

    Returns:
        (T, N) advantages at decision steps, zero elsewhere.
    """
    if not bool(is_decision[0].all()):
        raise ValueError("segment_gae: the first row must be a decision in every column")
    segment = is_decision.long().cumsum(0) - 1  # (T, N) row of the segment each step belongs to
    num_segments, num_envs = int(segment.max()) + 1, reward.shape[1]
    step = torch.arange(reward.shape[0]).unsqueeze(1).expand_as(segment)
    start = torch.zeros(num_segments, num_envs, dtype=torch.long)
    start.scatter_reduce_(0, segment, step, "amin", include_self=False)
    last = torch.zeros_like(start).scatter_reduce_(0, segment, step, "amax", include_self=False)
    inside = gamma ** (step - start.gather(0, segment)).to(reward.dtype) if discount_inside else 1.0
    segment_reward = torch.zeros(num_segments, num_envs, dtype=reward.dtype).scatter_add_(0, segment, inside * reward)
    discount = (
        gamma ** (last - start + 1).to(reward.dtype) if discount_inside else torch.full_like(segment_reward, gamma)
    )
    # Columns with fewer segments are padded at their end; the last real row is an end, so padding reaches nothing.
    padding = torch.arange(num_segments).unsqueeze(1) > segment[-1]
    end_of_column = torch.arange(num_segments).unsqueeze(1) == segment[-1]
    advantage = gae(
        segment_reward,
        value.gather(0, start),
        next_value.gather(0, last),
        terminated.gather(0, last) | padding,
        done.gather(0, last) | end_of_column,
        discount,
        lam,
    )
    return torch.where(is_decision, advantage.gather(0, segment), torch.zeros_like(reward))
