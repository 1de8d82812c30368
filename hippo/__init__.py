"""HiPPO: `hippo.load` a trained policy, `hippo.train` one, `hippo.HippoConfig` says how."""

from typing import Any

_PLACES = {
    "Agent": "hippo.agent",
    "AgentError": "hippo.agent",
    "HippoConfig": "hippo.hippo",
    "load": "hippo.agent",
    "train": "hippo.agent",
}
__all__ = list(_PLACES)


def __getattr__(name: str) -> Any:
    """Import what is asked for, so that environments can be used without the learning library."""
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import importlib

    return getattr(importlib.import_module(_PLACES[name]), name)
