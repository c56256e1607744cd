"""Photos taken from elsewhere, under other lights, come back to where the first one was."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import pytest
import torch
from torch import Tensor

from nets.data.pool_format import from_planes
from nets.data.procedural import generate
from nets.data.stabilize import warp
from nets.render import Camera, PointLight, render
from refine.alignment import align, require_one_size
from refine.errors import UserError
from refine.photo import Photo

SIZE = 192
MOTIONS = (
    torch.tensor([[1.02, 0.03, 0.05], [-0.02, 0.99, -0.04], [0.01, -0.015, 1.0]], dtype=torch.float64),
    torch.tensor([[0.97, -0.05, -0.06], [0.05, 0.98, 0.03], [-0.01, 0.02, 1.0]], dtype=torch.float64),
)
LIGHTS = ((0.0, 0.1, 3.0), (0.7, 0.2, 3.0), (-0.6, -0.5, 3.1))


@cache
def in_register() -> Tensor:
    """Return photos [3, 3, SIZE, SIZE] whose highlights are in different places."""
    material = from_planes(generate("terrazzo", SIZE, 5)).validate()
    lights = PointLight(torch.tensor(LIGHTS), torch.ones(3, 3))
    return (1.5 * render(material, lights, Camera("collocated"))).clamp(max=1.0)


def as_photo(linear: Tensor, name: str) -> Photo:
    return Photo(linear, (linear < 1.0).all(dim=1, keepdim=True), (), name)


def hand_held() -> list[Photo]:
    """Move all but the first: align has to find MOTIONS."""
    still = in_register()
    moved = [
        warp(still[n : n + 1], torch.linalg.inv(motion), SIZE, SIZE, mode="bicubic").clamp(0.0, 1.0)
        for n, motion in enumerate(MOTIONS, start=1)
    ]
    return [as_photo(image, f"{n}.png") for n, image in enumerate([still[:1], *moved])]


@cache
def aligned() -> tuple[list[Photo], list[Tensor]]:
    return align(hand_held())


def test_a_known_homography_is_undone_under_moving_highlights() -> None:
    photos, visible = aligned()
    truth = in_register()
    assert torch.equal(photos[0].linear, truth[:1])
    assert bool(visible[0].all())
    for number, (photo, seen) in enumerate(zip(photos[1:], visible[1:], strict=True), start=1):
        inner = torch.zeros_like(seen)
        inner[..., 20:-20, 20:-20] = True
        assert bool(seen[inner].all())
        moved = hand_held()[number].linear
        before, after = (
            float((image - truth[number])[inner.expand_as(image)].abs().mean())
            for image in (moved, photo.linear)
        )
        assert after < 0.25 * before, (before, after)
        assert "aligned with the first" in photo.notes[-1]


def test_what_a_photo_does_not_show_is_known() -> None:
    photos, visible = aligned()
    for photo, seen, motion in zip(photos[1:], visible[1:], MOTIONS, strict=True):
        # A pixel is seen if the moved photo shows it and there was something to move there.
        shown = warp(torch.ones(1, 1, SIZE, SIZE), motion, SIZE, SIZE) > 0.999
        assert 0.01 < float((~shown).float().mean()) < 0.2
        assert float((seen == shown).float().mean()) > 0.97
        assert float(photo.linear[(~seen).expand_as(photo.linear)].abs().max()) == 0.0
        assert not bool(photo.unsaturated[~seen].any())


def test_something_else_cannot_be_aligned() -> None:
    noise = torch.rand(1, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(2))
    with pytest.raises(UserError, match=r"noise\.png could not be aligned with 0\.png"):
        align([*hand_held()[:2], as_photo(noise, "noise.png")])


def test_small_photos_are_refused() -> None:
    small = [replace(photo, linear=photo.linear[..., :40, :], unsaturated=photo.unsaturated[..., :40, :])
             for photo in hand_held()]  # fmt: skip
    with pytest.raises(UserError, match=r"0\.png is too small to be aligned; both sides need 64"):
        align(small)


def test_photos_in_register_have_one_size() -> None:
    first, second, _ = hand_held()
    require_one_size([first, second])
    cut = Photo(second.linear[..., 1:, :], second.unsaturated[..., 1:, :], (), "cut.png")
    with pytest.raises(UserError, match=r"cut\.png has 192 x 191 pixels and 0\.png 192 x 192; .* --align"):
        require_one_size([first, cut])
