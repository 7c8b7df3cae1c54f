"""Linear equations of a few rows, written out: a library's factorisation would be a call of its own at every step."""

from jax import numpy as jnp
from jaxtyping import Array, Float

Factor = list[list[Float[Array, ""]]]
"""The rows of a lower triangle."""


def factorised(matrix: Float[Array, "m m"]) -> Factor:
    """Give L of a positive definite S = L Lᵀ (Cholesky); only the lower triangle of S is looked at."""
    lower: Factor = []
    for i in range(matrix.shape[0]):
        row: list[Float[Array, ""]] = []
        for j in range(i + 1):
            rest = matrix[i, j]
            for k in range(j):
                rest = rest - row[k] * (lower[j][k] if j < i else row[k])
            row.append(jnp.sqrt(rest) if i == j else rest / lower[j][j])
        lower.append(row)
    return lower


def solved(lower: Factor, right: Float[Array, "m *rest"]) -> Float[Array, "m *rest"]:
    """Give L⁻¹ b."""
    rows: list[Array] = []
    for i, row in enumerate(lower):
        rest = right[i]
        for k in range(i):
            rest = rest - row[k] * rows[k]
        rows.append(rest / row[i])
    return jnp.stack(rows)


def solved_back(lower: Factor, right: Float[Array, "m *rest"]) -> Float[Array, "m *rest"]:
    """Give L⁻ᵀ b."""
    count = len(lower)
    rows: list[Array] = []
    for i in reversed(range(count)):
        rest = right[i]
        for k in range(i + 1, count):
            rest = rest - lower[k][i] * rows[count - 1 - k]
        rows.append(rest / lower[i][i])
    return jnp.stack(rows[::-1])
