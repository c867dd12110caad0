"""Sparse matrices and linear systems for the fit of poses."""

from __future__ import annotations

from contextlib import suppress
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from ssh_abduction.runtime.clock import look_at_clock

Array: TypeAlias = NDArray[np.float64]

# With at most this many unknowns, compute an inverse from a dense matrix.
DENSE_INVERSE = 3000
# The share of the diagonal that least squares add to it, far above the rounding errors.
DAMPING = 1e-10


def matrix(entries: tuple[Any, tuple[Any, Any]], shape: tuple[int, int]) -> Any:
    """Make a `csr_array`. Values at one position are added up."""
    return coo_array(entries, shape=shape).tocsr()


def weighted(some: Any, weights: Array) -> Any:
    """Multiply each row of a matrix by its weight."""
    return csr_array(some.multiply(weights[:, None]))


def system_solved(square: Any, added: Array, right: Any) -> Any:
    """Solve a linear system after adding n numbers to the diagonal of its n x n matrix."""
    whole = (square + diags_array(added)).tocsc()
    return splu(whole.astype(right.dtype)).solve(right)


def least_squares(some: Any, values: Array, weights: Array) -> Array:
    """Solve a system by weighted least squares. Of several solutions return nearly the smallest."""
    system = weighted(some, weights)
    normal = system.T @ system
    scale = normal.diagonal()
    # A little damping makes the matrix regular, even if there are no equations.
    damping = DAMPING * (scale + (scale.max() or 1.0))
    found: Array = system_solved(normal, damping, system.T @ values)
    return found


def inverse(square: Any, added: Array, rows: NDArray[np.intp]) -> Array:
    """Compute some rows, and the same columns, of the inverse of a symmetric n x n matrix.

    The n numbers in `added` are added to its diagonal.
    """
    block = connected_components(csr_array(square), directed=False)[1]
    found = np.zeros((len(rows), len(rows)))
    for name in np.unique(block[rows]):
        look_at_clock()
        own, wanted = np.flatnonzero(block == name), np.flatnonzero(block[rows] == name)
        part = square[own][:, own]
        found[np.ix_(wanted, wanted)] = _block_inverse(
            part, added[own], np.searchsorted(own, rows[wanted])
        )
    return found


def _block_inverse(square: Any, added: Array, rows: NDArray[np.intp]) -> Array:
    """Compute the same as `inverse` at once."""
    if square.shape[0] <= DENSE_INVERSE:
        # If these rows come last, the wanted part of the inverse depends only on the last block of
        # the Cholesky factor.
        order = np.concatenate([np.setdiff1d(np.arange(len(added)), rows), rows])
        with suppress(np.linalg.LinAlgError):
            whole = square.toarray() + np.diag(added)
            factor = np.linalg.cholesky(whole[np.ix_(order, order)])
            first = len(order) - len(rows)
            root = solve_triangular(factor[first:, first:], np.identity(len(rows)), lower=True)
            part: Array = root.T @ root
            return part
    columns = np.zeros((len(added), len(rows)))
    columns[rows, np.arange(len(rows))] = 1.0
    found: Array = system_solved(square, added, columns)[rows]
    return found
