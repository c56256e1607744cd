"""The Schur complement finds what a dense solve of the whole system finds."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from refine.bordered import solve_bordered
from tests.helpers import assert_close, seeded


def system(groups: int, own: int, shared: int, seed: int = 0) -> tuple[Tensor, ...]:
    """Draw a well-posed system in double precision."""
    generator = seeded(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    root = normal(groups, own, own + 2)
    corner = normal(shared, 3 * shared)
    return (
        root @ root.transpose(1, 2) + 0.1 * torch.eye(own, dtype=torch.float64),
        normal(groups, own, shared),
        corner @ corner.T + 100.0 * groups * torch.eye(shared, dtype=torch.float64),
        normal(groups, own),
        normal(shared),
    )


def dense(
    blocks: Tensor, border: Tensor, corner: Tensor, own_side: Tensor, shared_side: Tensor
) -> tuple[Tensor, Tensor]:
    """Solve the whole matrix at once."""
    beside = border.flatten(0, 1)
    whole = torch.cat(
        [
            torch.cat([torch.block_diag(*blocks), beside], dim=1),
            torch.cat([beside.T, corner], dim=1),
        ]
    )
    found = torch.linalg.solve(whole, torch.cat([own_side.flatten(), shared_side]))
    return found[: own_side.numel()].reshape(own_side.shape), found[own_side.numel() :]


@pytest.mark.parametrize(("groups", "own", "shared"), [(1, 1, 1), (7, 4, 3), (40, 9, 12)])
def test_as_a_dense_solve(groups: int, own: int, shared: int) -> None:
    given = system(groups, own, shared, seed=groups)
    for found, expected in zip(solve_bordered(*given), dense(*given), strict=True):
        assert_close(found, expected)


def test_constraints_make_the_corner_indefinite() -> None:
    blocks, border, corner, own_side, shared_side = system(6, 3, 4)
    corner[-1] = corner[:, -1] = 0.0
    corner[-1, -1] = -1.0
    given = (blocks, border, corner, own_side, shared_side)
    assert float(torch.linalg.eigvalsh(corner)[0]) < 0.0
    for found, expected in zip(solve_bordered(*given), dense(*given), strict=True):
        assert_close(found, expected)


def test_a_block_that_is_not_positive_definite_is_refused() -> None:
    blocks, *rest = system(3, 2, 1)
    blocks[1] = -blocks[1]
    with pytest.raises(torch.linalg.LinAlgError):
        solve_bordered(blocks, *rest)
