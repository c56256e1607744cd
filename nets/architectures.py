"""Every network that can be trained, saved and loaded, by the kind that plans and headers call it."""

from __future__ import annotations

from dataclasses import replace

from nets.baselines.autoencoder import Autoencoder, AutoencoderConfig
from nets.baselines.des18 import Des18, Des18Config
from nets.baselines.des19 import Des19, Des19Config
from nets.generator import Generator, GeneratorConfig

Network = Generator | Des18 | Des19 | Autoencoder
NetworkConfig = GeneratorConfig | Des18Config | Des19Config | AutoencoderConfig

CONFIGS: dict[str, type[NetworkConfig]] = {
    "generator": GeneratorConfig,
    "des18": Des18Config,
    "des19": Des19Config,
    "autoencoder": AutoencoderConfig,
}
"""Shapes by kind. Each says by its defaults what the paper's network is."""


def kind_of(config: NetworkConfig) -> str:
    """Return the kind of a network's shape."""
    return next(kind for kind, known in CONFIGS.items() if type(config) is known)


def find_config(kind: str) -> type[NetworkConfig]:
    """Return the class of a kind's shapes.

    Raises:
        ValueError: naming the known kinds.
    """
    if kind not in CONFIGS:
        raise ValueError(f"no network is called {kind!r}; the known ones are {', '.join(CONFIGS)}")
    return CONFIGS[kind]


def continues(config: NetworkConfig, earlier: NetworkConfig) -> bool:
    """Return whether a network can start from another: its like, or one that revises less often or never."""
    if isinstance(config, GeneratorConfig) and isinstance(earlier, GeneratorConfig):
        if earlier.revision_passes > config.revision_passes:
            return False
        like = replace(earlier, revision_passes=config.revision_passes)
        return like in (config, replace(config, revision_channels=0))
    return config == earlier


def build(config: NetworkConfig) -> Network:
    """Build the network of a shape, with random weights."""
    match config:
        case GeneratorConfig():
            return Generator(config)
        case Des18Config():
            return Des18(config)
        case Des19Config():
            return Des19(config)
        case AutoencoderConfig():
            return Autoencoder(config)
