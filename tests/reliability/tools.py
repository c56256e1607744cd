"""What several tests of reliability need."""

from __future__ import annotations

import os
from collections.abc import Callable

from eval.benchmarks.kills import in_child


def outcome_of(work: Callable[[], object]) -> str:
    """Do something in a copy of this process; return what it raised there, as `Type: message`, or `done`."""
    read, write = os.pipe()

    def tell() -> None:
        try:
            work()
            message = "done"
        except BaseException as error:
            message = f"{type(error).__name__}: {error}"
        os.write(write, message.encode())

    child = in_child(tell)
    os.close(write)
    with os.fdopen(read) as told:
        message = told.read()
    os.waitpid(child, 0)
    return message
