"""What the package depends on, all the way down: `lock`, `oldest` and `notice`, on standard output.

python .ci/dependencies.py lock > .ci/constraints.txt     versions installed here, for pip install -c
python .ci/dependencies.py oldest                         the lower bounds of pyproject.toml, as pins
python .ci/dependencies.py notice                         the licence of every package, for NOTICE
"""

from __future__ import annotations

import re
import sys
import tomllib
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parent.parent
PACKAGE = "svbrdf-refine"
FROM_CLASSIFIER = re.compile(r"License :: (?:OSI Approved :: )?(.+)")
UNSAID = {"atheris": "Apache-2.0"}
"""Licences of packages whose metadata do not name them, from their repositories."""


def wanted() -> list[Requirement]:
    """Return what pyproject.toml asks for, all extras included."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lines = [
        *project["dependencies"],
        *(line for e in project["optional-dependencies"].values() for line in e),
    ]
    return [asked for line in lines if canonicalize_name((asked := Requirement(line)).name) != PACKAGE]


def closure() -> dict[str, Distribution]:
    """Return every installed package that this one needs, by name; what is not installed is left out."""
    found: dict[str, Distribution] = {}
    seen: set[tuple[str, tuple[str, ...]]] = set()
    waiting = wanted()
    while waiting:
        asked = waiting.pop()
        name, extras = canonicalize_name(asked.name), tuple(sorted(asked.extras))
        if (name, extras) in seen:
            continue
        seen.add((name, extras))
        try:
            known = distribution(name)
        except PackageNotFoundError:
            continue
        found[name] = known
        for needed in map(Requirement, known.requires or ()):
            if needed.marker is None or any(needed.marker.evaluate({"extra": e}) for e in (*extras, "")):
                waiting.append(needed)
    return dict(sorted(found.items()))


def licence(package: Distribution) -> str:
    """Return a package's licence in a few words, as its metadata state it."""
    metadata = package.metadata
    name = canonicalize_name(metadata["Name"])
    if expression := metadata.get("License-Expression"):
        return str(expression)
    classifiers = (FROM_CLASSIFIER.fullmatch(line) for line in metadata.get_all("Classifier") or ())
    named = [match[1] for match in classifiers if match is not None and match[1] != "OSI Approved"]
    if named:
        return ", ".join(dict.fromkeys(named))
    text = (metadata.get("License") or "").strip().splitlines()
    return text[0][:60] if text else UNSAID.get(name, "not stated")


def lower_bounds() -> list[str]:
    """Return the lower bounds of pyproject.toml as pins."""
    pins = {
        canonicalize_name(asked.name): bound.version
        for asked in wanted()
        for bound in asked.specifier
        if bound.operator == ">="
    }
    return [f"{name}=={version}" for name, version in sorted(pins.items())]


def main() -> None:
    """Print what is asked for."""
    what = sys.argv[1] if len(sys.argv) == 2 else ""
    if what == "lock":
        print("# Versions CI runs with; python .ci/dependencies.py lock makes this file anew.")
        for name, package in closure().items():
            print(f"{name}=={package.version.partition('+')[0]}")
    elif what == "oldest":
        print("\n".join(lower_bounds()))
    elif what == "notice":
        for name, package in closure().items():
            print(f"{name}: {licence(package)}")
    else:
        sys.exit(f"{__doc__}")


if __name__ == "__main__":
    main()
