"""Run-time type checks, each made once, since functions within functions are defined again and again."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import beartype

_check = beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))  # an int is a float, as for mypy
_made: dict[tuple[Any, ...], Callable[..., Any]] = {}


def checked(stub: Callable[..., Any]) -> Callable[..., Any]:
    """Return a stub that checks its arguments; jaxtyping makes one by the signature of every definition."""
    key = (stub.__module__, stub.__qualname__, *stub.__annotations__.items())
    try:
        if key not in _made:
            _made[key] = _check(stub)
    except TypeError:  # an annotation that has no hash
        return _check(stub)
    return _made[key]
