"""Config fields that carry their meaning, their source and their valid range.

A field says what it is, what the paper says, what the authors' code does, and why ours differs where it does. The
hyper-parameter ledger (docs/hyperparameters.csv) is generated from exactly this.
"""

import dataclasses
import math
from typing import Any

# Upper bounds of what memory is asked for, far above anything that is trained here.
MOST_STEPS, MOST_SKILLS, WIDEST = 10_000_000, 1000, 10_000  # of a batch or a buffer; of a policy; units of a layer


class ConfigError(ValueError):
    """A setting has a value that cannot work; the message names the key, the value and the valid choices."""

    def __init__(self, key: str, value: object, valid: str) -> None:
        self.key, self.value, self.valid = key, value, valid
        super().__init__(f"{key}={value}: {valid}")


def setting(
    default: Any,
    doc: str,
    *,
    paper: str | None = None,
    code: str | None = None,
    ours: str | None = None,
    low: float | None = None,
    high: float | None = None,
    above: float | None = None,
    choices: tuple[Any, ...] | None = None,
) -> Any:
    """A dataclass field with documentation and range.

    Args:
        default: the value used when nothing else is said; `dataclasses.MISSING` makes the field required.
        doc: meaning, unit and the paper's symbol.
        paper: what the paper says and where.
        code: what the authors' code does and where.
        ours: why we chose it, where neither of the two decides.
        low, high: inclusive bounds. above: exclusive lower bound. choices: the only valid values.
    """
    metadata = {
        "doc": doc,
        "paper": paper,
        "code": code,
        "ours": ours,
        "low": low,
        "high": high,
        "above": above,
        "choices": choices,
    }
    if default is dataclasses.MISSING:
        return dataclasses.field(metadata=metadata)
    if isinstance(default, list):
        return dataclasses.field(default_factory=lambda: list(default), metadata=metadata)
    return dataclasses.field(default=default, metadata=metadata)


def check(config: Any) -> None:
    """Raise ConfigError for the first field of the dataclass `config` that lies outside its declared range."""
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if isinstance(value, list) and not value:
            raise ConfigError(field.name, "[]", "must not be empty")
        for element in value if isinstance(value, list | tuple) else [value]:
            _check_value(field.name, element, field.metadata)


def _check_value(key: str, value: Any, declared: Any) -> None:
    choices = declared.get("choices")
    if choices is not None and value not in choices:
        raise ConfigError(key, value, f"must be one of {', '.join(map(str, choices))}")
    if isinstance(value, bool) or not isinstance(value, int | float):
        return
    if not math.isfinite(value):
        raise ConfigError(key, value, "must be finite")
    low, high, above = declared.get("low"), declared.get("high"), declared.get("above")
    if low is not None and value < low:
        raise ConfigError(key, value, f"must be at least {low}")
    if above is not None and value <= above:
        raise ConfigError(key, value, f"must be greater than {above}")
    if high is not None and value > high:
        raise ConfigError(key, value, f"must be at most {high}")
