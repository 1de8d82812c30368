"""Values of a sweep of one's own in Hydra's grammar: lists, choice(...), range(...), and their texts."""

import itertools
import json
import math
import re
from collections.abc import Iterator
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, Override, QuotedString, RangeSweep
from hydra.errors import HydraException

from experiments.config import PLAIN_TEXT
from experiments.plan import FIXED
from hippo.core.settings import ConfigError

UNASKED = 1000  # runs; more are not even looked at without --yes
MOST = 100_000


def text_of(value: Any) -> str:
    """A value of a yaml file in Hydra's grammar: a list is a choice, what stands as text is taken as it is."""
    if isinstance(value, list):
        return ",".join(item if isinstance(item, str) else json.dumps(item) for item in value)
    return value if isinstance(value, str) else json.dumps(value)


def values_of(text: str) -> tuple[str, list[str]]:
    """The key and the values of KEY=VALUE,VALUE or KEY=range(A,B[,STEP]), in Hydra's grammar, as overrides take them.

    Raises:
        ConfigError: no such grammar, a key that is the sweep's own business, no value, one twice, one not finite.
    """
    key, equals, given = text.partition("=")
    if not equals or not re.fullmatch(r"[\w.]+", key):
        raise ConfigError("over", text, "must be KEY=VALUE,VALUE,... as in algo.learning_rate=1e-4,3e-4")
    if key in FIXED and key not in ("env", "algo"):
        option = {"seed": "--seeds N trains seeds 0 to N - 1"}.get(key, f"a sweep has one (--{key.replace('_', '-')})")
        raise ConfigError(f"over {key}", given, option)
    try:
        (override,) = OverridesParser.create().parse_overrides([text])
        values = list(itertools.islice(elements(override), MOST + 1))
    except (HydraException, ValueError, ArithmeticError) as error:
        raise ConfigError(f"over {key}", given, str(error).splitlines()[0]) from error
    if not values:
        raise ConfigError(f"over {key}", given, "holds no value")
    for i, (value, _) in enumerate(values):
        if isinstance(value, float) and not math.isfinite(value):
            raise ConfigError(f"over {key}", value, "must be finite")
        if len(values) <= UNASKED and value in [other for other, _ in values[:i]]:
            raise ConfigError(f"over {key}", value, "is given twice")
    if key == "env.physics" and len(values) > 1:
        raise ConfigError(f"over {key}", given, "are never drawn together; make a sweep of each")
    if key in ("env", "algo", *PLAIN_TEXT):  # names, which no grammar is to read again
        return key, [value.text if isinstance(value, QuotedString) else str(value) for value, _ in values]
    return key, [text for _, text in values]


def elements(override: Override) -> Iterator[tuple[Any, str]]:
    """The values of an override, one after another, each with its text in Hydra's grammar."""
    value = override.value()
    if override.is_add() or override.is_delete() or override.is_force_add():
        raise ValueError("a sweep varies settings that there are")
    if not override.is_sweep_override():
        return iter([(value, override.get_value_element_as_str())])
    if isinstance(value, RangeSweep):
        if not value.step:
            raise ValueError("a range needs a step that is not 0")
        return ((x, str(x)) for x in numbers_of(value))
    if isinstance(value, ChoiceSweep) and not value.shuffle:
        return zip(value.list, override.sweep_string_iterator(), strict=True)
    raise ValueError("must be choices, VALUE,VALUE,..., or range(A,B[,STEP])")


def numbers_of(sweep: RangeSweep) -> Iterator[int | float]:
    """The numbers of a range, its end left out; of floats without the noise that adding them up would make."""
    start, stop, step = sweep.start, sweep.stop, sweep.step
    if all(isinstance(x, int) for x in (start, stop, step)):
        return iter(sweep.range())
    assert start is not None
    assert stop is not None
    numbers = (float(f"{start + i * step:.12g}") for i in itertools.count())
    return itertools.takewhile(lambda x: x < stop if step > 0 else x > stop, numbers)
