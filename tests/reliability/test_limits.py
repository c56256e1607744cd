"""Memory is estimated before the work starts, and what does not fit is refused in one sentence."""

from __future__ import annotations

import pytest

from refine import limits
from refine.errors import UserError
from refine.limits import BASE, GIB, free_memory, memory_needed, require_memory


@pytest.mark.parametrize(
    ("side", "engine", "measured"),
    [
        *((512, "fused", 758.3), (1536, "fused", 1749.8)),
        *((512, "reference", 987.6), (1024, "reference", 2239.4)),
        (4096, "fused", 4558.0),
    ],
)
def test_the_estimate_is_near_and_not_below_measured_peaks(side: int, engine: str, measured: float) -> None:
    estimate = memory_needed((side, side), engine) / 2**20
    assert measured - 1.0 <= estimate <= 1.12 * measured


def test_more_pixels_and_photos_take_more() -> None:
    assert memory_needed((64, 64), "fused") < memory_needed((64, 65), "fused")
    assert memory_needed((64, 64), "fused") < memory_needed((64, 64), "fused", photos=3)


def test_what_is_allowed_is_taken_at_its_word() -> None:
    needed = require_memory((1000, 2000), "fused", allowed=100.0)
    assert require_memory((1000, 2000), "fused", allowed=needed / GIB) == needed
    with pytest.raises(
        UserError, match=r"2000 x 1000 .* --max-memory allows 1; ask for --resolution \d+"
    ) as caught:
        require_memory((1000, 2000), "fused", allowed=1.0)
    side = int(str(caught.value).partition("--resolution ")[2].split()[0])
    require_memory((side // 2, side), "fused", allowed=1.0)  # what is advised does fit
    with pytest.raises(UserError):
        require_memory((side // 2 + side // 8, side + side // 4), "fused", allowed=1.0)


def test_where_nothing_fits_no_size_is_advised() -> None:
    with pytest.raises(UserError, match="allow more, or free some") as caught:
        require_memory((1000, 2000), "fused", allowed=0.5)
    assert "--resolution" not in str(caught.value)


def test_what_is_free_is_the_limit_of_old(monkeypatch: pytest.MonkeyPatch) -> None:
    assert free_memory() is None or free_memory() > 2**20
    monkeypatch.setattr(limits, "free_memory", lambda: 2**28)
    assert require_memory((256, 256), "fused") > BASE
    with pytest.raises(UserError, match=r"0\.2 GiB are free; ask for --resolution"):
        require_memory((4096, 4096), "fused")
    monkeypatch.setattr(limits, "free_memory", lambda: None)
    assert require_memory((4096, 4096), "fused") < 9 * GIB
