"""A batch on the machines of a Dask cluster, which gives the jobs of dead workers to others.

Scheduler and workers must see photos, network and results under the same paths, as on a shared file system.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Generator, Sequence
from typing import Any

from refine.batch.processes import J, Work
from refine.errors import UserError

PATIENCE = 30.0
"""Seconds in which a scheduler must answer."""

_ONE_AT_A_TIME = threading.Lock()


def work_on_cluster(
    opening: Callable[[], Work[J]], jobs: Sequence[J], address: str
) -> Generator[tuple[J, str | None], None, None]:
    """Yield every job with its outcome (None, or why it failed) as soon as it is there.

    Jobs that have not begun are withdrawn when the iterator is closed or raises.

    Args:
        opening: called once in every worker process; returns what does a job. It must be hashable.
        jobs: what there is to do.
        address: of the scheduler, as `tcp://10.0.0.1:8786`.

    Raises:
        UserError: Dask is not installed, or no scheduler answers there.
    """
    try:
        from distributed import Client, as_completed
    except ImportError:
        raise UserError(
            "--engine dask needs Dask, which is not installed; run pip install 'svbrdf-refine[dist]'."
        ) from None
    try:
        client = Client(address, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError, ImportError) as error:
        raise UserError(
            f"No Dask scheduler answers at {address} ({type(error).__name__}); "
            "check --scheduler, or start one with dask scheduler."
        ) from None
    with client:
        futures = {client.submit(attempt, opening, job, pure=False): job for job in jobs}
        try:
            for future in as_completed(futures, loop=client.loop):
                yield futures[future], _outcome(future)
        finally:
            client.cancel(list(futures))


def attempt(opening: Callable[[], Work[J]], job: J) -> str | None:
    """Do a job in a worker process, where the network stays loaded; one at a time, for torch has one seed."""
    with _ONE_AT_A_TIME:
        return _work(opening)(job)


@functools.lru_cache(maxsize=1)
def _work(opening: Callable[[], Work[Any]]) -> Work[Any]:
    return opening()


def _outcome(future: object) -> str | None:
    try:
        outcome: str | None = future.result()  # type: ignore[attr-defined]
    except Exception as error:  # of Dask: lost workers, cancelled work; of photos, the bench tells
        said = " ".join(str(error).split())
        return f"The cluster did not finish it ({type(error).__name__}: {said})."
    return outcome
