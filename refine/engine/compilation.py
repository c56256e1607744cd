"""When the fused engine's loops are compiled, where that is kept, and that it is said."""

from __future__ import annotations

import logging
import threading
from types import ModuleType
from typing import Any

import numba
import torch
from numba.core import event

from refine.engine import kernel, layout, newton_step, simd

COMPILING = "compiling the refinement for this processor; this happens once and takes some twenty seconds"

_log = logging.getLogger(__name__)


def prepare(dtype: torch.dtype = torch.float32) -> None:
    """Compile for float32 or float64, or load what was compiled before; the log says if it has to compile.

    Compiled code is kept beside this file or, where that is read-only, in the user's cache; the environment
    variable `NUMBA_CACHE_DIR` overrules both. Where nothing can be kept, every process compiles.
    """
    with _lock:
        if dtype in _ready:
            return
        real = numba.from_dtype(layout.numpy_type(dtype))
        rows, row, sums, counts = real[:, ::1], real[::1], numba.float64[:, ::1], numba.int64[::1]
        loops: list[tuple[ModuleType, str, tuple[Any, ...]]] = [
            (kernel, "descend_blocks", (rows, rows, row, row, row, rows, row, counts, sums)),
            (kernel, "sum_blocks", (rows, rows, row, row, row, counts, sums)),
            (newton_step, "solve_blocks", (rows, rows, row, rows, row, row, row, counts, sums, rows)),
        ]
        with event.install_listener("numba:compile", _Announcement()):
            for module, name, signature in loops:
                _compile(module, name, signature)
        _ready.add(dtype)


_lock, _ready = threading.Lock(), set[torch.dtype]()


class _Announcement(event.Listener):
    """Says once that the compiler is at work."""

    def __init__(self) -> None:
        self.said = False

    def on_start(self, event: event.Event) -> None:
        if not self.said:
            _log.warning(COMPILING)
        self.said = True

    def on_end(self, event: event.Event) -> None:
        pass


def _compile(module: ModuleType, name: str, signature: tuple[Any, ...]) -> None:
    try:
        getattr(module, name).compile(signature)
    except Exception as error:  # whatever a damaged or full cache raises, the code itself is sound
        _log.warning("the cache of compiled code cannot be used (%s); compiling without it", error)
        setattr(module, name, simd.not_kept(getattr(module, name)))
        getattr(module, name).compile(signature)
