"""Hand-held photos of one flat surface, brought into register with the first of them.

Hands move farther between photos than between frames of a video. So features (SIFT and RANSAC, by kornia) say
roughly how, in local contrast, which a highlight changes little; from there the registration of videos takes
over (`nets.data.stabilize`): homographies to a tenth of a pixel, robust against moving highlights.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nets.color import linear_to_srgb, luminance
from nets.data.images import resize
from nets.data.stabilize import normalize_contrast, stabilize, warp
from refine.errors import UserError
from refine.photo import Photo

REGISTRATION_SIDE = 480
"""Longer side at which photos are compared, pixels: enough for a tenth of a pixel."""

SHORTEST_SIDE = 64
"""Photos whose shorter side has fewer pixels show too little to compare."""

FEATURES = 1000
"""Most features of a photo."""

SIMILAR = 0.95
"""Largest ratio of a match's distance to the second best's: moving light leaves few features as they were."""

MINIMUM_MATCHES = 8
"""Fewer say nothing: a homography takes four."""

NEAR = 2.0
"""Pixels by which a match may miss and count for a homography."""

WHOLLY = 0.999
"""Share of a sample that must come from inside of a photo, or from unsaturated pixels, to count as such."""


def align(photos: Sequence[Photo]) -> tuple[list[Photo], list[Bool[Tensor, "1 1 h w"]]]:
    """Resample photos as the first one's camera would have seen them.

    Args:
        photos: of one flat surface; sizes may differ. The first is returned as it is.

    Returns:
        The photos at the first one's size, and where each shows the surface at all; elsewhere a photo is 0
        and counts as saturated.

    Raises:
        UserError: a photo is too small, or shows something else than the first.
    """
    height, width = photos[0].size
    scale = min(1.0, REGISTRATION_SIDE / max(height, width))
    size = round(height * scale), round(width * scale)
    for photo in photos:
        if min(*photo.size, *size) < SHORTEST_SIDE:
            raise UserError(
                f"{photo.source} is too small to be aligned; both sides need {SHORTEST_SIDE} pixels or more, "
                "so ask for a larger --resolution or take photos that are aligned already."
            )
    frames = [resize(_encoded(photo), *size) for photo in photos]
    rough = [_by_features(frames[0], frame) for frame in frames[1:]]
    near = [_as_seen(frame, homography) for frame, homography in zip(frames[1:], rough, strict=True)]
    found = stabilize([frames[0], *near])
    for photo, reliable in zip(photos[1:], found.reliable[1:], strict=True):
        if not reliable:
            raise UserError(
                f"{photo.source} could not be aligned with {photos[0].source}; "
                "leave it out, or align the photos yourself and leave out --align."
            )
    moved = [
        _moved(photo, first @ then, height, width)
        for photo, first, then in zip(photos[1:], rough, found.homographies[1:], strict=True)
    ]
    everywhere = torch.ones(1, 1, height, width, dtype=torch.bool)
    return [photos[0], *(photo for photo, _ in moved)], [everywhere, *(visible for _, visible in moved)]


def require_one_size(photos: Sequence[Photo]) -> None:
    """Check that photos could be in register.

    Raises:
        UserError: their sizes differ.
    """
    for photo in photos:
        if photo.size != photos[0].size:
            (height, width), (first_height, first_width) = photo.size, photos[0].size
            raise UserError(
                f"{photo.source} has {width} x {height} pixels and {photos[0].source} {first_width} x "
                f"{first_height}; photos of one surface must be in register, or be aligned with --align."
            )


def _encoded(photo: Photo) -> Float[Tensor, "1 1 h w"]:
    return luminance(linear_to_srgb(photo.linear.clamp(max=1.0)))


def _by_features(first: Float[Tensor, "1 1 h w"], frame: Float[Tensor, "1 1 h w"]) -> Float[Tensor, "3 3"]:
    """Return the homography on which most matches agree, or the identity if there are too few."""
    import kornia.feature  # takes a second, which who aligns nothing need not wait
    from kornia.geometry import RANSAC

    height, width = first.shape[-2:]
    detector = kornia.feature.SIFTFeature(FEATURES)
    places, descriptors = [], []
    with torch.no_grad(), torch.random.fork_rng():
        torch.manual_seed(0)
        for image in (first, frame):
            shapes, _, described = detector(normalize_contrast(image)[0].clamp(-3.0, 3.0) / 6.0 + 0.5)
            pixels = kornia.feature.get_laf_center(shapes)[0]
            places.append((2.0 * pixels + 1.0) / torch.tensor([width, height]) - 1.0)
            descriptors.append(described[0])
        _, pairs = kornia.feature.match_smnn(*descriptors, SIMILAR)
        if len(pairs) < MINIMUM_MATCHES:
            return torch.eye(3, dtype=torch.float64)
        agree = RANSAC("homography", inl_th=2.0 * NEAR / max(height, width))
        homography, _ = agree(places[0][pairs[:, 0]], places[1][pairs[:, 1]])
    return (homography / homography[2, 2]).double()


def _as_seen(frame: Float[Tensor, "1 1 h w"], homography: Float[Tensor, "3 3"]) -> Tensor:
    """Warp a frame; where it shows nothing it is white, which counts as without structure."""
    height, width = frame.shape[-2:]
    inside = warp(torch.ones_like(frame), homography, height, width) > WHOLLY
    return torch.where(inside, warp(frame, homography, height, width), 1.0)


def _moved(
    photo: Photo, homography: Float[Tensor, "3 3"], height: int, width: int
) -> tuple[Photo, Bool[Tensor, "1 1 h w"]]:
    inside = warp(torch.ones_like(photo.linear[:, :1]), homography, height, width) > WHOLLY
    clear = warp(photo.unsaturated.to(photo.linear.dtype), homography, height, width) > WHOLLY
    linear = warp(photo.linear, homography, height, width, mode="bicubic").clamp(min=0.0)
    note = f"aligned with the first photo; {1.0 - float(inside.float().mean()):.1%} of it is not seen"
    moved = replace(
        photo,
        linear=torch.where(inside, linear, 0.0),
        unsaturated=clear & inside,
        notes=(*photo.notes, note),
    )
    return moved, inside
