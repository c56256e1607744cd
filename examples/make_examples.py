"""Render the three example photos: procedural materials under an off-centre flash, saved as a phone would.

They may be redistributed with the library. Usage: `python examples/make_examples.py [--out examples]`.
"""

import argparse
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import torch

from nets.color import linear_to_srgb
from nets.data.pool import from_planes
from nets.data.procedural import generate
from nets.render import PointLight, render

SIZE = 512
EXAMPLES = {  # name -> family, seed, light position, exposure
    "leather": ("leather", 31, (0.25, 0.15, 2.3), 1.0),
    "tiles": ("glazed_tile", 32, (-0.2, 0.3, 2.0), 0.9),
    "slate": ("slate", 34, (0.15, -0.2, 2.5), 1.1),
}


def main() -> None:
    """Write every example as an 8-bit JPEG."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent)
    folder = parser.parse_args().out
    for name, (family, seed, position, exposure) in EXAMPLES.items():
        svbrdf = from_planes(generate(family, SIZE, seed))
        generator = torch.Generator().manual_seed(seed)
        photo = render(svbrdf, PointLight.at(position, exposure, falloff="inverse_square"))
        encoded = linear_to_srgb(photo.clamp(max=1.0))
        encoded = encoded + 0.006 * torch.randn(encoded.shape, generator=generator)
        pixels = (encoded[0].clamp(0.0, 1.0).permute(1, 2, 0).numpy() * 255.0).round().astype(np.uint8)
        buffer = oiio.ImageBuf(np.ascontiguousarray(pixels))
        buffer.specmod().attribute("CompressionQuality", 92)
        buffer.write(str(folder / f"{name}.jpg"))


if __name__ == "__main__":
    main()
