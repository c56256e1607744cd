"""Videos of a flat surface under a moving flash to scenes of photos under different lights (paper Sec. 5.2).

    python -m nets.data.videos VIDEO... --out FOLDER [--crops 3] [--frames 10] [--size 256] [--tripod]

As the paper has it: each video gives one to three crops with reasonable lighting, each crop 5 to 10 frames
with sufficiently different light, each 256 pixels a side. The result, `FOLDER/<video>-<crop>/00.png ...`, is
what `nets.data.pairs` reads; look at `FOLDER/contact_sheet.png` before training on it. A video that is
damaged, too short or unusable is named and skipped; a run that was stopped goes on where it was. Needs PyAV.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import uuid
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from nets.color import linear_to_srgb, luminance
from nets.data.contact_sheet import draw_photos
from nets.data.frames import MINIMUM_FRAMES, fit, import_av, read_frames
from nets.data.images import DataError, read_image, resize, to_tensor, write_image
from nets.data.pairs import decode_photo, encode_photo
from nets.data.selection import Box, choose_frames, find_crops
from nets.data.stabilize import corner_motion, stabilize, warp

CONTACT_SHEET = "contact_sheet.png"
SHEET_TILE = 112

REGISTRATION_SIDE = 384
"""Longer side of the frames that are registered, pixels."""

SURVEY_SIDE = 160
"""Longer side of the frames that crops are looked for in, pixels."""

STILL = 0.004
"""Shares of the longer side: if half the frames move less, only the light moved, the camera stood still."""

MINIMUM_OVERLAP = 0.75
"""Share of the first frame that another must show to be used: a swerve must not cost all crops their room."""


@dataclass(frozen=True)
class VideoSettings:
    """What is made of each video.

    Attributes:
        crops: most scenes per video, 1 to 3 (Sec. 5.2).
        frames: most photos per scene, 5 to 10 (Sec. 5.2).
        size: side of the photos, pixels. Crops of fewer pixels are not taken: nothing is enlarged.
        seed: of the first frame chosen in each crop.
        tripod: the camera stood still; nothing is registered.
    """

    crops: int = 3
    frames: int = 10
    size: int = 256
    seed: int = 0
    tripod: bool = False


def make_scenes(
    frames: Sequence[UInt8[np.ndarray, "h w 3"]], settings: VideoSettings
) -> list[UInt8[Tensor, "photos 3 size size"]]:
    """Stabilise a video's frames, choose crops, and choose each crop's frames.

    Args:
        frames: of one size, 8-bit sRGB, in order.
        settings: what is asked for.

    Returns:
        One to three scenes of `MINIMUM_FRAMES` or more photos in the order of the video, 8-bit sRGB, pixel on
        pixel; every photo is sampled once from its frame and averaged by area in linear light.

    Raises:
        DataError: why there is none; without the video's name.
    """
    height, width = frames[0].shape[:2]
    homographies, usable = _register(frames, settings.tripod)
    survey_size = fit(height, width, SURVEY_SIDE)
    survey, shown = [], []
    for frame, homography in zip(frames, homographies, strict=True):
        small = warp(resize(decode_photo(_planes(frame)), *survey_size), homography, *survey_size)
        survey.append(small)
        shown.append(warp(torch.ones(1, 1, height, width), homography, *survey_size)[0, 0] > 0.999)
    usable = usable & torch.stack(shown).flatten(1).float().mean(dim=1).ge(MINIMUM_OVERLAP)
    count = int(usable.sum())
    if count < MINIMUM_FRAMES:
        raise DataError(f"only {count} of {len(frames)} frames could be registered to the first")
    rows = usable.nonzero().flatten().tolist()
    room = torch.stack([shown[row] for row in rows]).all(dim=0)
    smallest = settings.size * min(survey_size) / min(height, width)
    boxes = find_crops(torch.cat([survey[row] for row in rows]), room, settings.crops, smallest)
    if not boxes:
        raise DataError(f"no crop of {settings.size} pixels is in all frames, well lit and textured")

    generator = torch.Generator().manual_seed(settings.seed)
    scenes, most = [], 0
    for box in boxes:
        photos = torch.cat([_cut(frames[row], homographies[row], box, settings.size) for row in rows])
        chosen = choose_frames(photos, settings.frames, generator)
        most = max(most, len(chosen))
        if len(chosen) >= MINIMUM_FRAMES:
            scenes.append(encode_photo(photos[chosen]))
    if not scenes:
        raise DataError(
            f"no crop has {MINIMUM_FRAMES} sharp frames with different light; the best has {most}"
        )
    return scenes


@dataclass(frozen=True)
class Conversion:
    """What became of a run's videos.

    Attributes:
        scenes: folders that were written, in order.
        skipped: one sentence per video without a scene, naming it and saying why.
        present: videos whose scenes were there before.
    """

    scenes: tuple[Path, ...]
    skipped: tuple[str, ...]
    present: tuple[Path, ...]


def convert(videos: Sequence[Path], out: Path, settings: VideoSettings | None = None) -> Conversion:
    """Write the scenes of all videos and a contact sheet.

    Args:
        videos: files; no two of one name, since scenes are named after them.
        out: folder of the scenes, made if need be. A video's scenes appear in it together and complete, or
            not at all; a video whose first scene is there is left alone.
        settings: what is made of each video.

    Raises:
        DataError: PyAV is missing, two videos have one name, the folder cannot be written, or there is no
            scene in the end; then the folder is as it was.
    """
    import_av()
    settings, out = settings or VideoSettings(), Path(out)
    names: dict[str, Path] = {}
    for video in videos:
        name = video.stem.strip(". ") or "video"
        if name in names:
            raise DataError(f"{names[name]} and {video} would be scenes of one name; rename one of them")
        names[name] = video
    existed = out.exists()
    partial = out / f".partial-{uuid.uuid4().hex}"
    scenes: list[Path] = []
    skipped: list[str] = []
    present: list[Path] = []
    try:
        try:
            partial.mkdir(parents=True)
            for name, video in names.items():
                if (out / f"{name}-1").exists():
                    present.append(video)
                    continue
                try:
                    photos = make_scenes(read_frames(video), settings)
                except DataError as error:
                    skipped.append(str(error) if str(video) in str(error) else f"{video}: {error}")
                    print(f"skipped: {skipped[-1]}", file=sys.stderr, flush=True)
                    continue
                scenes += _write_scenes(photos, name, out, partial)
                print(f"{video}: {', '.join(f'{len(scene)} photos' for scene in photos)}", flush=True)
            if scenes:
                _write_contact_sheet(out, partial)
        except OSError as error:
            raise DataError(f"{out} cannot be written: {error.strerror or error}") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
        if not existed and not scenes and out.is_dir():
            out.rmdir()
    if not scenes and not present:
        raise DataError(f"none of {len(names)} videos gave a scene: {'; '.join(skipped[:3])}")
    return Conversion(tuple(scenes), tuple(skipped), tuple(present))


def _register(
    frames: Sequence[UInt8[np.ndarray, "h w 3"]], tripod: bool
) -> tuple[Float[Tensor, "frames 3 3"], Bool[Tensor, "frames"]]:
    """Return homographies from the first frame to each, and which of them to trust."""
    still = torch.eye(3, dtype=torch.float64).repeat(len(frames), 1, 1)
    everything = torch.ones(len(frames), dtype=torch.bool)
    if tripod:
        return still, everything
    height, width = fit(frames[0].shape[0], frames[0].shape[1], REGISTRATION_SIDE)
    found = stabilize(
        [luminance(linear_to_srgb(resize(decode_photo(_planes(f)), height, width))) for f in frames]
    )
    motion = corner_motion(found.homographies, still, height, width) / max(height, width)
    if float(motion.median()) < STILL:
        return still, motion < 2.0 * STILL  # what moved further was a push
    return found.homographies, found.reliable


def _cut(
    frame: UInt8[np.ndarray, "h w 3"], homography: Float[Tensor, "3 3"], box: Box, size: int
) -> Float[Tensor, "1 3 size size"]:
    """Sample a crop of a frame at about the frame's own resolution and average it to the size, linear."""
    x, y, half_width, half_height = box
    place = torch.tensor([[half_width, 0.0, x], [0.0, half_height, y], [0.0, 0.0, 1.0]], dtype=torch.float64)
    finer = max(1, round(half_width * frame.shape[1] / size))
    linear = decode_photo(_planes(frame))
    return resize(warp(linear, homography @ place, finer * size, finer * size), size, size)


def _planes(frame: UInt8[np.ndarray, "h w 3"]) -> UInt8[Tensor, "1 3 h w"]:
    return torch.from_numpy(frame).permute(2, 0, 1)[None]


def _write_scenes(
    scenes: Sequence[UInt8[Tensor, "photos 3 size size"]], name: str, out: Path, partial: Path
) -> list[Path]:
    """Write a video's scenes aside and move them into place together."""
    folders = []
    for number, photos in enumerate(scenes, start=1):
        folder = partial / f"{name}-{number}"
        folder.mkdir()
        for position, photo in enumerate(photos):
            write_image(folder / f"{position:02}.png", photo.permute(1, 2, 0).contiguous().numpy())
        folders.append(folder)
    # The first scene says that a video is done: it is moved last.
    return [folder.rename(out / folder.name) for folder in reversed(folders)][::-1]


def _write_contact_sheet(out: Path, partial: Path) -> None:
    """Draw all scenes of the folder, those of earlier runs too."""
    rows = []
    for folder in sorted(path for path in out.iterdir() if path.is_dir() and path.name[0] != "."):
        photos = [to_tensor(read_image(path)[0]) for path in sorted(folder.glob("*.png"))]
        small = [
            resize(photo, *fit(photo.shape[-2], photo.shape[-1], 112))[0].permute(1, 2, 0).numpy()
            for photo in photos
        ]
        rows.append((folder.name, small))
    draw_photos(rows, partial / CONTACT_SHEET, tile=SHEET_TILE)
    (partial / CONTACT_SHEET).replace(out / CONTACT_SHEET)


def main(arguments: Sequence[str] | None = None) -> int:
    """Convert videos from the command line; return the exit code: 0, or 2 after one sentence on stderr."""
    parser = argparse.ArgumentParser(prog="python -m nets.data.videos", description=__doc__)
    defaults = VideoSettings()
    parser.add_argument("videos", type=Path, nargs="+", metavar="VIDEO")
    parser.add_argument("--out", type=Path, required=True, help="folder of the scenes")
    parser.add_argument("--crops", type=int, choices=(1, 2, 3), default=defaults.crops, help="most per video")
    parser.add_argument(
        "--frames", type=int, choices=range(5, 11), default=defaults.frames, help="most per crop"
    )
    parser.add_argument("--size", type=int, default=defaults.size, help="side of the photos in pixels")
    parser.add_argument("--seed", type=int, default=defaults.seed)
    parser.add_argument("--tripod", action="store_true", help="the camera stood still: do not stabilise")
    options = parser.parse_args(arguments)
    settings = VideoSettings(options.crops, options.frames, options.size, options.seed, options.tripod)
    try:
        if settings.size < 16:
            raise DataError(f"--size must be at least 16 pixels, got {settings.size}")
        done = convert(options.videos, options.out, settings)
    except DataError as error:
        print(str(error), file=sys.stderr)
        return 2
    print(
        f"{options.out}: {len(done.scenes)} new scenes, {len(done.present)} videos done before, "
        f"{len(done.skipped)} skipped; look at {options.out / CONTACT_SHEET}"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
