"""Engines that minimise the refinement objective, by name; all take and return the same.

`reference` is the obvious one, on any device; `fused` does the same many times faster, on CPUs; `compiled` is
for GPUs, and runs wherever `torch.compile` does.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from importlib import import_module
from typing import Any

ENGINES = {
    "fused": "refine.engine.fused",
    "compiled": "refine.engine.compiled",
    "reference": "refine.engine.reference",
}
"""Modules by name, with a function `descend` each; imported only when asked for."""

_log = logging.getLogger(__name__)


def choose_engine(name: str | None, device: str) -> str:
    """Return the engine that is asked for, or the fastest there is for a type of device.

    Args:
        name: a name in `ENGINES`, or None.
        device: `cpu`, `cuda` and so on.

    Raises:
        ValueError: no such engine, or not here (see `obstacle`).
    """
    if name is None:
        fastest = {"cpu": "fused", "cuda": "compiled"}.get(device, "reference")
        if (reason := obstacle(fastest, device)) is None:
            return fastest
        _log.warning("refining without torch.compile, which is slower: %s", reason)
        return "reference"
    if name not in ENGINES:
        raise ValueError(f"no engine is called {name!r}; the known ones are {', '.join(sorted(ENGINES))}")
    if (reason := obstacle(name, device)) is not None:
        raise ValueError(f"the {name} engine cannot be used: {reason}")
    return name


def obstacle(name: str, device: str) -> str | None:
    """Return why an engine cannot be used on a type of device, or None if it can."""
    if name == "fused" and device != "cpu":
        return f"it runs on CPUs, not on {device}"
    if name == "compiled":
        reason: str | None = import_module(ENGINES[name]).missing(device)
        return reason
    return None


def find_descend(name: str) -> Callable[..., Any]:
    """Return the `descend` of an engine, see `refine.engine.reference.descend`."""
    descend: Callable[..., Any] = import_module(ENGINES[name]).descend
    return descend


def find_gradients(name: str) -> Callable[..., Any]:
    """Return the `gradients` that goes with an engine, see `refine.engine.reference.gradients`."""
    module = "fused_gradients" if name == "fused" else "reference"
    gradients: Callable[..., Any] = import_module(f"refine.engine.{module}").gradients
    return gradients


def find_solve(name: str) -> Callable[..., Any]:
    """Return the `solve` that goes with an engine, see `refine.engine.gauss_newton.solve`."""
    module = "fused_gauss_newton" if name == "fused" else "gauss_newton"
    solve: Callable[..., Any] = import_module(f"refine.engine.{module}").solve
    return solve
