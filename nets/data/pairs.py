"""Pairs of photos of one flat surface under different lights, for hybrid training (paper Sec. 4, Eq. 4).

    pairs = PhotoPairs(Path("scenes"), crop=256)      # scenes/<scene>/00.jpg, 01.jpg, ...
    batch = pairs.sample(5, 256, generator)           # batch.a, batch.b: linear photos, pixel on pixel

The photos of a scene must show the same surface at the same place; `nets.data.videos` makes such folders.
No light positions are needed: the network estimates the one of b. Those who have them: `nets.data.photos`.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from nets.color import linear_to_srgb, srgb_to_linear, to_network_input
from nets.data.images import DataError, listed, read_image, resize, rgb, to_tensor
from nets.data.photos import PHOTO_SUFFIXES

SCALE = (0.6, 1.0)
"""Side of a square crop as a share of the photo's shorter side, drawn uniformly; the first end is open."""

HELD_OUT_OF = 8
"""One scene of so many is not trained on."""

_LINEAR = srgb_to_linear((torch.arange(256) / 255.0).expand(3, 1, 256))[0, 0].contiguous()
"""Linear light by 8-bit sRGB code: half of a batch's time would otherwise go into powers."""


@dataclass(frozen=True)
class PairBatch:
    """Photos of surfaces under two lights each (paper Eq. 4), pixel on pixel.

    Attributes:
        a: linear photos in [0, 1] that the materials are estimated from.
        b: linear photos in [0, 1] of the same surfaces, whose lights are estimated and renderings compared.
    """

    a: Float[Tensor, "batch 3 h w"]
    b: Float[Tensor, "batch 3 h w"]

    @property
    def network_input(self) -> Float[Tensor, "batch 3 h w"]:
        """The photos a, encoded to [-1, 1] with gamma 1/2.2, as `TrainingBatch.network_input`."""
        return to_network_input(self.a).contiguous(memory_format=torch.channels_last)

    @property
    def network_input_b(self) -> Float[Tensor, "batch 3 h w"]:
        """The photos b, encoded likewise: the light head's input."""
        return to_network_input(self.b).contiguous(memory_format=torch.channels_last)


class PhotoPairs:
    """All scenes of a folder, read, checked and held in memory as 8-bit sRGB.

    Attributes:
        scenes: their names, in order.
        skipped: one sentence per photo or scene that was left out, each naming it and saying why.
    """

    scenes: tuple[str, ...]
    skipped: tuple[str, ...]

    def __init__(self, folder: Path, *, size: int = 512, crop: int = 256) -> None:
        """Read every scene, so that whatever is wrong is known before training starts.

        Each folder in `folder` is a scene, each image in it (`PHOTO_SUFFIXES`, not hidden) a photo of it,
        stored sRGB-encoded, its alpha and its EXIF orientation ignored. A photo that cannot be read is left
        out; so is a whole scene with fewer than two photos, with photos of several sizes (what lies on what
        would be a guess), or whose photos are smaller than the crop.

        Args:
            folder: holds one folder per scene; other files in it are ignored.
            size: photos whose shorter side is longer than this are shrunk to it, in linear light. Memory is
                three bytes per pixel: 2.4 MB per square photo of 512.
            crop: side of the largest crop that will be drawn, pixels.

        Raises:
            DataError: no such folder, it is a scene itself, or no scene is left; the message names what was
                left out.
            ValueError: the crop is larger than the size.
        """
        folder = Path(folder)
        if not 0 < crop <= size:
            raise ValueError(f"the crop must be from 1 to {size} pixels, got {crop}")
        if not folder.is_dir():
            raise DataError(f"{folder} is not a folder")
        self.largest_crop = crop
        self._photos: list[UInt8[Tensor, "photos 3 h w"]] = []
        scenes: list[str] = []
        skipped: list[str] = []
        for scene in sorted(path for path in folder.iterdir() if path.is_dir() and path.name[0] != "."):
            try:
                self._photos.append(_read_scene(scene, size, crop, skipped))
                scenes.append(scene.name)
            except DataError as error:
                skipped.append(str(error))
        if not scenes and not skipped and _photo_files(folder):
            raise DataError(f"{folder} holds photos, not scenes; give the folder that holds it")
        if not scenes:
            raise DataError(
                f"{folder} holds no scene to train on: {listed(skipped) or 'it holds no folders'}"
            )
        self.scenes, self.skipped = tuple(scenes), tuple(skipped)

    def __len__(self) -> int:
        """Return the number of scenes."""
        return len(self.scenes)

    def parts(self) -> tuple[PhotoPairs, PhotoPairs]:
        """Return the scenes to train on, and those kept to see how a critic does on scenes it does not know.

        One scene in `HELD_OUT_OF` is kept, spread over the folder; of fewer than half as many scenes none can
        be spared, and both parts are the whole.
        """
        count = len(self.scenes)
        first = HELD_OUT_OF // 2
        kept = list(range(first - 1, count, HELD_OUT_OF))
        if not kept:
            return self, self
        return self._some([index for index in range(count) if index not in kept]), self._some(kept)

    def _some(self, indices: list[int]) -> PhotoPairs:
        some = copy.copy(self)
        some._photos = [self._photos[index] for index in indices]
        some.scenes = tuple(self.scenes[index] for index in indices)
        return some

    def sample(self, batch: int, crop: int, generator: torch.Generator) -> PairBatch:
        """Draw pairs: of a random scene two different photos in random order, both seen the same way.

        Every pair is cut to a random square (`SCALE`, but never less than the crop's own pixels: nothing is
        enlarged), shrunk by area in linear light, and turned and mirrored at random. A square stays most of
        the photo because the paper shrinks whole crops of its videos (Sec. 5.2).

        Args:
            batch: number of pairs.
            crop: side in pixels, at most the `crop` the scenes were checked for.
            generator: source of all randomness.

        Returns:
            Linear photos in [0, 1], decoded with the sRGB curve that files are stored with.

        Raises:
            ValueError: the crop is larger than what the scenes were checked for.
        """
        if not 0 < crop <= self.largest_crop:
            raise ValueError(f"the crop must be from 1 to {self.largest_crop} pixels, got {crop}")
        pairs = torch.cat([self._sample_pair(crop, generator) for _ in range(batch)])
        return PairBatch(pairs[0::2].contiguous(), pairs[1::2].contiguous())

    def _sample_pair(self, crop: int, generator: torch.Generator) -> Float[Tensor, "2 3 crop crop"]:
        def below(count: int) -> int:
            return int(torch.randint(count, (1,), generator=generator))

        photos = self._photos[below(len(self._photos))]
        first, step = below(len(photos)), 1 + below(len(photos) - 1)
        chosen = photos[[first, (first + step) % len(photos)]]

        height, width = chosen.shape[-2:]
        scale = SCALE[1] - (SCALE[1] - SCALE[0]) * float(torch.rand((), generator=generator))
        side = max(crop, round(scale * min(height, width)))
        top, left = below(height - side + 1), below(width - side + 1)
        square = decode_photo(chosen[..., top : top + side, left : left + side])
        square = torch.rot90(resize(square, crop, crop), below(4), (-2, -1))
        return square.flip(-1) if below(2) else square


def decode_photo(codes: UInt8[Tensor, "*batch 3 h w"]) -> Float[Tensor, "*batch 3 h w"]:
    """Decode 8-bit sRGB to linear light in [0, 1]."""
    return _LINEAR[codes.int()]


def encode_photo(photo: Float[Tensor, "*batch 3 h w"]) -> UInt8[Tensor, "*batch 3 h w"]:
    """Clip linear light to [0, 1] and encode it as 8-bit sRGB, rounded."""
    return (linear_to_srgb(photo.clamp(0.0, 1.0)) * 255.0).round().to(torch.uint8)


def _read_scene(folder: Path, size: int, crop: int, skipped: list[str]) -> UInt8[Tensor, "photos 3 h w"]:
    """Read a scene; add the reasons for photos left out to `skipped`."""
    files = _photo_files(folder)
    photos: list[UInt8[Tensor, "1 3 h w"]] = []
    shapes: dict[tuple[int, int], Path] = {}
    for file in files:
        try:
            pixels, _ = read_image(file)
        except DataError as error:
            skipped.append(str(error))
            continue
        height, width = pixels.shape[:2]
        shapes.setdefault((height, width), file)
        if len(shapes) > 1:
            sizes = ", ".join(f"{path.name} with {w} x {h} pixels" for (h, w), path in shapes.items())
            raise DataError(f"{folder} holds photos of different sizes: {sizes}")
        if min(height, width) < crop:
            raise DataError(
                f"{folder} holds photos smaller than the crop of {crop} pixels: "
                f"{file.name} has {width} x {height}"
            )
        photos.append(_shrink(rgb(to_tensor(pixels)), size))
    if len(photos) < 2:
        count = "one photo" if len(photos) == 1 else "no photos"
        readable = " that can be read" if len(files) > len(photos) else ""
        raise DataError(f"{folder} holds {count}{readable}; a pair needs two")
    return torch.cat(photos)


def _shrink(stored: Float[Tensor, "1 3 h w"], size: int) -> UInt8[Tensor, "1 3 height width"]:
    """Shrink an sRGB-encoded photo in linear light, shorter side to `size` if longer; return 8-bit sRGB."""
    height, width = stored.shape[-2:]
    factor = size / min(height, width)
    if factor >= 1.0:
        return (stored * 255.0).round().to(torch.uint8)
    linear = srgb_to_linear(stored)
    return encode_photo(resize(linear, round(height * factor), round(width * factor)))


def _photo_files(folder: Path) -> list[Path]:
    """List the photos of a scene in the order of their names."""
    return sorted(
        path
        for path in folder.iterdir()
        if path.suffix.lower() in PHOTO_SUFFIXES and not path.name.startswith(".") and path.is_file()
    )
