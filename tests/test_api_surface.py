"""Public names and options that others rely on: losing one fails here, adding one does not."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import re
import tomllib
from pathlib import Path

import pytest
from typer.main import get_command

import refine

ROOT = Path(__file__).parent.parent

PUBLIC = {
    "refine": "RECIPES SVBRDF Camera PointLight Recipe Refined Refiner UserError __version__",
    "refine.refiner": "Refined Refiner",
    "refine.stages": "GlobalStage LatentStage PixelStage Rates Recipe RECIPES find_recipe",
    "refine.photo": "Photo photo_from_array read_photo",
    "refine.maps": "MapFormat map_paths read_maps write_maps",
    "refine.export": "TARGETS export_material",
    "refine.viewer": "build_page",
    "refine.capture": "Capture",
    "nets.architectures": "CONFIGS build find_config kind_of",
    "nets.baselines.autoencoder": "Autoencoder AutoencoderConfig NARROW_AUTOENCODER PAPER_AUTOENCODER",
    "nets.baselines.des18": "Des18 Des18Config NARROW_DES18 PAPER_DES18",
    "nets.baselines.des19": "Des19 Des19Config NARROW_DES19 PAPER_DES19",
    "nets.checkpoint": (
        "CheckpointError Record load_autoencoder load_model load_network read_record save_model"
    ),
    "nets.generator": "Generator GeneratorConfig PAPER_GENERATOR NARROW_GENERATOR",
    "nets.discriminator": "Discriminator",
    "nets.render": "Camera Conventions PRESETS PointLight render",
    "nets.sampling": "LightDistribution",
    "nets.svbrdf": "CHANNELS MAPS SVBRDF",
    "nets.trainer": "Trainer",
    "nets.training": "Alone Losses Objective Phase Team TrainerConfig TrainingBatch",
    "nets.data": "DataError",
    "nets.data.procedural": "FAMILIES generate random_material",
    "losses.baselines": "AutoencoderObjective DES18 DES19 GAO19 RenderingObjective",
    "losses.objective": "HybridObjective L1Objective RealObjective SyntheticObjective",
    "losses.presets": "AS_CODED NARROW PAPER PRESETS find_objective",
    "losses.perceptual": "LPIPS",
    "losses.refinement": "photo_distance",
}

PARAMETERS = {
    ("refine", "Refiner"): "model recipe camera resolution seed device",
    ("refine", "Refiner.fit"): "self img light iters color_space progress",
    ("refine", "Refined.render"): "self light camera",
    ("refine", "Refined.save"): "self folder stem format normal_convention",
    ("refine.export", "export_material"): "svbrdf folder stem targets format tile",
    ("nets.checkpoint", "load_model"): "name",
    ("nets.render", "render"): "svbrdf light camera conventions",
    ("nets.render", "PointLight.at"): "position intensity falloff dtype",
}

FIELDS = {
    ("refine", "Refined"): "svbrdf initial light camera capture losses seconds recipe notes source",
    ("refine", "Recipe"): "name light_fit stages",
    ("refine", "SVBRDF"): "normal diffuse roughness specular",
    ("refine", "PointLight"): "position intensity falloff",
    ("refine", "Camera"): "kind position",
}

SCRIPTS = {"refine", "refine-train", "refine-eval"}

OPTIONS = {
    "refine.cli": "light falloff camera color-space resolution init recipe iters quick seed out format "
    "normals no-report export json quiet device threads workers scheduler version",
    "refine.export.cli": "to tile format name out quiet",
    "refine.viewer.cli": "html no-browser quiet",
    "refine.video.cli": "to path seconds fps size radius height falloff exposure name quiet",
    "refine.train": "config data out pairs stage start resume steps vgg accelerator devices nodes threads "
    "seed save-every data-note",
}


def find(module: str, path: str) -> object:
    found: object = importlib.import_module(module)
    for name in path.split("."):
        found = getattr(found, name)
    return found


@pytest.mark.parametrize("module", PUBLIC)
def test_names_are_there(module: str) -> None:
    for name in PUBLIC[module].split():
        assert hasattr(importlib.import_module(module), name), f"{module}.{name} is lost"


def test_refine_says_what_it_offers() -> None:
    assert set(PUBLIC["refine"].split()) - {"__version__"} <= set(refine.__all__) <= set(dir(refine))
    with pytest.raises(AttributeError, match="no attribute 'soup'"):
        refine.soup  # noqa: B018
    assert re.fullmatch(r"\d+\.\d+\.\d+.*|0\+source", refine.__version__)


@pytest.mark.parametrize(("module", "path"), PARAMETERS, ids=lambda value: str(value))
def test_parameters_are_there_in_order(module: str, path: str) -> None:
    found = list(inspect.signature(find(module, path)).parameters)  # type: ignore[arg-type]
    expected = PARAMETERS[module, path].split()
    assert [name for name in found if name in expected] == expected


@pytest.mark.parametrize(("module", "path"), FIELDS, ids=lambda value: str(value))
def test_fields_are_there_in_order(module: str, path: str) -> None:
    found = [field.name for field in dataclasses.fields(find(module, path))]  # type: ignore[arg-type]
    assert found[: len(FIELDS[module, path].split())] == FIELDS[module, path].split()


def test_defaults_that_results_depend_on() -> None:
    defaults = {
        name: parameter.default for name, parameter in inspect.signature(refine.Refiner).parameters.items()
    }
    assert defaults["model"] == "default"
    assert defaults["recipe"] == "default"
    assert (defaults["resolution"], defaults["seed"], defaults["device"]) == (256, 0, "cpu")
    assert inspect.signature(importlib.import_module("nets.checkpoint").load_model).parameters[
        "name"
    ].default == ("default")


def test_targets_of_exports_are_there() -> None:
    targets = importlib.import_module("refine.export").TARGETS
    assert {"materialx", "gltf", "usd", "blender", "orm", "unity", "height", "tile"} <= set(targets)


def test_recipes_are_there() -> None:
    assert {"paper"} <= set(refine.RECIPES)


def test_console_scripts_can_be_called() -> None:
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    assert set(scripts) >= SCRIPTS
    for target in scripts.values():
        module, _, attribute = target.partition(":")
        assert callable(find(module, attribute))


@pytest.mark.parametrize("module", OPTIONS)
def test_options_are_there(module: str) -> None:
    command = get_command(importlib.import_module(module).app)
    offered = {option for parameter in command.params for option in parameter.opts}
    assert {f"--{name}" for name in OPTIONS[module].split()} - offered == set()
