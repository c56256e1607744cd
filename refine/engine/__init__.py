"""Engines that minimise the refinement objective, by name; all take and return the same.

`reference` is the obvious one, on any device; `fused` does the same many times faster, on CPUs.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any

ENGINES = {"fused": "refine.engine.fused", "reference": "refine.engine.reference"}
"""Modules by name, with a function `descend` each; imported only when asked for."""


def choose_engine(name: str | None, device: str) -> str:
    """Return the engine that is asked for, or the fastest there is for a type of device.

    Args:
        name: a name in `ENGINES`, or None.
        device: `cpu`, `cuda` and so on.

    Raises:
        ValueError: no such engine, or not on this device.
    """
    if name is None:
        return "fused" if device == "cpu" else "reference"
    if name not in ENGINES:
        raise ValueError(f"no engine is called {name!r}; the known ones are {', '.join(sorted(ENGINES))}")
    if name == "fused" and device != "cpu":
        raise ValueError(f"the fused engine runs on CPUs, not on {device}")
    return name


def find_descend(name: str) -> Callable[..., Any]:
    """Return the `descend` of an engine, see `refine.engine.reference.descend`."""
    descend: Callable[..., Any] = import_module(ENGINES[name]).descend
    return descend


def find_solve(name: str) -> Callable[..., Any]:
    """Return the `solve` that goes with an engine, see `refine.engine.gauss_newton.solve`."""
    module = "fused_gauss_newton" if name == "fused" else "gauss_newton"
    solve: Callable[..., Any] = import_module(f"refine.engine.{module}").solve
    return solve
