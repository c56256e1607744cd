"""`Refiner`: photo in, material out. The whole of refinement in one straight line."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nets.checkpoint import load_model
from nets.ensemble import FlipAverage
from nets.render import Camera, PointLight
from nets.svbrdf import SVBRDF
from refine.alignment import align as align_photos
from refine.alignment import require_one_size
from refine.bands import render_in_bands
from refine.calibration import SelfCalibration
from refine.capture import Capture
from refine.engine import choose_engine
from refine.errors import UserError
from refine.initialization import Predict, Predictor, initialize
from refine.latent import require_weights
from refine.light import FalloffChoice, check_falloff, fit_light, fit_light_and_falloff
from refine.maps import MapFormat, NormalConvention, write_maps
from refine.memory import StageMemory
from refine.photo import ColorSpaceChoice, Photo, as_photo, resize_photo
from refine.run import Report, StagesStopped, run_stages
from refine.several import complete, find_lights, initialize_together
from refine.stages import Recipe, find_recipe
from refine.uncertainty import deviations

DEFAULT_RESOLUTION = 256
"""Longer side of the maps, pixels: what the network was trained on."""

DEFAULT_RECIPE = "default"


@dataclass(frozen=True)
class Refined:
    """The result of one fit.

    Attributes:
        svbrdf: the refined maps.
        initial: the maps refinement started from.
        light: the light used, given or estimated.
        camera: the camera used.
        capture: the photo as it was explained.
        losses: loss before every step and after the last, by stage name.
        seconds: wall-clock time by stage name.
        recipe: what was done.
        notes: everything done to the photo, in plain words.
        source: file name of the photo, or `array`.
        settings: what else is worth knowing of how it was made.
        engine: that ran the stages, see `refine.engine`.
        others: further photos of the surface, each with its light; `capture` is the first.
        interrupted: whether Ctrl-C ended the stages early; the maps are the best until then.
    """

    svbrdf: SVBRDF
    initial: SVBRDF
    light: PointLight
    camera: Camera
    capture: Capture
    losses: dict[str, list[float]]
    seconds: dict[str, float]
    recipe: Recipe
    notes: tuple[str, ...] = ()
    source: str = "array"
    settings: dict[str, Any] = field(default_factory=dict)
    engine: str = "reference"
    others: tuple[Capture, ...] = ()
    interrupted: bool = False

    def render(self, light: PointLight | None = None, camera: Camera | None = None) -> Tensor:
        """Render the refined maps, linear `[1, 3, H, W]`; defaults to the photo's light and camera."""
        return render_in_bands(self.svbrdf, light or self.light, camera or self.camera)

    @property
    def captures(self) -> tuple[Capture, ...]:
        """All photos that were explained, each with its light."""
        return self.capture, *self.others

    @cached_property
    def deviations(self) -> dict[str, Float[Tensor, "1 1 h w"]]:
        """How far each map is likely to be off, by map name, in its units; see `refine.uncertainty`.

        Computed when it is first asked for. The errors it expects beforehand were measured with the shipped
        network and the recipe `default`; with others it is a rougher guess.
        """
        return deviations(self.initial, self.svbrdf, self.captures)

    def save(
        self,
        folder: str | Path,
        stem: str | None = None,
        *,
        format: MapFormat | None = None,
        normal_convention: NormalConvention = "opengl",
    ) -> dict[str, Path]:
        """Write maps and re-rendering to `folder` as `<stem>_normal.png` and so on; see `refine.maps`."""
        return write_maps(
            folder,
            stem or (Path(self.source).stem if self.source != "array" else "material"),
            self.svbrdf,
            rendering=self.render(),
            format=format,
            normal_convention=normal_convention,
        )


class Interrupted(KeyboardInterrupt):
    """Ctrl-C ended the stages early.

    Attributes:
        refined: the best until then.
    """

    def __init__(self, refined: Refined) -> None:
        """Keep what was reached."""
        super().__init__()
        self.refined = refined


class Refiner:
    """Turns photos into materials with one model and one recipe.

    Example:
        >>> refined = Refiner("default").fit("photo.jpg", iters=100)  # doctest: +SKIP
        >>> refined.save("out")  # doctest: +SKIP
    """

    def __init__(
        self,
        model: str | Path | Predict | Predictor = "default",
        recipe: str | Recipe = DEFAULT_RECIPE,
        *,
        camera: Camera | None = None,
        resolution: int | None = DEFAULT_RESOLUTION,
        flips: bool = True,
        seed: int = 0,
        device: str | torch.device = "cpu",
        engine: str | None = None,
        memory: StageMemory | None = None,
    ) -> None:
        """Set up.

        Args:
            model: a checkpoint's name or path, or any callable from a linear photo `[1, 3, 256, 256]` to
                an `SVBRDF` of that size and a `PointLight`.
            recipe: a name in `refine.stages.RECIPES`, or a `Recipe`.
            camera: how photos were taken; by default the authors' perspective camera for one photo, and at
                the flash for several.
            resolution: longer side of the maps in pixels; None keeps the photo's.
            flips: average a named checkpoint's guess over four mirrored photos (`nets.ensemble`).
            seed: of everything random, for models or recipes that draw numbers.
            device: where to compute.
            engine: a name in `refine.engine.ENGINES`; None takes the fastest for the device.
            memory: of latent stages, shared by refiners of the same photos (`refine.memory`).

        Raises:
            nets.checkpoint.CheckpointError: if a named checkpoint, or the auto-encoder of a recipe, cannot be
                loaded.
            ValueError: for an unknown recipe, or an engine that is not there for the device.
        """
        self.device = torch.device(device)
        self.engine = choose_engine(engine, self.device.type)
        if isinstance(model, str | Path):
            network = load_model(model)
            network.to(self.device)
            model = FlipAverage(network) if flips else network
        self.model = model
        self.recipe = find_recipe(recipe) if isinstance(recipe, str) else recipe
        require_weights(self.recipe)
        self.camera = camera or Camera()
        self.camera_of_several = camera or Camera("collocated")
        self.resolution = resolution
        self.seed = seed
        self.memory = memory

    def fit(
        self,
        img: str | Path | Photo | np.ndarray | Tensor,
        *,
        light: PointLight | None = None,
        falloff: FalloffChoice = None,
        iters: int | None = None,
        color_space: ColorSpaceChoice = "auto",
        progress: Report | None = None,
    ) -> Refined:
        """Recover the material of one photo.

        Args:
            img: a file, an array `[H, W, C]` or a tensor `[3, H, W]`; see `refine.photo` for how values
                become linear light.
            light: the flash, if known; otherwise the light head's estimate, fitted to the photo.
            falloff: of a light that is not known: `none` (the paper's), `inverse_square` (a real flash's),
                or `auto`, which keeps what explains the photo better and needs a light fit; None is what the
                model says.
            iters: steps of all stages together; None takes the recipe's, 0 returns the initialization.
            color_space: how `img` is encoded.
            progress: called after every iteration.

        Raises:
            refine.errors.UserError: if the photo cannot be read or used.
            Interrupted: Ctrl-C was pressed during the stages; it holds the best until then.
            ValueError: if `iters` is negative, or for an unknown falloff.
        """
        check_falloff(falloff)
        torch.manual_seed(self.seed)
        recipe = self.recipe if iters is None else self.recipe.with_iterations(iters)
        photo = self._resized(as_photo(img, color_space))
        capture = self._capture(photo, self.camera, light)
        seconds: dict[str, float] = {}

        clock = time.perf_counter()
        initial, guess = initialize(self.model, capture.photo, light, self.camera)
        if falloff is not None and falloff != "auto":
            guess = replace(guess, falloff=falloff)
        seconds["initialization"] = time.perf_counter() - clock

        if light is None and recipe.light_fit is not None and recipe.iterations > 0:
            clock = time.perf_counter()
            fit = fit_light_and_falloff if falloff == "auto" else fit_light
            light = fit(initial, guess, capture, recipe.light_fit).to(self.device)
            seconds["light"] = time.perf_counter() - clock
        light = light or guess
        capture = replace(capture, light=light)
        return self._explain(initial, (capture,), self.camera, recipe, seconds, photo.notes, progress)

    def fit_many(
        self,
        imgs: Sequence[str | Path | Photo | np.ndarray | Tensor],
        *,
        lights: PointLight | None = None,
        falloff: FalloffChoice = None,
        align: bool = False,
        iters: int | None = None,
        color_space: ColorSpaceChoice = "auto",
        progress: Report | None = None,
        calibration: SelfCalibration | None = None,
    ) -> Refined:
        """Recover the material of one surface from several photos under different lights.

        The recipe `default`, made for one photo, gives way to `several`.

        Args:
            imgs: two or more, each as `fit` takes it.
            lights: where the flash was, one per photo as a batch, if known; only each photo's exposure is
                fitted then. Otherwise lights and exposures are found together (`refine.calibration`).
            falloff: of lights that are not known; None is a real flash's, `inverse_square`.
            align: bring hand-held photos into register with the first (`refine.alignment`).
            iters: as in `fit`.
            color_space: as in `fit`.
            progress: as in `fit`.
            calibration: settings of the search for the lights.

        Returns:
            The result, whose photo and light are the first one's.

        Raises:
            refine.errors.UserError: a photo cannot be read or used, sizes differ, or alignment fails.
            Interrupted: as in `fit`.
            ValueError: if `iters` is negative, for an unknown falloff, or for another number of lights.
        """
        check_falloff(falloff)
        if len(imgs) < 2:
            raise UserError("One surface in several photos needs two or more; give more, or use one alone.")
        if lights is not None and len(lights.position) != len(imgs):
            raise ValueError(f"{len(lights.position)} lights are given for {len(imgs)} photos")
        torch.manual_seed(self.seed)
        recipe = find_recipe("several") if self.recipe == find_recipe(DEFAULT_RECIPE) else self.recipe
        recipe = recipe if iters is None else recipe.with_iterations(iters)
        photos = [self._resized(as_photo(img, color_space)) for img in imgs]
        seconds: dict[str, float] = {}

        clock = time.perf_counter()
        if align:
            photos, visible = align_photos(photos)
            visible = [seen.to(self.device) for seen in visible]
            seconds["alignment"] = time.perf_counter() - clock
        else:
            require_one_size(photos)
            visible = [torch.ones_like(photo.unsaturated, device=self.device) for photo in photos]
        captures = [self._capture(photo, self.camera_of_several) for photo in photos]

        clock = time.perf_counter()
        initial = initialize_together(self.model, captures, visible)
        seconds["initialization"] = time.perf_counter() - clock

        clock = time.perf_counter()
        found = find_lights(initial, captures, falloff, lights, calibration or SelfCalibration())
        seconds["lights"] = time.perf_counter() - clock
        lit = [replace(capture, light=light) for capture, light in zip(captures, found, strict=True)]
        lit = [complete(capture, seen, initial) for capture, seen in zip(lit, visible, strict=True)]
        notes = (*photos[0].notes, f"the first of {len(photos)} photos of one surface")
        return self._explain(initial, tuple(lit), self.camera_of_several, recipe, seconds, notes, progress)

    def _explain(
        self,
        initial: SVBRDF,
        captures: tuple[Capture, ...],
        camera: Camera,
        recipe: Recipe,
        seconds: dict[str, float],
        notes: tuple[str, ...],
        progress: Report | None,
    ) -> Refined:
        """Run the stages on photos whose lights are known, and put everything that is known together."""
        stopped = False
        try:
            found, losses = run_stages(initial, captures, recipe, seconds, progress, self.engine, self.memory)
        except StagesStopped as stop:
            stopped, found, losses = True, stop.svbrdf, stop.losses
        light = captures[0].light
        assert light is not None
        refined = Refined(
            found.detach(),
            initial,
            light,
            camera,
            captures[0],
            losses,
            seconds,
            recipe,
            notes,
            captures[0].source,
            engine=self.engine,
            others=captures[1:],
            interrupted=stopped,
        )
        if stopped:
            raise Interrupted(refined)
        return refined

    def _resized(self, photo: Photo) -> Photo:
        return photo if self.resolution is None else resize_photo(photo, self.resolution)

    def _capture(self, photo: Photo, camera: Camera, light: PointLight | None = None) -> Capture:
        # Light of 1 and more is clipped, whatever the file's own range is: it only says "at least 1".
        unsaturated = photo.unsaturated & (photo.linear < 1.0).all(dim=1, keepdim=True)
        linear = photo.linear.clamp(max=1.0).to(self.device)
        return Capture(linear, unsaturated.to(self.device), camera, light, photo.notes, photo.source)
