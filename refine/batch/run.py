"""A batch from photos to index: plan, work on what is not finished, record, summarise."""

from __future__ import annotations

import json
import os
import sys
from collections import Counter
from collections.abc import Generator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from refine import __version__
from refine.batch.cluster import work_on_cluster
from refine.batch.index import build_index
from refine.batch.plan import INDEX, RECORD, Job, is_finished, plan
from refine.batch.processes import work_in_processes
from refine.batch.view import batch_view
from refine.batch.work import Opening
from refine.errors import StoppedError, UserError
from refine.request import Request
from refine.staging import remove_debris

FORMAT = "svbrdf-refine batch 1"


class IncompleteError(UserError):
    """The batch is done, but for photos that failed."""

    code = 3


def refine_batch(
    request: Request,
    photos: Sequence[Path],
    out: Path,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    quiet: bool = False,
    as_json: bool = False,
) -> None:
    """Refine every photo that has no finished result yet; write the batch's record and its index.

    Args:
        request: the settings, the same for all.
        photos: as given.
        out: folder of the batch; every result has a folder of its own in it.
        workers: processes on this machine; None takes one per core, or one where they would share a GPU.
        scheduler: address of a Dask cluster that does the work instead.
        quiet: whether nothing is shown.
        as_json: whether the record is printed.

    Raises:
        nets.checkpoint.CheckpointError: the network cannot be loaded.
        UserError: the folder cannot be written, or no scheduler answers; `IncompleteError` if photos failed,
            `StoppedError` if it was interrupted.
    """
    from refine.result import describe_checkpoint

    checkpoint = describe_checkpoint(request.init)
    jobs = plan(photos, out)
    remove_debris(out, unasked=True)
    outcomes: dict[Job, str | None] = {
        job: None for job in jobs if is_finished(job, request, checkpoint["sha256"])
    }
    known, waiting = len(outcomes), [job for job in jobs if job not in outcomes]
    settings = {**request.settings(), "checkpoint": checkpoint["sha256"]}
    stopped = False
    try:
        _write(out, jobs, outcomes, settings)
        with (
            batch_view(len(jobs), known, quiet=quiet) as tell,
            closing(_work(request, waiting, workers, scheduler)) as work,
        ):
            for job, reason in work:
                outcomes[job] = reason
                tell(job.source, reason)
    except KeyboardInterrupt:
        stopped = True
    finally:
        record = _write(out, jobs, outcomes, settings)
    if as_json:
        json.dump({**record, "folder": str(out)}, sys.stdout, indent=2)
        print()
    states = Counter(photo["state"] for photo in record["photos"])
    if stopped:
        raise StoppedError(
            f"interrupted; {states['done']} of {len(jobs)} photos are done, the same command does the rest."
        )
    if states["failed"]:
        raise IncompleteError(
            f"{states['failed']} of {len(jobs)} photos failed, the others are done; "
            f"{out / RECORD} says why, and the same command tries them again."
        )
    if not quiet:
        there = f", {known} of them before" if known else ""
        print(f"{len(jobs)} photos are done{there}; see {out / INDEX}", file=sys.stderr)


def _work(
    request: Request, jobs: Sequence[Job], workers: int | None, scheduler: str | None
) -> Generator[tuple[Job, str | None], None, None]:
    opening = Opening(request, _network(request.init))
    if scheduler is not None:
        return work_on_cluster(opening, jobs, scheduler)
    return work_in_processes(
        opening,
        jobs,
        _process_count(request.device) if workers is None else workers,
        meanwhile=lambda: _compile_once(request),
    )


def _network(name: str) -> str:
    """Return a checkpoint's absolute path; the name of a shipped one, which every machine has its own of."""
    from nets.checkpoint import WEIGHTS, resolve

    path = resolve(name)
    return name if path.parent == WEIGHTS else os.path.abspath(path)


def _process_count(device: str) -> int:
    if device != "cpu":
        return 1
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _compile_once(request: Request) -> None:
    """Compile the refinement here, if it never was on this machine, or every process would."""
    import torch

    from refine.engine import choose_engine
    from refine.engine.compilation import prepare

    engine = None if request.engine == "auto" else request.engine
    if choose_engine(engine, torch.device(request.device).type) == "fused":
        prepare()


def _write(
    out: Path, jobs: Sequence[Job], outcomes: Mapping[Job, str | None], settings: Mapping[str, Any]
) -> dict[str, Any]:
    """Write index and record. They depend on photos, settings and outcomes alone, not on the way there."""
    from refine.files import write_together
    from refine.result import to_json

    record = {
        "format": FORMAT,
        "settings": dict(settings),
        "photos": [_entry(job, outcomes) for job in jobs],
        "version": __version__,
    }
    with write_together([out / INDEX, out / RECORD]) as (index, file):
        index.write_text(build_index(jobs, outcomes), encoding="utf-8", newline="\n")
        file.write_text(to_json(record), encoding="utf-8", newline="\n")
    return record


def _entry(job: Job, outcomes: Mapping[Job, str | None]) -> dict[str, Any]:
    if job not in outcomes:
        return {"photo": job.source, "name": job.name, "state": "waiting"}
    if (reason := outcomes[job]) is not None:
        return {"photo": job.source, "name": job.name, "state": "failed", "reason": reason}
    return {"photo": job.source, "name": job.name, "state": "done", "record": f"{job.name}/{job.stem}.json"}
