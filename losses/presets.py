"""Objectives by name: the paper's weights, the authors' code's, and those of the narrow network shipped here.

Paper against code is listed in docs/training.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

from losses.baselines import DES18, DES19, GAO19, RenderingObjective
from losses.light import LightObjective
from losses.objective import HybridObjective, L1Objective, RealObjective, SyntheticObjective
from losses.score import TermWeights

AnyObjective = L1Objective | LightObjective | SyntheticObjective | HybridObjective | RenderingObjective

PAPER = HybridObjective()
"""Eq. 1 to 5 with the weights the paper states."""

AS_CODED = HybridObjective(
    synthetic=SyntheticObjective(maps=TermWeights(adversarial=0.2, feature=2.0, l1=10.0)),
    real=RealObjective(rendering=TermWeights(l1=50.0, perceptual=10.0)),
    real_weight=1.0,
)
"""The weights of the authors' code: adversarial and feature terms of maps count a fifth, real pairs are
compared by VGG too, and E_real weighs as much as E_syn."""

NARROW = HybridObjective(
    synthetic=SyntheticObjective(
        maps=TermWeights(adversarial=0.05, feature=0.5, l1=1.0, l2=4.0),
        normal_factor=5.0,
        rendering=TermWeights(adversarial=0.1, feature=1.0, l1=10.0, perceptual=1.0, l2=20.0),
        rendering_weight=1.0,
        light_weight=1.0,
        more_lights=2,
        log_offset=0.1,
        window=128,
        perceptual_samples=1,
        perceptual_layers=3,
    ),
    real=RealObjective(rendering=TermWeights(adversarial=0.1, feature=1.0, l1=10.0), window=128),
    real_weight=0.5,
)
"""The L1 objective's terms with critics beside them, light enough that a network trained for hours on two
cores is led by the truth and sharpened by the critics. These and VGG see 128 px windows, to save time."""

PRESETS: dict[str, HybridObjective] = {"paper": PAPER, "as_coded": AS_CODED, "narrow": NARROW}

BASELINES: dict[str, RenderingObjective] = {"des18": DES18, "des19": DES19, "gao19": GAO19}
"""Of the systems compared with, by name; they have no presets."""

KINDS = ("l1", "synthetic", "hybrid", "light", *BASELINES)

T = TypeVar("T")


def find_objective(
    kind: str, preset: str = "paper", overrides: Mapping[str, Any] | None = None
) -> AnyObjective:
    """Return an objective by name, with some values changed.

    Args:
        kind: `l1` (no critics), `synthetic` (Eq. 1), `hybrid` (Eq. 5) or `light` (the light encoder
            alone); or one of `BASELINES`.
        preset: `paper`, `as_coded` or `narrow`; of meaning for `synthetic` and `hybrid` only.
        overrides: values by field name, nested as the objective is.

    Raises:
        ValueError: naming what is unknown and what is known.
    """
    if kind not in KINDS:
        raise ValueError(f"no objective is called {kind!r}; the known ones are {', '.join(KINDS)}")
    if preset not in PRESETS:
        raise ValueError(f"no preset is called {preset!r}; the known ones are {', '.join(PRESETS)}")
    hybrid = PRESETS[preset]
    found: dict[str, AnyObjective] = {
        "l1": L1Objective(),
        "synthetic": hybrid.synthetic,
        "hybrid": hybrid,
        "light": LightObjective(),
        **BASELINES,
    }
    return override(found[kind], overrides or {})


def override(value: T, changes: Mapping[str, Any]) -> T:
    """Return a dataclass with some fields replaced; a mapping changes fields of a field.

    Raises:
        ValueError: an unknown field, or a value of another type than the one it replaces.
    """
    assert is_dataclass(value)
    known = [f.name for f in fields(value)]
    replaced: dict[str, Any] = {}
    for name, change in changes.items():
        if name not in known:
            raise ValueError(f"{type(value).__name__} has no {name!r}; it has {', '.join(known)}")
        present = getattr(value, name)
        if is_dataclass(present) and isinstance(change, Mapping):
            replaced[name] = override(present, change)
        else:
            replaced[name] = _like(present, change, f"{type(value).__name__}.{name}")
    return replace(value, **replaced)  # type: ignore[type-var]


def _like(present: Any, change: Any, name: str) -> Any:
    """Return the change as the type of what it replaces."""
    kind = type(present)
    if kind is float and type(change) is int:
        return float(change)
    if kind is tuple and isinstance(change, list | tuple):
        if len(change) != len(present):
            raise ValueError(f"{name} must have {len(present)} values, got {change!r}")
        return tuple(_like(old, new, name) for old, new in zip(present, change, strict=True))
    if type(change) is not kind:
        hint = "; YAML writes 2e-5 as 2.0e-5" if kind is float and isinstance(change, str) else ""
        raise ValueError(f"{name} must be of type {kind.__name__}, got {change!r}{hint}")
    return change
