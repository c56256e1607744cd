"""What holds for the whole suite: shapes are checked at run time, randomness is seeded, threads are few.

The import hook must run before the first import of the library, so it stands at the top of this file.
"""

from __future__ import annotations

from collections.abc import Iterator

import jaxtyping

# An int is a float, as for mypy. (jaxtyping wants source text; it may be any expression of one import.)
CHECKER = "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))"
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
