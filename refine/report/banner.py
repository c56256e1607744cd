"""The picture at the top of the README: one row per photo, without words.

`python -m refine.report.banner PHOTO [PHOTO ...] --out docs/images/result.png [--init NAME] [--iters N]`
shows photo, normal, diffuse, roughness, specular and three renderings under lights the photo never saw.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import torch
from jaxtyping import Float
from torch import Tensor

from nets.color import linear_to_srgb
from nets.render import PointLight
from refine.files import write_atomically
from refine.refiner import Refined, Refiner

LIGHTS = ((-0.8, 0.6, 1.5), (0.8, 0.6, 1.5), (0.0, -0.9, 1.5))
"""Positions of the novel lights, surface units."""

GAP = 4
"""White pixels between pictures."""


def banner_row(refined: Refined) -> Float[Tensor, "3 h width"]:
    """Lay one result's pictures side by side, encoded for the screen."""
    maps = refined.svbrdf
    pictures = [
        linear_to_srgb(refined.capture.photo),
        maps.normal * 0.5 + 0.5,
        linear_to_srgb(maps.diffuse),
        maps.roughness.expand(-1, 3, -1, -1),
        linear_to_srgb(maps.specular),
        *(linear_to_srgb(refined.render(PointLight.at(position)).clamp(max=1.0)) for position in LIGHTS),
    ]
    gap = torch.ones(3, maps.size[0], GAP)
    return torch.cat([part for picture in pictures for part in (picture[0], gap)][:-1], dim=-1)


def main() -> None:
    """Refine the photos and write the picture."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("photos", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, default=Path("docs/images/result.png"))
    parser.add_argument("--init", default="default")
    parser.add_argument("--iters", type=int, default=None)
    arguments = parser.parse_args()
    refiner = Refiner(arguments.init)
    rows = [banner_row(refiner.fit(photo, iters=arguments.iters)) for photo in arguments.photos]
    gap = torch.ones(3, GAP, rows[0].shape[-1])
    picture = torch.cat([part for row in rows for part in (row, gap)][:-1], dim=-2)
    pixels = (picture.clamp(0.0, 1.0).permute(1, 2, 0) * 255.0).round().to(torch.uint8).numpy()
    with write_atomically(arguments.out) as temporary:
        oiio.ImageBuf(np.ascontiguousarray(pixels)).write(str(temporary))


if __name__ == "__main__":
    main()
