"""Training plans: YAML files that say which networks are trained, in which stages (paper Sec. 5.3)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from losses.baselines import AutoencoderObjective, RenderingObjective
from losses.objective import HybridObjective
from losses.presets import AnyObjective, find_objective, override
from nets.architectures import NetworkConfig, find_config, kind_of
from nets.data.augment import Augmentation
from nets.data.photography import FlashPhotography
from nets.discriminator import DiscriminatorConfig
from nets.generator import GeneratorConfig
from nets.training import Phase, TrainerConfig

PRECISIONS = ("32-true", "bf16-mixed")


class PlanError(ValueError):
    """A plan that cannot be followed; the message says where and how to mend it."""


@dataclass(frozen=True)
class Stage:
    """One training after another's networks.

    Attributes:
        name: of its folder.
        network: shape of what is trained.
        objective: what is minimised.
        trainer: phases, learning rates, seed.
        pairs: real pairs per shard.
        parts: of the network that are trained, as the generator calls them (`light_head`); none names all.
        augmentation: how its materials are varied.
        photography: how its photos are taken.
    """

    name: str
    network: NetworkConfig
    objective: AnyObjective
    trainer: TrainerConfig
    pairs: int = 0
    parts: tuple[str, ...] = ()
    augmentation: Augmentation = field(default_factory=Augmentation)
    photography: FlashPhotography = field(default_factory=FlashPhotography)


@dataclass(frozen=True)
class TrainingPlan:
    """Everything that is known before data are seen.

    Attributes:
        critics: shape of each critic: width, layers, scales.
        stages: in order; each starts from the networks of the last one of its shape before it.
        shares: how often each collection of a pool is drawn; empty draws every material alike.
        precision: `32-true` or `bf16-mixed`.
    """

    critics: Mapping[str, int]
    stages: tuple[Stage, ...]
    shares: Mapping[str, float] = field(default_factory=dict)
    precision: str = "32-true"

    def as_dict(self, stage: Stage) -> dict[str, Any]:
        """Return what a checkpoint's header should know of a stage."""
        return {
            "stage": stage.name,
            "objective": stage.objective.as_dict(),
            "critics": dict(self.critics),
            "pairs": stage.pairs,
            "parts": list(stage.parts),
            "shares": dict(self.shares),
            "augmentation": asdict(stage.augmentation),
            "photography": asdict(stage.photography),
            "precision": self.precision,
        }


def read_plan(path: Path) -> TrainingPlan:
    """Read a plan.

    Raises:
        PlanError: no such file, not YAML, or an entry that is missing, unknown or of the wrong kind.
    """
    try:
        import yaml
    except ImportError:
        raise PlanError('training needs PyYAML; run pip install "svbrdf-refine[train]"') from None
    try:
        content = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise PlanError(f"{path} cannot be read ({error}); give a file such as configs/narrow.yaml") from None
    except yaml.YAMLError as error:
        raise PlanError(f"{path} is not YAML ({' '.join(str(error).split())})") from None
    try:
        return plan_of(content)
    except (ValueError, TypeError) as error:
        raise PlanError(f"{path}: {error}") from None


def plan_of(content: Any) -> TrainingPlan:
    """Turn a YAML file's content into a plan.

    Raises:
        ValueError: naming the entry that is missing, unknown or of the wrong kind.
    """
    entries = _mapping(content, "the plan", required=("stages",), optional=OPTIONAL)
    critics = _mapping(entries.get("critics", {}), "critics", optional=("width", "layers", "scales"))
    _whole_numbers(critics, "critics")
    DiscriminatorConfig(**critics)  # refuses what cannot be built
    generator: NetworkConfig | None = None
    if "generator" in entries:
        generator = override(GeneratorConfig(), _mapping(entries["generator"], "generator"))
    common = _mapping(entries.get("trainer", {}), "trainer")
    if not isinstance(entries["stages"], list) or not entries["stages"]:
        raise ValueError("stages must be a list of at least one stage")
    simulation = Simulation(
        override(Augmentation(), _mapping(entries.get("augmentation", {}), "augmentation")),
        override(FlashPhotography(), _mapping(entries.get("photography", {}), "photography")),
    )
    stages = tuple(_stage(stage, common, generator, simulation) for stage in entries["stages"])
    names = [stage.name for stage in stages]
    if len(set(names)) != len(names):
        raise ValueError(f"stages must have names of their own, got {', '.join(names)}")
    precision = entries.get("precision", "32-true")
    if precision not in PRECISIONS:
        raise ValueError(f"precision must be one of {', '.join(PRECISIONS)}, got {precision!r}")
    shares = _mapping(entries.get("shares", {}), "shares")
    for name, share in shares.items():
        if not isinstance(share, int | float) or isinstance(share, bool) or not share > 0.0:
            raise ValueError(f"shares: {name} must be a number greater than 0, got {share!r}")
    return TrainingPlan(
        critics=critics,
        stages=stages,
        shares={name: float(share) for name, share in shares.items()},
        precision=precision,
    )


OPTIONAL = ("generator", "critics", "trainer", "shares", "augmentation", "photography", "precision")


STAGE_OPTIONAL = ("network", "trainer", "pairs", "parts", "augmentation", "photography")


class Simulation(NamedTuple):
    """What a plan says of all stages' materials and photos."""

    augmentation: Augmentation
    photography: FlashPhotography


def _stage(
    content: Any, common: Mapping[str, Any], generator: NetworkConfig | None, simulation: Simulation
) -> Stage:
    required, optional = ("name", "objective", "phases"), STAGE_OPTIONAL
    entries = _mapping(content, "a stage", required=required, optional=optional)
    name = str(entries["name"])
    where = f"stage {name}"
    if name in ("", ".", "..") or Path(name).name != name:
        raise ValueError(f"a stage's name is that of its folder, got {name!r}")
    network = _network(entries["network"], f"{where}: network") if "network" in entries else generator
    if network is None:
        raise ValueError(f"{where} lacks network, and the plan generator")
    wanted = dict(_mapping(entries["objective"], f"{where}: objective", required=("kind",)))
    objective = find_objective(str(wanted.pop("kind")), str(wanted.pop("preset", "paper")), wanted)
    if kind_of(network) not in _kinds_for(objective):
        raise ValueError(
            f"{where} trains a network of kind {kind_of(network)} on an objective for "
            f"{' or '.join(_kinds_for(objective))}"
        )
    if not isinstance(entries["phases"], list) or not entries["phases"]:
        raise ValueError(f"{where}: phases must be a list of at least one phase")
    phases = tuple(_phase(phase, where) for phase in entries["phases"])
    for phase in phases:
        if phase.crop % network.multiple:
            raise ValueError(
                f"{where} has a crop of {phase.crop} pixels; its network needs multiples of "
                f"{network.multiple}"
            )
    changes = {**common, **_mapping(entries.get("trainer", {}), f"{where}: trainer")}
    for elsewhere, place in (("phases", "of the stage"), ("seed", "an option of refine-train")):
        if elsewhere in changes:
            raise ValueError(f"{where}: {elsewhere} is not an entry of trainer but {place}")
    trainer = override(TrainerConfig(phases), changes)
    pairs = entries.get("pairs", 0)
    if type(pairs) is not int or pairs < 0 or bool(pairs) != isinstance(objective, HybridObjective):
        raise ValueError(f"{where}: pairs must be at least 1 with a hybrid objective and 0 with others")
    parts = entries.get("parts", [])
    if not isinstance(parts, list) or not all(isinstance(part, str) for part in parts):
        raise ValueError(f"{where}: parts must be a list of the network's parts, got {parts!r}")
    varied, taken = (
        _mapping(entries.get(entry, {}), f"{where}: {entry}") for entry in ("augmentation", "photography")
    )
    augmentation = override(simulation.augmentation, varied)
    photography = override(simulation.photography, taken)
    return Stage(name, network, objective, trainer, pairs, tuple(parts), augmentation, photography)


def _network(content: Any, where: str) -> NetworkConfig:
    values = dict(_mapping(content, where, required=("kind",)))
    shape = find_config(str(values.pop("kind")))
    return override(shape(), values)


def _kinds_for(objective: AnyObjective) -> tuple[str, ...]:
    """Return the kinds of networks that an objective can be asked of."""
    match objective:
        case AutoencoderObjective():
            return ("autoencoder",)
        case RenderingObjective():
            return ("des18", "des19")
        case _:
            return ("generator",)


def _phase(content: Any, where: str) -> Phase:
    required = ("iterations", "crop", "batch")
    entries = _mapping(content, f"{where}: a phase", required=required, optional=("shards",))
    _whole_numbers(entries, f"{where}: a phase")
    return Phase(**entries)


def _whole_numbers(entries: Mapping[str, Any], what: str) -> None:
    for name, number in entries.items():
        if type(number) is not int or number < 1:
            raise ValueError(f"{what}: {name} must be a whole number from 1 on, got {number!r}")


def _mapping(
    content: Any, what: str, required: tuple[str, ...] = (), optional: tuple[str, ...] | None = None
) -> dict[str, Any]:
    if not isinstance(content, dict):
        raise ValueError(f"{what} must be a mapping of names to values, got {content!r}")
    missing = [name for name in required if name not in content]
    if missing:
        raise ValueError(f"{what} lacks {', '.join(missing)}")
    if optional is not None:
        known = (*required, *optional)
        unknown = [str(name) for name in content if name not in known]
        if unknown:
            raise ValueError(f"{what} has unknown {', '.join(unknown)}; known are {', '.join(known)}")
    return content
