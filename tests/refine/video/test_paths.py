"""Paths of the light: closed, at a constant height, as far out as asked."""

from __future__ import annotations

import math

import pytest

from refine.video.paths import PATHS, light_positions


@pytest.mark.parametrize("path", PATHS)
def test_the_light_ends_where_it_began(path: str) -> None:
    count, radius = 90, 0.8
    positions = list(light_positions(path, count, radius, 1.4))
    assert len(positions) == count
    assert {z for _, _, z in positions} == {1.4}
    assert max(math.hypot(x, y) for x, y, _ in positions) == pytest.approx(radius, rel=0.15)
    steps = [math.dist(positions[k], positions[(k + 1) % count]) for k in range(count)]
    assert steps[-1] <= max(steps[:-1]) + 1e-9  # the loop's seam is a step as any other
    assert max(steps) < 3.0 * radius * 2.0 * math.pi / count


def test_where_the_light_goes() -> None:
    def quarters(path: str) -> list[tuple[float, float]]:
        return [(round(x, 6) + 0.0, round(y, 6) + 0.0) for x, y, _ in light_positions(path, 4, 1.0, 1.0)]

    assert quarters("circle") == [(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)]
    assert quarters("sweep") == [(-1.0, 0.0), (0.0, 0.0), (1.0, 0.0), (0.0, 0.0)]
    eighths = [(x, y) for x, y, _ in light_positions("figure-eight", 8, 1.0, 1.0)]
    assert eighths[1] == pytest.approx((math.sqrt(0.5), 0.5))
    assert eighths[3] == pytest.approx((math.sqrt(0.5), -0.5))
    assert eighths[5] == pytest.approx((-math.sqrt(0.5), 0.5))
