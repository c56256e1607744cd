"""What processes are given to do in tests, in a module that is imported quickly."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Toys:
    """Opens a process that leaves a trace of every job in a folder; what a job does, its name says."""

    folder: Path

    def __call__(self) -> Callable[[str], str | None]:
        (self.folder / f"process-{os.getpid()}").touch()
        return self.work

    def work(self, job: str) -> str | None:
        trace = self.folder / f"{job}-{len(list(self.folder.glob(f'{job}-*')))}"
        trace.write_text(str(os.getpid()))
        if job == "fail":
            return "it failed"
        if job == "die" or (job == "die once" and trace.name == "die once-0"):
            os.kill(os.getpid(), signal.SIGKILL)
        if job == "interrupt":
            os.kill(os.getpid(), signal.SIGINT)
        if job == "sleep":
            time.sleep(600)
        return None
