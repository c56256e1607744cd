"""Training plans: those that are shipped say what the paper says, and every mistake is one sentence."""

from __future__ import annotations

import copy
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml

from losses.baselines import DES18, DES19, GAO19
from losses.light import LightObjective
from losses.objective import HybridObjective, L1Objective, SyntheticObjective
from losses.presets import NARROW, PAPER, override
from nets.architectures import build
from nets.baselines.autoencoder import NARROW_AUTOENCODER
from nets.baselines.des18 import NARROW_DES18
from nets.baselines.des19 import NARROW_DES19
from nets.generator import NARROW_GENERATOR, PAPER_GENERATOR
from nets.training import Phase
from refine.training_plan import PlanError, Stage, plan_of, read_plan
from tests.training_files import CRITICS, GENERATOR, STAGES, write_plan

CONFIGS = Path(__file__).parent.parent.parent / "configs"


# What is shipped


def test_the_paper_s_plan_has_the_paper_s_numbers() -> None:
    plan = read_plan(CONFIGS / "paper.yaml")
    assert {stage.network for stage in plan.stages} == {PAPER_GENERATOR}
    assert PAPER_GENERATOR.width == 64
    assert plan.critics == {"width": 64, "layers": 3, "scales": 2}
    assert [stage.name for stage in plan.stages] == ["maps", "syn", "hyb"]
    assert [stage.trainer.iterations for stage in plan.stages] == [250_000, 200_000, 100_000]
    for stage in plan.stages:
        assert [(phase.crop, phase.batch, phase.shards) for phase in stage.trainer.phases] == [(256, 4, 1)]
        for iteration in (0, 1, stage.trainer.iterations - 1):
            assert stage.trainer.learning_rate_at(iteration) == pytest.approx(2e-5)
        assert stage.trainer.beta1 == 0.5
        assert stage.trainer.critic_factor == 1.0
        assert stage.trainer.gradient_clip >= 1e9
    maps, syn, hyb = (stage.objective for stage in plan.stages)
    assert maps == override(PAPER.synthetic, {"rendering_weight": 0.0})
    assert (syn, hyb) == (PAPER.synthetic, PAPER)
    assert [stage.pairs for stage in plan.stages] == [0, 0, 1]
    assert plan.precision == "32-true"
    (varied,) = {stage.augmentation for stage in plan.stages}
    assert (varied.mix_probability, varied.hue, varied.relief, varied.metal) == (0.0, 0.0, 0.0, 0.0)


def test_the_narrow_plan_is_of_the_network_that_is_shipped() -> None:
    plan = read_plan(CONFIGS / "narrow.yaml")
    assert [stage.name for stage in plan.stages] == ["l1", "syn", "light", "hyb0", "revise", "relief", "hyb"]
    first = replace(NARROW_GENERATOR, revision_channels=0, revision_passes=1)
    once = replace(NARROW_GENERATOR, revision_passes=1)
    assert [stage.network for stage in plan.stages] == [*[first] * 4, once, *[NARROW_GENERATOR] * 2]
    kinds = (L1Objective, SyntheticObjective, LightObjective, HybridObjective)
    kinds = (*kinds, SyntheticObjective, SyntheticObjective, HybridObjective)
    for stage, kind in zip(plan.stages, kinds, strict=True):
        assert isinstance(stage.objective, kind)
        assert {phase.shards for phase in stage.trainer.phases} == {2}
    assert plan.stages[1].objective == NARROW.synthetic
    real = {"camera": {"kind": "collocated"}, "rendering": {"perceptual": 1.0}, "perceptual_layers": 3}
    changes = {"synthetic": {"maps": {"adversarial": 0.1}}, "real": real, "real_weight": 1.0}
    assert plan.stages[3].objective == override(NARROW, changes)
    light, others, revision, both, again = ({*stage.parts} for stage in plan.stages[2:])
    assert (light, revision, both) == ({"light_head"}, {"revision"}, others | revision)
    assert again == both
    assert not any(stage.objective.judged for stage in plan.stages[4:6])
    assert both | light == {name for name, _ in build(NARROW_GENERATOR).named_children()}
    assert plan.precision == "bf16-mixed"


def test_the_plan_of_the_baselines_is_of_the_networks_that_are_shipped() -> None:
    plan = read_plan(CONFIGS / "baselines.yaml")
    networks = {"des18": NARROW_DES18, "des19": NARROW_DES19, "gao19": NARROW_AUTOENCODER}
    assert {stage.name: stage.network for stage in plan.stages} == networks
    assert [type(stage.network) for stage in plan.stages] == [type(network) for network in networks.values()]
    assert [stage.objective for stage in plan.stages] == [replace(DES18, map_weight=0.1), DES19, GAO19]
    narrow = read_plan(CONFIGS / "narrow.yaml")
    assert plan.shares == narrow.shares
    assert {stage.augmentation for stage in plan.stages} == {narrow.stages[0].augmentation}
    assert {stage.photography for stage in plan.stages} == {narrow.stages[0].photography}


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.yaml")), ids=lambda path: path.name)
def test_what_a_header_is_told_is_plain_data(path: Path) -> None:
    plan = read_plan(path)
    for stage in plan.stages:
        told = plan.as_dict(stage)
        assert json.loads(json.dumps(told, allow_nan=False))["stage"] == stage.name
        assert set(told) == {
            "stage", "objective", "critics", "pairs", "parts", "shares", "augmentation", "photography",
            "precision",
        }  # fmt: skip


# What a plan says


def test_a_stage_overrides_what_is_common() -> None:
    plan = plan_of(
        {
            "generator": {"width": 2, "levels": 4},
            "trainer": {"learning_rate": 1, "ema_decay": 0.5},
            "shares": {"procedural": 2},
            "augmentation": {"scale": [0.5, 1], "relief": 0.2},
            "photography": {"falloff_share": 0.5, "lights": {"max_angle": 10}},
            "stages": [
                {
                    "name": 7,
                    "objective": {"kind": "l1", "map_weight": 3},
                    "phases": [{"iterations": 1, "crop": 16, "batch": 1, "shards": 2}],
                    "trainer": {"learning_rate": 0.5},
                    "augmentation": {"relief": 0.6},
                    "photography": {"lights": {"max_angle": 20}},
                },
                {
                    "name": "next",
                    "objective": {"kind": "l1"},
                    "phases": [{"iterations": 1, "crop": 16, "batch": 1}],
                },
            ],
        }
    )
    stage, plain = plan.stages
    assert isinstance(stage, Stage)
    assert (stage.name, stage.objective) == ("7", L1Objective(map_weight=3.0))
    assert (stage.trainer.learning_rate, stage.trainer.ema_decay) == (0.5, 0.5)
    assert stage.trainer.phases == (Phase(1, 16, 1, 2),)
    assert plan.shares == {"procedural": 2.0}
    varied = [(one.augmentation.scale, one.augmentation.relief) for one in (stage, plain)]
    assert varied == [((0.5, 1.0), 0.6), ((0.5, 1.0), 0.2)]
    assert plan.as_dict(stage)["augmentation"]["relief"] == 0.6
    taken = [(one.photography.falloff_share, one.photography.lights.max_angle) for one in (stage, plain)]
    assert taken == [(0.5, 20.0), (0.5, 10.0)]
    assert plan.as_dict(stage)["photography"]["lights"]["max_angle"] == 20.0
    assert (plan.precision, plan.critics) == ("32-true", {})


GOOD: dict[str, Any] = {"generator": GENERATOR, "critics": CRITICS, "stages": [STAGES["syn"], STAGES["hyb"]]}
ABSENT = object()


def changed(path: str, value: Any) -> Any:
    """Return the good plan with one entry set, or taken out."""
    plan = copy.deepcopy(GOOD)
    *parents, last = path.split("/")
    place: Any = plan
    for key in parents:
        place = place[int(key)] if key.isdigit() else place.setdefault(key, {})
    if value is ABSENT:
        del place[last]
    else:
        place[last] = value
    return plan


def test_the_good_plan_is_good() -> None:
    assert [stage.name for stage in plan_of(GOOD).stages] == ["syn", "hyb"]


MISTAKES: list[tuple[str, Any, str]] = [
    ("generator", ABSENT, "stage syn lacks network, and the plan generator"),
    ("stages", ABSENT, "the plan lacks stages"),
    ("stages", [], "stages must be a list of at least one stage"),
    ("stages", {"a": 1}, "stages must be a list of at least one stage"),
    ("stages", ["soup"], "a stage must be a mapping of names to values, got 'soup'"),
    ("soup", 1, "the plan has unknown soup; known are stages, generator, critics"),
    ("generator", None, "generator must be a mapping of names to values, got None"),
    ("generator/soup", 1, "GeneratorConfig has no 'soup'; it has width, levels"),
    ("generator/width", "wide", "GeneratorConfig.width must be of type int, got 'wide'"),
    ("generator/width", 0, "not a generator"),
    ("generator/shading_cues", 1, "GeneratorConfig.shading_cues must be of type bool, got 1"),
    ("critics/soup", 1, "critics has unknown soup; known are width, layers, scales"),
    ("critics/width", 0, "critics: width must be a whole number from 1 on, got 0"),
    ("critics/scales", 1.5, "critics: scales must be a whole number from 1 on, got 1.5"),
    ("trainer/soup", 1, "TrainerConfig has no 'soup'; it has phases, learning_rate"),
    ("trainer/learning_rate", "2e-5", "must be of type float, got '2e-5'; YAML writes 2e-5 as 2.0e-5"),
    ("trainer/learning_rate", -1.0, "learning_rate must be greater than 0, got -1.0"),
    ("trainer/phases", [], "stage syn: phases is not an entry of trainer but of the stage"),
    ("trainer/seed", 3, "stage syn: seed is not an entry of trainer but an option of refine-train"),
    ("shares/procedural", "half", "shares: procedural must be a number greater than 0, got 'half'"),
    ("shares/procedural", -1, "shares: procedural must be a number greater than 0, got -1"),
    ("augmentation/soup", 1, "Augmentation has no 'soup'"),
    ("augmentation/scale", 0.5, "Augmentation.scale must be of type tuple, got 0.5"),
    ("photography/lights/soup", 1, "LightDistribution has no 'soup'"),
    ("stages/0/augmentation", {"soup": 1}, "Augmentation has no 'soup'"),
    ("stages/0/photography", {"soup": 1}, "FlashPhotography has no 'soup'"),
    ("precision", 16, "precision must be one of 32-true, bf16-mixed, got 16"),
    ("stages/0/name", ABSENT, "a stage lacks name"),
    ("stages/0/name", "hyb", "stages must have names of their own, got hyb, hyb"),
    ("stages/0/name", "../up", "a stage's name is that of its folder, got '../up'"),
    ("stages/0/objective", ABSENT, "a stage lacks objective"),
    ("stages/0/objective", "l1", "stage syn: objective must be a mapping of names to values, got 'l1'"),
    ("stages/0/objective/kind", ABSENT, "stage syn: objective lacks kind"),
    ("stages/0/objective/kind", "soup", "no objective is called 'soup'; the known ones are l1, synthetic"),
    ("stages/0/objective/preset", "soup", "no preset is called 'soup'; the known ones are paper"),
    ("stages/0/objective/preset", ["paper"], "no preset is called \"['paper']\""),
    ("stages/0/objective/soup", 1, "SyntheticObjective has no 'soup'"),
    ("stages/0/phases", ABSENT, "a stage lacks phases"),
    ("stages/0/phases", 5, "stage syn: phases must be a list of at least one phase"),
    ("stages/0/phases", [], "stage syn: phases must be a list of at least one phase"),
    ("stages/0/phases", [5], "stage syn: a phase must be a mapping of names to values, got 5"),
    ("stages/0/phases/0/crop", ABSENT, "stage syn: a phase lacks crop"),
    ("stages/0/phases/0/soup", 5, "stage syn: a phase has unknown soup; known are iterations, crop, batch"),
    ("stages/0/phases/0/batch", 0, "stage syn: a phase: batch must be a whole number from 1 on, got 0"),
    ("stages/0/phases/0/iterations", 1e5, "iterations must be a whole number from 1 on, got 100000.0"),
    ("stages/0/phases/0/crop", 20, "stage syn has a crop of 20 pixels; its network needs multiples of 8"),
    ("stages/0/trainer", {"beta1": 2.0}, "beta1 must be from 0 to below 1, got 2.0"),
    (
        "stages/0/parts",
        "light_head",
        "stage syn: parts must be a list of the network's parts, got 'light_head'",
    ),
    ("stages/0/pairs", 1, "stage syn: pairs must be at least 1 with a hybrid objective and 0 with others"),
    ("stages/1/pairs", 0, "stage hyb: pairs must be at least 1 with a hybrid objective and 0 with others"),
    ("stages/1/pairs", True, "stage hyb: pairs must be at least 1 with a hybrid objective"),
    ("stages/0/soup", 1, "a stage has unknown soup; known are name, objective, phases, network"),
    ("stages/0/network", "des18", "stage syn: network must be a mapping of names to values, got 'des18'"),
    ("stages/0/network", {"width": 2}, "stage syn: network lacks kind"),
    ("stages/0/network", {"kind": "soup"}, "no network is called 'soup'; the known ones are generator"),
    ("stages/0/network", {"kind": "des18", "soup": 1}, "Des18Config has no 'soup'; it has width, levels"),
    ("stages/0/network", {"kind": "autoencoder", "width": 0}, "not an auto-encoder"),
    ("stages/0/network", {"kind": "des18"}, "trains a network of kind des18 on an objective for generator"),
    ("stages/0/objective", {"kind": "des19"}, "a network of kind generator on an objective for des18"),
    ("stages/0/objective", {"kind": "gao19", "preset": "soup"}, "no preset is called 'soup'"),
]


@pytest.mark.parametrize(
    ("path", "value", "hint"), MISTAKES, ids=[f"{m[0]}-{n}" for n, m in enumerate(MISTAKES)]
)
def test_every_mistake_is_one_sentence(path: str, value: Any, hint: str, tmp_path: Path) -> None:
    file = tmp_path / "plan.yaml"
    file.write_text(yaml.safe_dump(changed(path, value)))
    with pytest.raises(PlanError) as caught:
        read_plan(file)
    said = str(caught.value)
    assert said.startswith(f"{file}: ")
    assert hint in said
    assert "\n" not in said


def test_files_that_are_no_plans_are_named(tmp_path: Path) -> None:
    with pytest.raises(PlanError, match=r"absent\.yaml cannot be read .*configs/narrow\.yaml"):
        read_plan(tmp_path / "absent.yaml")
    broken, binary, empty = (tmp_path / f"{name}.yaml" for name in ("broken", "binary", "empty"))
    broken.write_text("stages: [1, 2\ngenerator: {")
    binary.write_bytes(b"\xff\xfe\x00")
    empty.write_text("")
    for path, hint in ((broken, "is not YAML"), (binary, "cannot be read"), (empty, "got None")):
        with pytest.raises(PlanError, match=hint) as caught:
            read_plan(path)
        assert str(path) in str(caught.value)
        assert "\n" not in str(caught.value)


def test_plans_on_disk_are_those_in_memory(tmp_path: Path) -> None:
    path = write_plan(tmp_path / "plan.yaml", STAGES["syn"], STAGES["hyb"])
    assert read_plan(path) == plan_of(GOOD)
