"""One photo of a batch from its file to its result's files, in whatever process: nothing else is shared.

Importing this module loads nothing heavy; opening a `Bench` does, once in every process.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from refine.batch.plan import Job
from refine.errors import UserError
from refine.request import Request, enough_memory
from refine.staging import remove_debris

if TYPE_CHECKING:
    from refine.refiner import Refiner

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Read by numerical libraries when they are loaded."""


@dataclass(frozen=True)
class Opening:
    """What a process needs to know to work on any photo of a batch.

    Attributes:
        request: the settings.
        network: the checkpoint, by a name that holds in other folders, too.
    """

    request: Request
    network: str

    def __call__(self) -> Bench:
        """Load libraries and network."""
        for variable in THREAD_VARIABLES:
            os.environ.setdefault(variable, str(self.request.threads))
        return Bench(self.request, self.network)


class Bench:
    """The network at hand, for one photo after the other."""

    def __init__(self, request: Request, network: str) -> None:
        """Load the network.

        Raises:
            nets.checkpoint.CheckpointError: it cannot be loaded.
        """
        import torch

        from refine.result import describe_checkpoint

        torch.set_num_threads(request.threads)
        self.request = request
        self.checkpoint: dict[str, Any] = {**describe_checkpoint(network), "name": request.init}
        self.refiner: Refiner = replace(request, init=network).refiner()

    def __call__(self, job: Job) -> str | None:
        """Refine a photo and write its result; return None, or in one sentence why there is none."""
        from nets.checkpoint import CheckpointError

        try:
            with enough_memory():
                self._refine(job)
        except (UserError, CheckpointError) as error:
            return _sentence(error, job)
        except Exception as error:  # the other photos are none the worse for it
            return f"Refinement failed with {type(error).__name__}: {_sentence(error, job)}."
        return None

    def _refine(self, job: Job) -> None:
        from refine.export.cli import FOLDER, export_folder
        from refine.result import SECONDS, describe, write_result

        request, output = self.request, self.request.output(job.folder, job.stem)
        for folder in (job.folder, job.folder / FOLDER):
            remove_debris(folder, unasked=True)
        output.require_writable(job.photo)
        photo = request.read(job.photo)
        refined = request.fit(self.refiner, [photo], request.flash([job.photo]))
        record = describe(
            refined, output, settings=request.settings(), checkpoint=self.checkpoint, photo=photo
        )
        record["photo"]["source"] = job.source
        record[SECONDS] = {}  # or the files of an interrupted batch would differ from those of another
        (job.folder / FOLDER / f"{job.stem}_export.json").unlink(missing_ok=True)
        write_result(refined, output, record)
        if request.export:
            export_folder(job.folder, list(request.export), name=job.stem, quiet=True)


def _sentence(error: Exception, job: Job) -> str:
    """The message on one line, with the photo named as it was given."""
    return " ".join(str(error).split()).replace(str(job.photo), job.source)
