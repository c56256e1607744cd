"""The threads of the fused engine: the compiled loops let go of Python's lock, so plain threads do."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import torch

TASKS_PER_THREAD = 4
"""Parts of the work per thread: a core that is busy elsewhere holds up the others by a part only."""

LONGEST_TASK = 2**23
"""Most pixels times steps of a part, a quarter of a second or so: compiled loops do not hear Ctrl-C."""


class Workers:
    """A pool of threads, used only while it is open.

    Numba's own parallel loops would do, but their threads do not go well with forks, with torch's, or with
    a caller that has several threads itself; and the work is not bound to the number of parts.
    """

    def __init__(self, pool: ThreadPoolExecutor, threads: int) -> None:
        """Use an open pool of so many threads."""
        self.pool, self.tasks = pool, threads * TASKS_PER_THREAD

    @staticmethod
    @contextmanager
    def of_torch() -> Iterator[Workers]:
        """Open as many threads as torch has been told to use."""
        threads = torch.get_num_threads()
        with ThreadPoolExecutor(threads, thread_name_prefix="refine") as pool:
            yield Workers(pool, threads)

    def run(self, work: Callable[[slice], None], length: int, cost: int = 1) -> None:
        """Do `work` on all parts of a range of this length; raises what any of them raises.

        `cost` is what one of the range takes, in pixels times steps; parts are no larger than `LONGEST_TASK`.
        """
        size = max(1, min(-(-length // self.tasks), LONGEST_TASK // cost))
        for _ in self.pool.map(work, (slice(first, first + size) for first in range(0, length, size))):
            pass
