"""Building a grid field from exact distances."""

import dataclasses
import time

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Float32, Int

from keepout.core.errors import FieldError
from keepout.core.fields.continuation import Domain
from keepout.core.fields.grid import BLOCK, NODES, STORED, GridField, inherited_coefficients, own_nodes
from keepout.core.fields.model import FieldModel
from keepout.core.geometry.offset_solid import OffsetSolid
from keepout.core.geometry.target import Target
from keepout.core.progress import Progress, silent

_COARSEST_BLOCKS = 6
_PIECE = 200_000


def build_grid(
    target: Target,
    *,
    spacing: float = 0.1,
    band: float = 0.8,
    solid: OffsetSolid | None = None,
    progress: Progress = silent,
) -> FieldModel:
    """Build the grid field of a target as quasi-interpolant: coefficients are the signed distance at the nodes.

    Args:
        target: what to build.
        spacing: h of the finest level, metres.
        band: blocks within this distance of a surface are of the finest level, metres; at least the chaser's radius.
        solid: the target's offset solid, if already built.
        progress: called as the build advances.

    Raises:
        FieldError: a spacing or band that is not positive.

    """
    if not (spacing > 0.0 and band > 0.0):
        raise FieldError(f"spacing {spacing} m, band {band} m; both must be positive")
    start = time.perf_counter()
    if solid is None:
        solid = OffsetSolid.build(target.distance, progress=lambda part, text: progress(0.3 * part, text))
    domain = Domain.around(target.distance)
    width = 2.0 * domain.learned_radius + 4.0 * spacing
    levels = max(1, int(np.ceil(np.log2(width / (_COARSEST_BLOCKS * BLOCK * spacing)))))
    count = int(np.ceil(width / (BLOCK * spacing * 2 ** (levels - 1))))
    origin = domain.centre - 0.5 * count * BLOCK * spacing * 2 ** (levels - 1)

    tables: list[Int[np.ndarray, "_ _ _"]] = []
    coefficients: list[Float[np.ndarray, "_ 11 11 11"]] = []
    numbered = 0
    for level in range(levels - 1, -1, -1):
        h = spacing * 2**level
        here = _Level(solid, origin, h)
        shape = (count * 2 ** (levels - 1 - level),) * 3
        if not tables:
            blocks = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1).reshape(-1, 3)
            inherited = None
        else:
            blocks = here.near(tables[-1], max(band, 6.0 * h))
            parents = tables[-1][tuple((blocks // 2).T)] - (numbered - len(coefficients[-1]))
            inherited = inherited_coefficients(coefficients[-1][parents], blocks)
        table = np.full(shape, -1, dtype=np.int32)
        table[tuple(blocks.T)] = numbered + np.arange(len(blocks))
        values = here.coefficients(table, blocks, inherited)
        numbered += len(blocks)
        tables.append(table)
        coefficients.append(values)
        progress(0.3 + 0.7 * (levels - level) / levels, f"level {level}: {len(blocks)} blocks of {h:g} m cells")

    # The spline of spacing h over-states d by at most √(d² + h²) - d (docs/certificate.md), and from ρ_0 on d is at
    # least `away`.
    away, coarsest = domain.domain_radius - domain.target_radius, spacing * 2 ** (levels - 1)
    field = GridField(
        jnp.asarray(np.concatenate(coefficients).reshape(-1)),
        tuple(jnp.asarray(t) for t in reversed(tables)),
        jnp.asarray(origin),
        jnp.asarray(spacing, jnp.float64),
        domain.continuation(np.hypot(away, coarsest) - away),
    )
    training = {"profile": "grid", "spacing": spacing, "band": band, "seconds": time.perf_counter() - start}
    return FieldModel(field, target.name, target.sha256, solid.offset, training)


@dataclasses.dataclass(frozen=True)
class _Level:
    """A level of a grid about a solid: where its blocks begin, and the spacing h of its nodes, metres."""

    solid: OffsetSolid
    origin: Float[np.ndarray, "3"]
    h: float

    def near(self, table: Int[np.ndarray, "a b c"], band: float) -> Int[np.ndarray, "m 3"]:
        """Blocks of this spacing near a surface inside the blocks of a table of twice the spacing."""
        corner = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), axis=-1).reshape(-1, 3)
        blocks = (2 * np.argwhere(table >= 0)[:, None, :] + corner).reshape(-1, 3)
        half = 0.5 * BLOCK * self.h
        centres = self.origin + (2.0 * blocks + 1.0) * half
        reach = half * np.sqrt(3.0)
        keep = self.solid.distance.distance(centres) <= band + reach
        # All of the block is deep inside otherwise.
        keep[keep] = self.solid.signed_distance(centres[keep]) + reach > -self.h
        return blocks[keep]

    def coefficients(
        self,
        table: Int[np.ndarray, "a b c"],
        blocks: Int[np.ndarray, "m 3"],
        inherited: Float[np.ndarray, "m 11 11 11"] | None,
    ) -> Float32[np.ndarray, "m 11 11 11"]:
        """Signed distances at the nodes, or the coarser spline's coefficients, rounded down to float32."""
        local = np.stack(np.meshgrid(NODES, NODES, NODES, indexing="ij"), axis=-1)
        nodes = (BLOCK * blocks[:, None, None, None, :] + local).reshape(-1, 3)
        extent = BLOCK * max(table.shape) + 4
        code = ((nodes[:, 0] + 1) * extent + nodes[:, 1] + 1) * extent + nodes[:, 2] + 1
        unique, back = np.unique(code, return_inverse=True)
        grid = np.stack([unique // extent**2, unique // extent % extent, unique % extent], axis=-1) - 1
        points = self.origin + self.h * grid
        pieces = [points[first : first + _PIECE] for first in range(0, len(points), _PIECE)]
        signed = np.concatenate([np.zeros(0), *map(self.solid.signed_distance, pieces)])
        signed = signed[back].reshape(len(blocks), STORED, STORED, STORED)
        if inherited is not None:
            signed = np.where(own_nodes(table, blocks), signed, inherited)
        rounded = signed.astype(np.float32)
        return np.where(rounded > signed, np.nextafter(rounded, np.float32(-np.inf)), rounded)
