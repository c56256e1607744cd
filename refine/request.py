"""What is asked of photos, as data: done alike in this process, in workers and on a cluster.

Imports nothing heavy, so that a request can be made, compared and sent before torch is loaded.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

from refine.arguments import parse_camera, parse_point
from refine.errors import UserError
from refine.limits import GIB, require_memory

if TYPE_CHECKING:
    from nets.render import PointLight
    from refine.light import FalloffChoice
    from refine.photo import ColorSpaceChoice, Photo
    from refine.refiner import Refined, Refiner
    from refine.result import Output
    from refine.run import Report
    from refine.stages import Recipe

ESTIMATED = "estimated"
"""A light that is not given."""

NOT_SETTINGS = ("report", "uncertainty", "thumbnail", "export", "max_memory")
"""What decides which files are written, not what is in them: the record lists the files themselves."""


@dataclass(frozen=True)
class Request:
    """The options of a command line, checked, by the names they have there; photos and folder aside.

    Attributes:
        init: name or file of a checkpoint.
        recipe: name of a recipe.
        iters: steps of all stages; None takes the recipe's.
        engine: name of an engine, or `auto`.
        resolution: longer side of the maps, pixels; 0 keeps the photo's.
        light: `X,Y,Z`, or `estimated`.
        one_surface: whether all photos show one surface.
        align: whether they are brought into register first.
        lights: where the positions of their flashes are.
        falloff: `none`, `inverse_square` or `auto`.
        camera: a kind, or `X,Y,Z`.
        color_space: how photos are encoded.
        normals: what the green channel of the normal file means.
        format: of the maps' files.
        device: where to compute.
        seed: of everything random.
        threads: of the CPU.
        report: whether the report is drawn.
        uncertainty: whether deviations are written.
        thumbnail: whether a small picture for an index is written.
        export: targets of `refine.export`.
        max_memory: GiB that a photo may take; None allows what is free.
    """

    init: str
    recipe: str
    iters: int | None
    engine: str
    resolution: int
    light: str
    one_surface: bool
    align: bool
    lights: Path | None
    falloff: str
    camera: str
    color_space: str
    normals: str
    format: str
    device: str
    seed: int
    threads: int
    report: bool = True
    uncertainty: bool = False
    thumbnail: bool = False
    export: tuple[str, ...] = ()
    max_memory: float | None = None

    def settings(self) -> dict[str, Any]:
        """Return what a result's record says was asked for, as JSON holds it."""
        settings = {name: value for name, value in asdict(self).items() if name not in NOT_SETTINGS}
        return {**settings, "lights": None if self.lights is None else self.lights.name}

    def steps(self) -> Recipe:
        """Return the recipe with the iterations asked for."""
        from refine.stages import find_recipe

        recipe = find_recipe(self.recipe)
        return recipe if self.iters is None else recipe.with_iterations(self.iters)

    def output(self, folder: Path, stem: str) -> Output:
        """Return where and how a result is written."""
        from refine.result import Output

        return Output(
            folder,
            stem,
            self.format,
            cast(Literal["opengl", "directx"], self.normals),
            report=self.report,
            uncertainty=self.uncertainty,
            thumbnail=self.thumbnail,
        )

    def refiner(self) -> Refiner:
        """Load the network and set up.

        Raises:
            nets.checkpoint.CheckpointError: the network cannot be loaded.
        """
        from nets.render import Camera
        from refine.refiner import Refiner

        kind, position = parse_camera(self.camera)
        return Refiner(
            self.init,
            self.recipe,
            camera=Camera(kind) if position is None else Camera(kind, position),
            resolution=self.resolution or None,
            seed=self.seed,
            device=self.device,
            engine=None if self.engine == "auto" else self.engine,
        )

    def flash(self, photos: Sequence[Path]) -> PointLight | None:
        """Return the light or lights that are known.

        Raises:
            refine.errors.UserError: the file of lights cannot be read.
        """
        from nets.render import PointLight
        from refine.known_lights import read_lights

        falloff = cast(Literal["none", "inverse_square"], self.falloff)
        if self.light != ESTIMATED:
            position = parse_point("--light", self.light, "or leave it out to have it estimated")
            return PointLight.at(position, falloff=falloff).to(self.device)
        return None if self.lights is None else read_lights(self.lights, photos, falloff)

    def read(self, photo: Path) -> Photo:
        """Read a photo as linear light.

        Raises:
            refine.errors.UserError: it cannot be used.
        """
        from nets.decoding import Limits
        from refine.photo import read_photo

        limits = Limits()
        if self.max_memory is not None:
            limits = Limits(memory=min(limits.memory, int(self.max_memory * GIB)))
        return read_photo(photo, color_space=cast("ColorSpaceChoice", self.color_space), limits=limits)

    def require_memory(self, refiner: Refiner, photos: Sequence[Photo]) -> int:
        """Estimate the memory that refinement takes, in bytes.

        Raises:
            refine.errors.UserError: it is more than is allowed, or free.
        """
        longest = max(photos[0].size)
        scale = min(1.0, self.resolution / longest) if self.resolution else 1.0
        size = round(photos[0].size[0] * scale), round(photos[0].size[1] * scale)
        return require_memory(size, refiner.engine, len(photos), allowed=self.max_memory)

    def fit(
        self,
        refiner: Refiner,
        photos: Sequence[Photo],
        flash: PointLight | None,
        progress: Report | None = None,
    ) -> Refined:
        """Recover the material of a photo, or of one surface in several.

        Raises:
            refine.errors.UserError: as `Refiner.fit` and `Refiner.fit_many`.
        """
        self.require_memory(refiner, photos)
        falloff = None if flash is not None else cast("FalloffChoice", self.falloff)
        if self.one_surface:
            return refiner.fit_many(
                photos, lights=flash, falloff=falloff, align=self.align, iters=self.iters, progress=progress
            )
        return refiner.fit(photos[0], light=flash, falloff=falloff, iters=self.iters, progress=progress)


@contextmanager
def enough_memory() -> Iterator[None]:
    """Turn what allocators raise, in their several ways, into one sentence.

    Raises:
        UserError: there was not enough memory.
    """
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        text = str(error).lower()
        if isinstance(error, MemoryError) or "out of memory" in text or "can't allocate memory" in text:
            raise UserError(
                "There is not enough memory for this size; ask for a lower --resolution."
            ) from None
        raise
