"""The processes that train together, by Lightning Fabric: devices, machines, precision, messages."""

from __future__ import annotations

import contextlib
import logging
import os
from typing import Any

import torch
from torch import Tensor


def process_count(devices: int, nodes: int) -> int:
    """Return how many processes will train: what torchrun says, or what is asked for, before any launch."""
    if "LOCAL_WORLD_SIZE" in os.environ:
        return int(os.environ["WORLD_SIZE"])
    return devices * nodes


class FabricTeam:
    """A `nets.training.Team` on whatever Fabric was told to run.

    Modules are not wrapped for data parallelism: two players share one graph, and each one's gradient is
    averaged over the processes after it is complete. Fabric launches, places, casts and sends.
    """

    def __init__(self, *, accelerator: str, devices: int, nodes: int, precision: str) -> None:
        """Launch the processes (or join those torchrun launched).

        Args:
            accelerator: `cpu`, `cuda`, or `auto` for the best there is.
            devices: per machine.
            nodes: machines.
            precision: `32-true` or `bf16-mixed`.

        Raises:
            ValueError: Lightning Fabric is not installed, or refuses the combination.
        """
        try:
            from lightning_fabric import Fabric
        except ImportError:
            raise ValueError(
                'training needs Lightning Fabric; run pip install "svbrdf-refine[train]"'
            ) from None
        logging.getLogger("lightning_fabric").setLevel(logging.WARNING)  # it tells what it was told
        here = int(os.environ.get("LOCAL_WORLD_SIZE", devices))
        several = process_count(devices, nodes) > 1
        try:
            self.fabric = Fabric(
                accelerator=accelerator,
                strategy="ddp" if several else "auto",
                devices=here,
                num_nodes=max(1, process_count(devices, nodes) // here),
                precision=precision,  # type: ignore[arg-type]
            )
            self.fabric.launch()
        except (RuntimeError, ValueError) as error:
            raise ValueError(f"cannot train on {devices} {accelerator} devices: {error}") from None

    @property
    def rank(self) -> int:
        """This process's number over all machines, from 0."""
        return int(self.fabric.global_rank)

    @property
    def world(self) -> int:
        """How many processes there are on all machines."""
        return int(self.fabric.world_size)

    @property
    def device(self) -> torch.device:
        """Where this process computes."""
        return self.fabric.device

    def autocast(self) -> contextlib.AbstractContextManager[Any]:
        """Return the precision's context."""
        return self.fabric.autocast()

    def mean(self, tensor: Tensor) -> Tensor:
        """Return the tensor's mean over all processes."""
        reduced = self.fabric.all_reduce(tensor, reduce_op="mean")
        assert isinstance(reduced, Tensor)
        return reduced
