"""Least squares in which many small groups of unknowns share a few: the Schur complement, and nothing else.

In a joint fit of lights and a material, every pixel has unknowns of its own and all of them share the lights.
The normal equations are then block diagonal with a border, as in bundle adjustment (Triggs et al. 2000,
"Bundle Adjustment: A Modern Synthesis", Sec. 6.1), and cost as much as one small solve per pixel.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def solve_bordered(
    blocks: Float[Tensor, "groups own own"],
    border: Float[Tensor, "groups own shared"],
    corner: Float[Tensor, "shared shared"],
    own_side: Float[Tensor, "groups own"],
    shared_side: Float[Tensor, "shared"],
) -> tuple[Float[Tensor, "groups own"], Float[Tensor, "shared"]]:
    """Solve `A x + B y = a` for every group and `sum B^T x + C y = c` for what they share.

    With `x = A^-1 (a - B y)` from the first, the second is `(C - sum B^T A^-1 B) y = c - sum B^T A^-1 a`.

    Args:
        blocks: A, symmetric and positive definite.
        border: B.
        corner: C, symmetric; it may be indefinite, as it is when it holds constraints.
        own_side: a.
        shared_side: c.

    Returns:
        x and y.

    Raises:
        torch.linalg.LinAlgError: a block is not positive definite, or the whole is singular.
    """
    factors = torch.linalg.cholesky(blocks)
    solved = torch.cholesky_solve(torch.cat([border, own_side[..., None]], dim=2), factors)
    projected = torch.einsum("gis,git->st", border, solved)
    shared = torch.linalg.solve(corner - projected[:, :-1], shared_side - projected[:, -1])
    return solved[..., -1] - solved[..., :-1] @ shared, shared
