"""Statistics of the episodes in one (T, N) batch of steps."""

import numpy as np


def episode_statistics(reward: np.ndarray, done: np.ndarray) -> dict[str, float | int]:
    """Undiscounted returns and lengths of the episodes in a batch that starts with fresh episodes.

    Args:
        reward: (T, N) rewards. done: (T, N) bool, the episode ended with this step.

    Returns:
        `return_mean`, `return_std`, `return_min`, `return_max`, `length_mean` over the episodes that open the batch
        (one per column, run to their end), which weighs every column alike; `return_mean_all` and `episodes` over all
        completed episodes. Episodes cut by the end of the batch are in neither. NaN where no episode was completed.
    """
    returns, lengths, opening = [], [], []
    for column in range(reward.shape[1]):
        ends = np.flatnonzero(done[:, column])
        if len(ends) == 0:
            continue
        starts = np.concatenate([[0], ends[:-1] + 1])
        column_returns = np.add.reduceat(reward[: ends[-1] + 1, column], starts)
        returns.append(column_returns)
        lengths.append(ends[0] + 1)
        opening.append(column_returns[0])
    if not returns:
        nan = float("nan")
        return {
            "return_mean": nan,
            "return_std": nan,
            "return_min": nan,
            "return_max": nan,
            "length_mean": nan,
            "return_mean_all": nan,
            "episodes": 0,
        }
    everything = np.concatenate(returns)
    return {
        "return_mean": float(np.mean(opening)),
        "return_std": float(np.std(opening)),
        "return_min": float(np.min(opening)),
        "return_max": float(np.max(opening)),
        "length_mean": float(np.mean(lengths)),
        "return_mean_all": float(np.mean(everything)),
        "episodes": len(everything),
    }


def opening_episodes(reward: np.ndarray, done: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Undiscounted returns (N,) and lengths (N,) of the first episode in every column of a (T, N) batch.

    Raises:
        ValueError: an episode is not over by the end of the batch.
    """
    if not done.any(0).all():
        raise ValueError("an opening episode is not over by the end of the batch")
    length = done.argmax(0) + 1
    inside = np.arange(len(reward))[:, None] < length
    return (reward * inside).sum(0), length
