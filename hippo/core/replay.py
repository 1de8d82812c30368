"""A bounded replay buffer of named columns, whose oldest rows make room for new ones."""

from typing import Any

import numpy as np
import torch
from torch import Tensor


class Replay:
    """Up to `size` rows; a row is one tensor per name in `shapes`. Memory is touched only as rows come in."""

    def __init__(self, size: int, **shapes: tuple[int, ...]) -> None:
        self.size, self.added = size, 0  # added: rows ever, of which the newest `size` are kept
        # numpy's: torch fills new memory, and so claims it, when algorithms are to be deterministic.
        dtype = torch.zeros(()).numpy().dtype
        self.columns = {name: torch.from_numpy(np.empty((size, *shape), dtype)) for name, shape in shapes.items()}

    def __len__(self) -> int:
        return min(self.added, self.size)

    def add(self, **rows: Tensor) -> None:
        """Append rows (B, ...) of every column."""
        assert rows.keys() == self.columns.keys()
        count = len(next(iter(rows.values())))
        where = (self.added + torch.arange(count)) % self.size
        for name, values in rows.items():
            self.columns[name][where] = values.to(self.columns[name].dtype)
        self.added += count

    def sample(self, count: int, generator: torch.Generator) -> dict[str, Tensor]:
        """`count` rows drawn uniformly with replacement, by name."""
        where = torch.randint(len(self), (count,), generator=generator)
        return {name: column[where] for name, column in self.columns.items()}

    def clear(self) -> None:
        """Forget all rows."""
        self.added = 0

    def state_dict(self) -> dict[str, Any]:
        """The rows that are there; copied, since a view would be saved with all of the memory behind it."""
        rows = {name: column[: len(self)].clone() for name, column in self.columns.items()}
        return {"added": self.added, "columns": rows}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over what `state_dict` returned for a buffer of the same size."""
        self.added = state["added"]
        for name, column in self.columns.items():
            column[: len(self)] = state["columns"][name]
