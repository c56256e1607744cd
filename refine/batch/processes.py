"""Jobs in processes of this machine, each at work on one; when one dies, its own job alone is tried again.

A process pool of the standard library is broken as a whole when one process dies, and does not say which job
killed it. Here every process has a pipe of its own, whose end of file tells both.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
import threading
from collections import Counter, deque
from collections.abc import Callable, Generator, Hashable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from typing import Generic, TypeVar

from nets.processes import end_with_parent

J = TypeVar("J", bound=Hashable)

Work = Callable[[J], str | None]
"""Does a job; returns None, or why it failed."""

ATTEMPTS = 2
"""How often a job is given to a process that then dies."""

GRACE = 0.1
"""Seconds in which an idle process may end by itself."""

DIED = "The process at work on it died {} times ({}); it may need more memory than there is."


def work_in_processes(
    opening: Callable[[], Work[J]],
    jobs: Sequence[J],
    workers: int,
    *,
    meanwhile: Callable[[], object] = lambda: None,
) -> Generator[tuple[J, str | None], None, None]:
    """Yield every job with its outcome as soon as it is there.

    All processes have ended when the iterator is exhausted, closed or has raised. They do not outlive this
    process, however it ends, and leave Ctrl-C to it.

    Args:
        opening: called once in every process, spawned afresh; returns what does a job.
        jobs: what there is to do.
        workers: how many processes at most.
        meanwhile: called here, if there is any job, while the processes start and before they get one.
    """
    waiting, deaths = deque(jobs), Counter[J]()
    crew: list[_Worker[J]] = []
    try:
        for _ in range(min(workers, len(jobs))):
            with interrupts_held():
                crew.append(_Worker(opening))
        if crew:
            meanwhile()
        for worker in crew:
            worker.begin(waiting.popleft())
        while crew:
            for connection in wait([worker.connection for worker in crew]):
                place = next(n for n, worker in enumerate(crew) if worker.connection is connection)
                worker = crew[place]
                outcomes: list[tuple[J, str | None]] = []
                try:
                    outcomes.append((worker.job, worker.answer()))
                except EOFError:
                    reason = worker.end()
                    deaths[worker.job] += 1
                    if deaths[worker.job] < ATTEMPTS:
                        waiting.appendleft(worker.job)
                    else:
                        outcomes.append((worker.job, DIED.format(ATTEMPTS, reason)))
                    if waiting:
                        with interrupts_held():
                            worker = crew[place] = _Worker(opening)
                if waiting:
                    worker.begin(waiting.popleft())
                else:
                    crew.pop(place).end()
                yield from outcomes
    finally:
        for worker in crew:
            worker.end()


class _Worker(Generic[J]):
    """A process and the job it has."""

    job: J

    def __init__(self, opening: Callable[[], Work[J]]) -> None:
        context = multiprocessing.get_context("spawn")  # forks of a process whose libraries have threads hang
        self.connection, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs, opening))
        self.process.start()
        theirs.close()  # so that its death is the end of the file

    def begin(self, job: J) -> None:
        """Hand over a job; what a dead process is told, nobody hears."""
        self.job = job
        with contextlib.suppress(BrokenPipeError):
            self.connection.send(job)

    def answer(self) -> str | None:
        """Return the job's outcome.

        Raises:
            EOFError: the process is dead.
        """
        try:
            said: str | None = self.connection.recv()
        except ConnectionResetError:
            raise EOFError from None
        return said

    def end(self) -> str:
        """Kill the process, if it lives, and return how it ended; may be called again."""
        self.connection.close()
        self.process.join(GRACE)
        self.process.kill()
        self.process.join()
        code = self.process.exitcode or 0
        return f"signal {-code}" if code < 0 else f"exit code {code}"


def _serve(connection: Connection, opening: Callable[[], Work[J]]) -> None:
    """Answer jobs until the pipe is closed: the whole life of a process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # it was held back until here
    end_with_parent()
    work = opening()
    with contextlib.suppress(EOFError):
        while True:
            connection.send(work(connection.recv()))


@contextmanager
def interrupts_held() -> Iterator[None]:
    """Have Ctrl-C wait until the block ends, and what is started meanwhile not hear it at all."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    resource_tracker.ensure_running()  # or the first process would start it, which lets Ctrl-C through
    held: list[bool] = []
    # The mask is for what is started: it is inherited. Here another thread may still take the signal.
    main = threading.current_thread() is threading.main_thread()
    handler = signal.signal(signal.SIGINT, lambda *_: held.append(True)) if main else None
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        if main:
            signal.signal(signal.SIGINT, handler)
            if held:
                signal.raise_signal(signal.SIGINT)
