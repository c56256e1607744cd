"""What `refine` wrote, read again for export: the maps of a folder, as the JSON beside them says."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nets.svbrdf import SVBRDF
from nets.text import parse_json
from refine.errors import UserError
from refine.maps import MAP_NAMES, read_maps
from refine.result import FORMAT, MAP_FORMATS


@dataclass(frozen=True)
class Result:
    """A result on disk.

    Attributes:
        svbrdf: its maps.
        stem: beginning of its file names.
        files: everything that belongs to it.
        record: its JSON.
    """

    svbrdf: SVBRDF
    stem: str
    files: list[Path]
    record: dict[str, Any]

    @property
    def photo(self) -> str | None:
        """Where its photo was, if the record says so."""
        photo = self.record.get("photo")
        source = photo.get("source") if isinstance(photo, dict) else None
        return source if isinstance(source, str) else None


def read_result(folder: Path, stem: str | None = None) -> Result:
    """Read the result in a folder that `refine` wrote.

    Args:
        folder: of the result.
        stem: which one, where there are several.

    Raises:
        UserError: no folder, no result or several in it, or maps that cannot be read (see `read_maps`).
    """
    records = _records(folder)
    if stem is not None:
        records = {name: record for name, record in records.items() if name == stem}
    if not records:
        wanted = "*" if stem is None else stem
        raise UserError(
            f"There is no {wanted}.json of a result in {folder}; give a folder that refine wrote."
        )
    if len(records) > 1:
        raise UserError(f"{folder} holds the results {', '.join(records)}; say which one with --name.")
    ((name, record),) = records.items()
    try:
        settings = record["settings"]
        extension, normals = MAP_FORMATS[settings["format"]].extension, settings["normals"]
        listed = [folder / Path(file).name for file in record["maps"]["files"].values()]
    except (KeyError, TypeError, AttributeError) as error:
        raise UserError(
            f"{folder / name}.json does not say how its maps are stored; run refine on the photo again."
        ) from error
    svbrdf = read_maps(folder, name, normal_convention=normals, extension=extension)
    maps = [folder / f"{name}_{each}.{extension}" for each in MAP_NAMES]
    return Result(svbrdf, name, sorted({*listed, *maps, folder / f"{name}.json"}), record)


def result_names(folder: Path) -> list[str]:
    """Return the stems of all results in a folder, sorted.

    Raises:
        UserError: there is no folder, or none in it.
    """
    names = list(_records(folder))
    if not names:
        raise UserError(f"There is no *.json of a result in {folder}; give a folder that refine wrote.")
    return names


def _records(folder: Path) -> dict[str, dict[str, Any]]:
    if not folder.is_dir():
        raise UserError(f"{folder} is not a folder; give one that refine wrote, such as slate_material.")
    return {path.stem: record for path in sorted(folder.glob("*.json")) if (record := _record(path))}


def _record(path: Path) -> dict[str, Any] | None:
    """Return a JSON file's content if it is the record of a result."""
    try:
        record = parse_json(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return record if isinstance(record, dict) and record.get("format") == FORMAT else None
