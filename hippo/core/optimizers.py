"""Torch's optimizers without its compiler, which they import on first use: half a second in every process that trains.

What they compute is theirs to the bit; the methods are those under the decorators that talk to the compiler.
"""

import inspect
from collections.abc import Callable
from typing import Any

import torch


def _plain(method: Callable[..., Any]) -> Any:
    """A method as it is written, without gradients, which the decorators would switch off."""
    return torch.no_grad()(inspect.unwrap(method))


class _Uncompiled:
    add_param_group = _plain(torch.optim.Optimizer.add_param_group)
    zero_grad = _plain(torch.optim.Optimizer.zero_grad)
    state_dict = _plain(torch.optim.Optimizer.state_dict)
    load_state_dict = _plain(torch.optim.Optimizer.load_state_dict)


class Adam(_Uncompiled, torch.optim.Adam):
    """torch.optim.Adam."""

    step = _plain(torch.optim.Adam.step)


class LBFGS(_Uncompiled, torch.optim.LBFGS):
    """torch.optim.LBFGS."""
