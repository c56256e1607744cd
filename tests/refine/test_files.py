"""Files appear whole or not at all, and nothing unreadable gets past the door."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from nets.decoder import RESIZING_BYTES, Limits
from refine import files
from refine.errors import UserError
from refine.files import decode_image, write_atomically, write_text_atomically, write_together


def test_a_user_error_is_a_value_error() -> None:
    assert issubclass(UserError, ValueError)


def test_text_is_written_with_unix_line_ends_and_replaces_what_was_there(tmp_path: Path) -> None:
    target = tmp_path / "new" / "folder" / "note.txt"
    write_text_atomically(target, "first")
    write_text_atomically(target, "zwölf\nlines\n")
    assert target.read_bytes() == "zwölf\nlines\n".encode()
    assert os.listdir(target.parent) == ["note.txt"]


def test_the_target_is_untouched_until_the_block_ends(tmp_path: Path) -> None:
    target = tmp_path / "a.png"
    target.write_bytes(b"old")
    with write_atomically(target) as temporary:
        temporary.write_bytes(b"new")
        assert target.read_bytes() == b"old"
        assert temporary.parent.parent == tmp_path
        assert temporary.suffix == ".png"
    assert target.read_bytes() == b"new"
    assert os.listdir(tmp_path) == ["a.png"]


@pytest.mark.parametrize("failure", [RuntimeError("broken"), KeyboardInterrupt()])
def test_a_failing_block_leaves_no_file_and_no_new_folder(tmp_path: Path, failure: BaseException) -> None:
    kept = tmp_path / "kept.txt"
    kept.write_text("old")
    targets = [kept, tmp_path / "new" / "deep" / "b.txt"]
    with pytest.raises(type(failure)), write_together(targets) as temporaries:  # noqa: PT012
        for temporary in temporaries:
            temporary.write_text("half")
        raise failure
    assert kept.read_text() == "old"
    assert os.listdir(tmp_path) == ["kept.txt"]


def test_a_full_disk_is_one_sentence_for_the_user(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(files.os, "fsync", full)
    with pytest.raises(UserError, match=r"note\.txt: No space left on device"):
        write_text_atomically(tmp_path / "note.txt", "text")
    assert os.listdir(tmp_path) == []


def test_a_rename_that_fails_takes_the_earlier_ones_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    replace = os.replace

    def replace_only_the_first(source: Path, target: Path) -> None:
        if target.name != "first.txt":
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        replace(source, target)

    monkeypatch.setattr(files.os, "replace", replace_only_the_first)
    with (
        pytest.raises(UserError, match=r"second\.txt: Permission denied"),
        write_together([tmp_path / "first.txt", tmp_path / "second.txt"]),
    ):
        pass
    assert os.listdir(tmp_path) == []


def test_unwritable_targets_are_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    (tmp_path / "folder").mkdir()
    for target in (tmp_path / "folder", tmp_path / "file" / "below.txt", tmp_path / ("x" * 300 + ".txt")):
        with pytest.raises(UserError, match="Cannot write"):
            write_text_atomically(target, "text")
    assert sorted(os.listdir(tmp_path)) == ["file", "folder"]


def test_new_files_have_ordinary_permissions(tmp_path: Path) -> None:
    (tmp_path / "ordinary").write_text("")
    write_text_atomically(tmp_path / "atomic", "")
    assert (tmp_path / "atomic").stat().st_mode == (tmp_path / "ordinary").stat().st_mode


def test_a_symbolic_link_is_written_through(tmp_path: Path) -> None:
    (tmp_path / "real.txt").write_text("old")
    (tmp_path / "link.txt").symlink_to(tmp_path / "real.txt")
    write_text_atomically(tmp_path / "link.txt", "new")
    assert (tmp_path / "link.txt").is_symlink()
    assert (tmp_path / "real.txt").read_text() == "new"


def test_decoding_divides_integers_by_their_maximum(tmp_path: Path) -> None:
    stored = np.arange(20 * 30 * 3, dtype=np.uint16).reshape(20, 30, 3) * 36
    oiio.ImageBuf(stored).write(str(tmp_path / "a.png"))
    decoded = decode_image(tmp_path / "a.png")
    assert decoded.integer
    np.testing.assert_allclose(decoded.pixels, stored / 65535, rtol=2e-7)


def test_oversized_images_are_refused_from_the_header_alone(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    oiio.ImageBuf(np.zeros((40, 50, 3), np.uint8)).write(str(path))
    enough = 40 * 50 * RESIZING_BYTES
    for limits in (Limits(side=49), Limits(memory=enough - 1)):
        with pytest.raises(UserError, match=r"too large \(50 x 40\)"):
            decode_image(path, limits)
    assert decode_image(path, Limits(side=50)).pixels.shape == (40, 50, 3)


def test_libraries_print_nothing_and_standard_error_survives(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    oiio.ImageBuf(noise).write(str(tmp_path / "a.png"))
    path = tmp_path / "cut.png"
    path.write_bytes((tmp_path / "a.png").read_bytes()[:6000])
    with pytest.raises(UserError, match="damaged or cut short"):
        decode_image(path)
    os.write(2, b"still here")
    assert tuple(capfd.readouterr()) == ("", "still here")
