"""What holds for the whole suite: shapes are checked at run time, randomness is seeded, threads are few.

The import hook must run before the first import of the library, so it stands at the top of this file. Plain
`pytest` shares the tests between two processes (`addopts` in pyproject.toml); `-n 0` has them in this one.
"""

from __future__ import annotations

import os
from collections.abc import Iterator

if "PYTEST_XDIST_WORKER" in os.environ:  # the workers share the cores; libraries read this when they load
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(variable, "1")

import jaxtyping

import tests.type_checks

CHECKER = f"{tests.type_checks.__name__}.checked"  # jaxtyping wants source text
jaxtyping.install_import_hook(["nets", "losses", "refine", "eval"], CHECKER)

import hypothesis  # noqa: E402
import pytest  # noqa: E402
import torch  # noqa: E402

hypothesis.settings.register_profile("suite", derandomize=True, deadline=None, database=None)
hypothesis.settings.load_profile("suite")

torch.set_num_threads(min(2, torch.get_num_threads()))


@pytest.fixture(autouse=True)
def _seeded() -> Iterator[None]:
    """Start every test from one state of torch's global generator, and leave torch's globals as found."""
    torch.manual_seed(0)
    yield
    torch.set_flush_denormal(False)  # a trainer switches it on for the whole process


@pytest.fixture
def unchecked() -> Iterator[None]:
    """Switch the run-time type checks off: for tests that hand over wrong shapes and types on purpose.

    A user has no such checks, so what a test of an error message must see is the library's own error.
    """
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
