"""A field on a grid: a C² tricubic B-spline over nested sparse blocks, the yardstick of the learned field.

Level ℓ has spacing h 2^ℓ and blocks of 8³ cells; the coarsest covers the domain, finer ones lie ever closer to the
surface. A cubic spline on a grid is also one on the grid of half the spacing, so a fine block beside a coarse one
carries the coarse spline's own coefficients there, and the two join in C² (to the rounding of float32 coefficients).
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32, Int, Int32

from keepout.core.fields.continuation import RadialContinuation
from keepout.core.fields.field import Field, Hessians, Points, Values

BLOCK = 8
"""Cells along a block's edge."""
STORED = BLOCK + 3
"""Coefficients along a block's edge: one before the first cell, two after the last."""
NODES = np.arange(-1, BLOCK + 2)
"""Numbers of the nodes along a block's edge, from the lower face of its first cell."""
_SUBDIVISION = np.zeros((STORED, 7))
"""Coefficients of a half block of parent cells (nodes -1 to 5) to those of the child block (nodes -1 to 9)."""
for _row, _node in enumerate(NODES):
    _k = _node // 2
    if _node % 2 == 0:
        _SUBDIVISION[_row, _k : _k + 3] = (1 / 8, 6 / 8, 1 / 8)
    else:
        _SUBDIVISION[_row, _k + 1 : _k + 3] = (1 / 2, 1 / 2)


class GridField(Field):
    """Σ_i c_i B₃((p - x_i)/h) over the coefficients c of the finest block that holds p.

    Attributes:
        coefficients: (blocks * 11³,) float32, metres; all levels in one table.
        tables: for each level, finest first, the number of each block of the dense grid of blocks, or -1.
        origin: (3,) lower corner of the grid, metres.
        spacing: h of the finest level, metres.
        continuation: what happens beyond the domain.

    """

    coefficients: Float32[Array, "c"]
    tables: tuple[Int32[Array, "_ _ _"], ...]
    origin: Float[Array, "3"]
    spacing: Float[Array, ""]
    continuation: RadialContinuation

    def _cells(self, q: Float[Array, "n 3"]):
        """Find coefficients (n, 4, 4, 4) of each point's cell, its place in the cell (n, 3), and the spacing (n,)."""
        u = (q - self.origin) / self.spacing
        number = jnp.full(q.shape[0], -1)
        place = jnp.zeros_like(u)
        step = jnp.ones(q.shape[0])
        for level in range(len(self.tables) - 1, -1, -1):
            table = self.tables[level]
            scaled = u / 2**level
            block = jnp.clip(jnp.floor(scaled / BLOCK).astype(jnp.int32), 0, jnp.array(table.shape) - 1)
            found = table[block[:, 0], block[:, 1], block[:, 2]]
            here = found >= 0
            number = jnp.where(here, found, number)
            place = jnp.where(here[:, None], scaled - BLOCK * block, place)
            step = jnp.where(here, self.spacing * 2**level, step)
        cell = jnp.clip(jnp.floor(place).astype(jnp.int32), 0, BLOCK - 1)
        blocks = self.coefficients.reshape(-1, STORED, STORED, STORED)
        # Slices of a block, not 64 single numbers: twice as fast on a CPU.
        c = jax.vmap(lambda n, i: jax.lax.dynamic_slice(blocks, (n, i[0], i[1], i[2]), (1, 4, 4, 4))[0])(number, cell)
        return c.astype(jnp.float64), place - cell, step

    def value(self, points: Points) -> Values:
        """Signed distance in metres."""
        flat = points.reshape(-1, 3)
        c, t, _ = self._cells(self.continuation.into_domain(flat))
        x, y, z = (_weights(t[:, axis])[0] for axis in range(3))
        # One axis at a time; all in one contraction would multiply out the 64 weights.
        along = jnp.einsum("nijk,ni->njk", c, x)
        value = jnp.einsum("nk,nk->n", jnp.einsum("njk,nj->nk", along, y), z)
        return self.continuation.value(flat, value).reshape(points.shape[:-1])

    def value_gradient_hessian(self, points: Points) -> tuple[Values, Points, Hessians]:
        """Signed distance in metres, gradient, and Hessian in 1/m."""
        batch = points.shape[:-1]
        flat = points.reshape(-1, 3)
        c, t, h = self._cells(self.continuation.into_domain(flat))
        x, y, z = (jnp.stack(_weights(t[:, axis]), axis=1) for axis in range(3))
        # (n, order along z, i, j), then along y and x.
        along = jnp.einsum("nijk,nck->ncij", c, z)
        along = jnp.einsum("ncij,nbj->ncbi", along, y)
        D = jnp.einsum("ncbi,nai->nabc", along, x)
        gradient = jnp.stack([D[:, 1, 0, 0], D[:, 0, 1, 0], D[:, 0, 0, 1]], axis=-1) / h[:, None]
        rows = [
            [D[:, 2, 0, 0], D[:, 1, 1, 0], D[:, 1, 0, 1]],
            [D[:, 1, 1, 0], D[:, 0, 2, 0], D[:, 0, 1, 1]],
            [D[:, 1, 0, 1], D[:, 0, 1, 1], D[:, 0, 0, 2]],
        ]
        hessian = jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2) / (h * h)[:, None, None]
        value = self.continuation.value(flat, D[:, 0, 0, 0])
        continued = self.continuation.gradient(flat, gradient)
        bent = self.continuation.hessian(flat, gradient, hessian)
        return value.reshape(batch), continued.reshape(*batch, 3), bent.reshape(*batch, 3, 3)


def _weights(t: Float[Array, "n"]) -> tuple[Float[Array, "n 4"], Float[Array, "n 4"], Float[Array, "n 4"]]:
    """Return the four cubic B-spline weights at t in [0, 1], and their first and second derivatives."""
    s = 1.0 - t
    value = jnp.stack([s**3, 3 * t**3 - 6 * t**2 + 4, 3 * s**3 - 6 * s**2 + 4, t**3], axis=-1) / 6.0
    slope = jnp.stack([-(s**2), 3 * t**2 - 4 * t, -(3 * s**2 - 4 * s), t**2], axis=-1) / 2.0
    bend = jnp.stack([s, 3 * t - 2, 3 * s - 2, t], axis=-1)
    return value, slope, bend


def inherited_coefficients(
    parents: Float[np.ndarray, "m 11 11 11"] | Float32[np.ndarray, "m 11 11 11"], blocks: Int[np.ndarray, "m 3"]
) -> Float[np.ndarray, "m 11 11 11"]:
    """Coefficients on each block's nodes with which it is the spline of its parent, the block of twice the spacing."""
    inherited = np.empty((len(blocks), STORED, STORED, STORED))
    for i, block in enumerate(blocks):
        x, y, z = 4 * (block % 2)
        window = parents[i, x : x + 7, y : y + 7, z : z + 7].astype(np.float64)
        inherited[i] = np.einsum("ai,bj,ck,ijk->abc", _SUBDIVISION, _SUBDIVISION, _SUBDIVISION, window, optimize=True)
    return inherited


def own_nodes(table: Int[np.ndarray, "a b c"], blocks: Int[np.ndarray, "m 3"]) -> Bool[np.ndarray, "m 11 11 11"]:
    """Whether every cell that a node reaches lies in a stored block, so that the node may leave the coarser spline."""
    stored = np.pad(table >= 0, 1)
    offsets = [(-1, 0) if n <= 1 else (0,) if n <= 6 else (0, 1) for n in NODES]
    own = np.ones((len(blocks), STORED, STORED, STORED), dtype=bool)
    near = np.empty((len(blocks), 3, 3, 3), dtype=bool)
    for i, j, k in np.ndindex(3, 3, 3):
        near[:, i, j, k] = stored[blocks[:, 0] + i, blocks[:, 1] + j, blocks[:, 2] + k]
    for node in np.ndindex(STORED, STORED, STORED):
        x, y, z = (np.array(offsets[place]) + 1 for place in node)
        own[:, *node] = near[:, x[:, None, None], y[:, None], z].all(axis=(1, 2, 3))
    return own
