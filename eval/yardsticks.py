"""What the paper's two tables measure on one test set: scenes by index, and the scores of a row on one.

Plain values that another process can be handed. Protocols are those of `development.py` (Table 1) and
`real.py` (Table 2).
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

from eval import held_out
from eval.datasets import CAMERA, YARDSTICK, Scene, list_scenes, make_scene, read_scene
from eval.datasets import Protocol as Settings
from eval.development import as_photo
from eval.metrics import evaluate_material
from eval.real import exposure, score_estimate
from eval.real_scenes import CAMERA as CAMERA_AT_FLASH
from eval.real_scenes import RealScene, SceneLights, list_real_scenes, read_real_scene
from losses.perceptual import LPIPS
from nets.data.images import DataError
from nets.data.pool_format import decode
from nets.render import Camera
from refine.refiner import Refined, Refiner


@runtime_checkable
class Yardstick(Protocol):
    """A test set and how it is measured."""

    @property
    def name(self) -> str:
        """Of the test set."""

    @property
    def camera(self) -> Camera:
        """That took the photos."""

    @property
    def size(self) -> int:
        """Pixels of photos and maps."""

    @property
    def seed(self) -> int:
        """Of everything random."""

    @property
    def flips(self) -> bool:
        """Whether networks are averaged over mirrored photos."""

    def scenes(self) -> list[str]:
        """Return the names of the scenes."""

    def caption(self) -> str:
        """Return sentences that say how the figures came about."""

    def key(self, index: int) -> dict[str, Any]:
        """Return everything a score of this scene depends on, but for the row."""

    def read(self, index: int) -> Any:
        """Read a scene; raises `DataError`."""

    def answer(self, scene: Any, refiner: Refiner, *, refine: bool) -> Refined:
        """Return the network's answer to the scene's photo, or its refinement."""

    def score(self, scene: Any, refined: Refined, lpips: LPIPS) -> dict[str, Any]:
        """Return the answer's scores and seconds; raises `ValueError` for maps that cannot be scored."""


@dataclass(frozen=True)
class Synthetic:
    """Known materials under novel lights: Table 1.

    Attributes:
        folder: of strips or of PBR folders; None is the built-in set.
        protocol: size, lights and seed.
        estimate_light: withhold the light of the photo.
        flips: as in `Yardstick`.
    """

    folder: Path | None
    protocol: Settings = YARDSTICK
    estimate_light: bool = False
    flips: bool = True
    camera: Camera = CAMERA

    @staticmethod
    def named(name: str) -> Path | None:
        """Return the folder of a set as the command line names it."""
        return None if name == held_out.NAME else Path(name)

    @property
    def name(self) -> str:
        """Of the test set."""
        return held_out.NAME if self.folder is None else self.folder.resolve().name

    @property
    def size(self) -> int:
        """Pixels of photo and maps."""
        return self.protocol.size

    @property
    def seed(self) -> int:
        """Of the novel lights and of refinement."""
        return self.protocol.seed

    def scenes(self) -> list[str]:
        """Return the names of the scenes.

        Raises:
            DataError: the folder is missing or holds none.
        """
        return held_out.scene_names() if self.folder is None else [path.stem for path in self._paths()[1]]

    def caption(self) -> str:
        """Return sentences that say how the figures came about."""
        limits = f"{held_out.LIMITS}. " if self.folder is None else ""
        return (
            f"{limits}One photo in, under a centred light {'not ' if self.estimate_light else ''}told; "
            f"{self.size} px, {self.protocol.lights} novel lights per scene, seed {self.seed}. RMSE of maps "
            f"linear (D gamma, S gamma: encoded with 1/2.2), of renderings encoded; LPIPS v0.1 AlexNet"
            f"{_flips(self.flips)}."
        )

    def key(self, index: int) -> dict[str, Any]:
        """Return everything a score of this scene depends on, but for the row."""
        if self.folder is None:
            name = held_out.scene_names()[index]
            content = hashlib.sha256(held_out.material(name).numpy().tobytes()).hexdigest()[:16]
        else:
            path = self._paths()[1][index]
            name, content = path.stem, _content(path)
        settings = {"estimate_light": self.estimate_light, "flips": self.flips, **asdict(self.protocol)}
        return {"set": self.name, "scene": name, "index": index, "content": content, **settings}

    def read(self, index: int) -> Scene:
        """Read a scene.

        Raises:
            DataError: it cannot be read.
        """
        if self.folder is None:
            name = held_out.scene_names()[index]
            return make_scene(name, decode(held_out.material(name)), index, self.protocol)
        kind, paths = self._paths()
        return read_scene(paths[index], kind, index, self.protocol)

    def answer(self, scene: Scene, refiner: Refiner, *, refine: bool) -> Refined:
        """Return the network's answer to the scene's photo, or its refinement."""
        light = None if self.estimate_light else scene.photo_light
        return refiner.fit(as_photo(scene), light=light, iters=None if refine else 0)

    def score(self, scene: Scene, refined: Refined, lpips: LPIPS) -> dict[str, Any]:
        """Return the answer's scores and seconds."""
        scores = evaluate_material(refined.svbrdf, scene.truth, scene.lights, CAMERA, lpips=lpips)
        return asdict(scores) | {"seconds": _seconds(refined)}

    def _paths(self) -> tuple[Literal["strips", "pbr"], list[Path]]:
        assert self.folder is not None
        strips = self.folder.is_dir() and any(p.suffix.lower() == ".png" for p in self.folder.iterdir())
        kind: Literal["strips", "pbr"] = "strips" if strips else "pbr"
        return kind, list_scenes(self.folder, kind)


@dataclass(frozen=True)
class Real:
    """Real surfaces, one photo of each given, the others the truth: Table 2.

    Attributes:
        folder: holds a folder of photos per surface.
        size: longer side of the photos, pixels.
        seed: of refinement.
        match_exposure: refine under a light as bright as the initialization needs it, not 1.
        lights: of scenes by name, in place of what their folders say.
        flips: as in `Yardstick`.
    """

    folder: Path
    size: int = YARDSTICK.size
    seed: int = 0
    match_exposure: bool = False
    lights: Mapping[str, SceneLights] = field(default_factory=dict)
    flips: bool = True
    camera: Camera = CAMERA_AT_FLASH

    @property
    def name(self) -> str:
        """Of the test set."""
        return self.folder.resolve().name

    def scenes(self) -> list[str]:
        """Return the names of the scenes.

        Raises:
            DataError: the folder is missing or holds none.
        """
        return [path.name for path in list_real_scenes(self.folder)]

    def caption(self) -> str:
        """Return sentences that say how the figures came about."""
        brightness = "as bright as the initialization needs it" if self.match_exposure else "of intensity 1"
        solved = "solved once for all rows" if self.lights else "as the scenes come with them"
        return (
            f"Given is the photo whose light is most central, and that light, {brightness}; the others are "
            f"the truth. Lights {solved}; the first two columns leave out scenes of uncertain ones. "
            f"{self.size} px, seed {self.seed}; RMSE encoded with 1/2.2, LPIPS v0.1 AlexNet, one exposure "
            f"per estimate{_flips(self.flips)}."
        )

    def key(self, index: int) -> dict[str, Any]:
        """Return everything a score of this scene depends on, but for the row."""
        path = list_real_scenes(self.folder)[index]
        known = self.lights.get(path.name)
        return {
            "set": self.name,
            "scene": path.name,
            "content": _content(path),
            "lights": None if known is None else {**asdict(known), "believable": known.believable},
            "size": self.size,
            "seed": self.seed,
            "match_exposure": self.match_exposure,
            "flips": self.flips,
        }

    def read(self, index: int) -> RealScene:
        """Read a scene.

        Raises:
            DataError: it cannot be used.
        """
        path = list_real_scenes(self.folder)[index]
        return read_real_scene(path, self.size, self.lights.get(path.name))

    def answer(self, scene: RealScene, refiner: Refiner, *, refine: bool) -> Refined:
        """Return the network's answer to the scene's photo, or its refinement."""
        light = scene.light
        if refine and self.match_exposure:
            first = refiner.fit(scene.photo, light=light, iters=0)
            light = replace(light, intensity=exposure(first.initial, scene) * light.intensity)
        return refiner.fit(scene.photo, light=light, iters=None if refine else 0)

    def score(self, scene: RealScene, refined: Refined, lpips: LPIPS) -> dict[str, Any]:
        """Return the answer's scores and seconds; raises `ValueError` if it renders to NaN."""
        factor, rendering, distance = score_estimate(refined.svbrdf, scene, lpips)
        if not (math.isfinite(rendering) and math.isfinite(distance)):
            raise ValueError("the estimate renders to NaN or infinity")
        return {
            "lights_are": scene.lights_are,
            "exposure": factor,
            "rendering": rendering,
            "lpips": distance,
            "seconds": _seconds(refined),
        }


def _flips(flips: bool) -> str:
    return "; networks averaged over four flips" if flips else ""


def _seconds(refined: Refined) -> float:
    return sum(refined.seconds.values())


def _content(path: Path) -> str:
    """Return a digest of a file, or of all files of a folder."""
    files = sorted(file for file in path.rglob("*") if file.is_file()) if path.is_dir() else [path]
    digest = hashlib.sha256()
    try:
        for file in files:
            digest.update(file.name.encode() + b"\0" + hashlib.sha256(file.read_bytes()).digest())
    except OSError as error:
        raise DataError(f"{path} cannot be read ({error})") from None
    return digest.hexdigest()[:16]
