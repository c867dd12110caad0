"""Linear systems and inverses of matrices that are dense or sparse."""

from __future__ import annotations

from contextlib import suppress
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.sparse import csr_array, diags_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from ssh_abduction.runtime.clock import look_at_clock

Array: TypeAlias = NDArray[np.float64]

# With at most this many unknowns, compute an inverse from a dense matrix. A matrix whose product
# with itself takes at most DENSE_PRODUCT multiplications is dense.
DENSE_INVERSE, DENSE_PRODUCT = 3000, 3_000_000
# The share of the diagonal that least squares add to it, far above the rounding errors.
DAMPING = 1e-10


def matrix(
    values: NDArray[Any], rows: NDArray[np.int_], columns: NDArray[np.int_], shape: tuple[int, int]
) -> Any:
    """Make a matrix. Add up values with the same row and column.

    A small one is dense, as scipy takes longer to make it sparse than to multiply it.
    """
    if shape[0] * shape[1] ** 2 > DENSE_PRODUCT:
        return csr_array((values, (rows, columns)), shape=shape)
    made = np.zeros(shape, dtype=values.dtype)
    np.add.at(made, (rows, columns), values)
    return made


def dense(some: Any) -> NDArray[Any]:
    """Return a dense or sparse matrix as a dense one."""
    found: NDArray[Any] = some if isinstance(some, np.ndarray) else some.toarray()
    return found


def weighted(weights: Array, some: Any) -> Any:
    """Multiply each row of a dense or sparse matrix by its weight."""
    if isinstance(some, np.ndarray):
        return weights[:, None] * some
    return diags_array(weights) @ some


def raised(square: Any, added: Array) -> Any:
    """Add n numbers to the diagonal of a dense or sparse n x n matrix."""
    return square + (np.diag(added) if isinstance(square, np.ndarray) else diags_array(added))


def difference_matrix(first: NDArray[np.int_], second: NDArray[np.int_], size: int) -> Any:
    """Make the matrix that maps a vector x to the differences x[second] - x[first]."""
    each = np.arange(len(first))
    values, rows = np.repeat([1.0, -1.0], len(first)), np.concatenate([each, each])
    return matrix(values, rows, np.concatenate([second, first]), (len(first), size))


def system_solved(square: Any, added: Array, right: Any) -> Any:
    """Solve a linear system after adding n numbers to the diagonal of its n x n matrix."""
    whole = raised(square, added)
    if isinstance(whole, np.ndarray):
        return np.linalg.solve(whole, right)
    return splu(whole.tocsc().astype(right.dtype)).solve(right)


def least_squares(some: Any, values: Array, weights: Array) -> Array:
    """Solve a system by weighted least squares. Of several solutions return nearly the smallest.

    `values` may have several columns. Each is solved for by itself.
    """
    rows = weighted(weights, some)
    normal = rows.T @ rows
    scale = normal.diagonal()
    # A little damping makes the matrix regular, even if there are no equations.
    damping = DAMPING * (scale + (scale.max() or 1.0))
    right = rows.T @ (values.T * weights).T
    found: Array = system_solved(normal, damping, right)
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
            whole = raised(dense(square), added)
            factor = np.linalg.cholesky(whole[np.ix_(order, order)])
            first = len(order) - len(rows)
            root = solve_triangular(factor[first:, first:], np.identity(len(rows)), lower=True)
            part: Array = root.T @ root
            return part
    columns = np.zeros((len(added), len(rows)))
    columns[rows, np.arange(len(rows))] = 1.0
    found: Array = system_solved(square, added, columns)[rows]
    return found
