"""One flash photo in, a relightable material out.

>>> from refine import Refiner
>>> refined = Refiner("default").fit("photo.jpg")  # doctest: +SKIP
>>> refined.save("out")  # doctest: +SKIP
"""

from importlib import import_module, metadata
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nets.render import Camera, PointLight
    from nets.svbrdf import SVBRDF
    from refine.errors import UserError
    from refine.refiner import Refined, Refiner
    from refine.stages import RECIPES, Recipe

__all__ = ["RECIPES", "SVBRDF", "Camera", "PointLight", "Recipe", "Refined", "Refiner", "UserError"]

_HOMES = {
    "RECIPES": "refine.stages",
    "SVBRDF": "nets.svbrdf",
    "Camera": "nets.render",
    "PointLight": "nets.render",
    "Recipe": "refine.stages",
    "Refined": "refine.refiner",
    "Refiner": "refine.refiner",
    "UserError": "refine.errors",
}

try:
    __version__ = metadata.version("svbrdf-refine")
except metadata.PackageNotFoundError:  # run from a folder of sources that is not installed
    __version__ = "0+source"


def __getattr__(name: str) -> Any:
    """Import on first use, so that `refine --help` does not wait for torch."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
