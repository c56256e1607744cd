"""One flash photo in, a relightable material out.

>>> from refine import Refiner
>>> refined = Refiner("default").fit("photo.jpg")  # doctest: +SKIP
>>> refined.save("out")  # doctest: +SKIP
"""

from nets.render import Camera, PointLight
from nets.svbrdf import SVBRDF
from refine.errors import UserError
from refine.refiner import Refined, Refiner
from refine.stages import RECIPES, Recipe

__all__ = ["RECIPES", "SVBRDF", "Camera", "PointLight", "Recipe", "Refined", "Refiner", "UserError"]
