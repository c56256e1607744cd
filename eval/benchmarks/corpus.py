"""Image files to fuzz readers with: a small file of every kind there is, sound or hostile, made from a seed.

Every file is made here, so none is stored but those that once broke something (`tests/fuzz/corpus`).
"""

from __future__ import annotations

import io
import struct
import tempfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from PIL import Image, ImageCms

SIDE = 16
"""Height of the pictures, pixels; their width is five times that, so that they are strips, too."""


def seeds(seed: int = 0) -> dict[str, bytes]:
    """Return files by name; the same seed makes the same bytes with the same versions of the encoders."""
    noise = np.random.default_rng(seed).integers(0, 256, (SIDE, 5 * SIDE, 4), dtype=np.uint8)
    return dict((*_by_openimageio(noise), *_by_pillow(noise), *_by_hand(noise)))


def mutations(data: bytes, seed: int, count: int) -> Iterator[bytes]:
    """Yield a file cut short, with bits flipped, with bytes overwritten, with a piece repeated; and so on."""
    numbers = np.random.default_rng((seed, zlib.crc32(data)))
    for number in range(count):
        changed = bytearray(data)
        if number % 4 == 0:
            del changed[int(numbers.integers(len(data))) :]
        elif number % 4 == 1:
            for place in numbers.integers(len(data), size=3):
                changed[place] ^= 1 << int(numbers.integers(8))
        elif number % 4 == 2:
            place = int(numbers.integers(min(len(data), 256)))
            changed[place : place + 4] = numbers.bytes(4)
        else:
            start, length = int(numbers.integers(len(data))), int(numbers.integers(1, 64))
            changed[start:start] = changed[start // 2 : start // 2 + length]
        yield with_checksums(bytes(changed))


def with_checksums(data: bytes) -> bytes:
    """Return a PNG with the checksums of its chunks set right: a reader looks no further otherwise."""
    if not data.startswith(PNG):
        return data
    mended, place = bytearray(data), len(PNG)
    while place + 12 <= len(mended):
        (length,) = struct.unpack_from(">I", mended, place)
        end = place + 8 + length
        if end + 4 > len(mended):
            break
        struct.pack_into(">I", mended, end, zlib.crc32(mended[place + 4 : end]))
        place = end + 4
    return bytes(mended)


PNG = b"\x89PNG\r\n\x1a\n"


def chunk(name: bytes, data: bytes) -> bytes:
    """Return a chunk of a PNG."""
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def bomb(width: int, height: int, size: int) -> bytes:
    """Return a PNG of so many bytes, nearly all of them compressed zeros, that claims so many pixels."""
    packer = zlib.compressobj(9)
    packed = bytearray()
    zeros = bytes(2**20)
    while len(packed) < size:
        packed += packer.compress(zeros) + packer.flush(zlib.Z_FULL_FLUSH)
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return PNG + chunk(b"IHDR", header) + chunk(b"IDAT", bytes(packed[:size])) + chunk(b"IEND", b"")


def _by_openimageio(noise: np.ndarray) -> Iterator[tuple[str, bytes]]:
    rgb, floats = noise[..., :3], noise[..., :3].astype(np.float32) / 64.0 - 0.5
    broken = floats.copy()
    broken[0, :3] = np.array([np.nan, np.inf, -np.inf])[:, None]
    strange = (1e30, -1.0, 0.0, 0.0, 0.3, 0.3, 0.3, 0.0)
    files: list[tuple[str, np.ndarray, str, dict[str, Any]]] = [
        ("rgb.png", rgb, "uint8", {}),
        ("rgba.png", noise, "uint8", {}),
        ("rgb16.png", rgb, "uint16", {}),
        ("rgb.jpg", rgb, "uint8", {}),
        ("grey.jpg", noise[..., :1], "uint8", {}),
        ("progressive.jpg", rgb, "uint8", {"jpeg:progressive": 1}),
        ("rgb.tif", rgb, "uint8", {}),
        ("rgb16.tif", rgb, "uint16", {"compression": "lzw"}),
        ("rgba.tif", noise, "uint8", {"compression": "zip"}),
        ("tiled.tif", rgb, "uint8", {"tile": 16}),
        ("float.tif", floats, "float", {}),
        ("double.tif", floats, "double", {}),
        ("signed.tif", floats, "int16", {}),
        ("wide.tif", floats, "uint32", {}),
        ("broken.tif", broken, "float", {}),
        ("half.exr", floats, "half", {}),
        ("float.exr", floats, "float", {"compression": "zip"}),
        ("piz.exr", floats, "half", {"compression": "piz"}),
        ("dwa.exr", floats, "half", {"compression": "dwaa"}),
        ("tiled.exr", floats, "half", {"tile": 16}),
        ("broken.exr", broken, "float", {}),
        ("primaries.exr", floats, "half", {"chromaticities": strange}),
        ("alpha.exr", noise.astype(np.float32) / 255.0, "half", {}),
        ("rgb.hdr", np.abs(floats), "float", {}),
        ("rgb.bmp", rgb, "uint8", {}),
        ("rgb.tga", noise, "uint8", {}),
    ]
    files += [(f"turned{turn}.jpg", rgb, "uint8", {"Orientation": turn}) for turn in range(1, 9)]
    with tempfile.TemporaryDirectory() as folder:
        for name, pixels, kind, attributes in files:
            yield name, _encoded(Path(folder) / name, [pixels], kind, attributes)
        yield "parts.exr", _encoded(Path(folder) / "parts.exr", [floats, floats], "half", {})
        yield "pages.tif", _encoded(Path(folder) / "pages.tif", [rgb, rgb[:, :20]], "uint8", {})


def _encoded(path: Path, parts: list[np.ndarray], kind: str, attributes: dict[str, Any]) -> bytes:
    specs = []
    for number, pixels in enumerate(parts):
        spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], kind)
        spec.attribute("DateTime", "")
        for name, value in attributes.items():
            if name == "tile":
                spec.tile_width = spec.tile_height = value
            elif isinstance(value, tuple):
                spec.attribute(name, oiio.TypeDesc(f"float[{len(value)}]"), value)
            else:
                spec.attribute(name, value)
        if len(parts) > 1:
            spec.attribute("oiio:subimagename", f"part {number}")
        specs.append(spec)
    output = oiio.ImageOutput.create(str(path))
    if output is None:
        raise RuntimeError(f"{path.name} could not be made: {oiio.geterror()}")
    opened = output.open(str(path), specs[0]) if len(specs) == 1 else output.open(str(path), specs)
    for number, (spec, pixels) in enumerate(zip(specs, parts, strict=True)):
        if number:
            opened = opened and output.open(str(path), spec, "AppendSubimage")
        opened = opened and output.write_image(np.ascontiguousarray(pixels))
    if not (opened and output.close()):
        raise RuntimeError(f"{path.name} could not be made: {output.geterror()}")
    return path.read_bytes()


def _by_pillow(noise: np.ndarray) -> Iterator[tuple[str, bytes]]:
    rgb = Image.fromarray(noise[..., :3])
    inks = Image.merge("CMYK", Image.fromarray(noise).split())
    palette, bits = rgb.quantize(16), rgb.convert("1")
    files = {
        "cmyk.jpg": inks,
        "cmyk.tif": inks,
        "palette.png": palette,
        "palette.tif": palette,
        "palette.gif": palette,
        "bits.png": bits,
        "bits.tif": bits,
        "grey16.png": Image.fromarray(noise[..., 0].astype(np.uint16) * 257),
        "lossy.webp": rgb,
        "grey-alpha.png": rgb.convert("LA"),
    }
    formats = {"jpg": "JPEG", "tif": "TIFF"}
    for name, image in files.items():
        buffer, extension = io.BytesIO(), name.rpartition(".")[2]
        image.save(buffer, formats.get(extension, extension.upper()))
        yield name, buffer.getvalue()
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    for extension, kind in formats.items():
        rgb.save(buffer := io.BytesIO(), kind, icc_profile=profile)
        yield f"profile.{extension}", buffer.getvalue()


def _by_hand(noise: np.ndarray) -> Iterator[tuple[str, bytes]]:
    rows = b"".join(b"\0" + row.tobytes() for row in noise[..., :3])
    header = struct.pack(">IIBBBBB", noise.shape[1], noise.shape[0], 8, 2, 0, 0, 0)
    tags = chunk(b"gAMA", struct.pack(">I", 0)) + chunk(b"cHRM", bytes(32))
    tail = chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")
    yield "gamma.png", PNG + chunk(b"IHDR", header) + tags + tail
    yield "claims.png", bomb(60_000, 60_000, 1000)
    yield "text.png", b"this is text, not a picture\n" * 4
    yield "one byte", b"\xff"
