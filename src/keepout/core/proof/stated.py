"""How far a field with a stated Lipschitz bound can over-state the distance where a chaser touches."""

import numpy as np

from keepout.core.errors import FieldError
from keepout.core.fields.evaluate import values
from keepout.core.fields.own import FunctionField
from keepout.core.geometry.octree import straddling_cells
from keepout.core.geometry.target import Target


def error_bound(field: FunctionField, target: Target, chaser_radius: float, *, leaf: float = 0.1) -> float:
    """Give e_h in metres with f̃ ≤ R + e_h wherever the exact distance to the target is R.

    {d = R} is covered by cubes; in a cube of centre c and half diagonal ρ the field is at most f̃(c) + L ρ. So the bound
    is proved where the field's Lipschitz bound L is true. It is loose by up to 2 L ρ; smaller cubes take longer.

    Args:
        field: with its Lipschitz bound, stated or sampled; the answer is of the same kind.
        target: the mesh.
        chaser_radius: R, m.
        leaf: side of the cubes, m.

    Raises:
        FieldError: a radius that is negative or not finite.

    """
    if not 0.0 <= chaser_radius < np.inf:
        raise FieldError(f"error bound: chaser radius {chaser_radius} m; it must be 0 or more, and finite")
    distance, room = target.distance, chaser_radius + leaf
    centres, half = straddling_cells(
        distance, chaser_radius, leaf=leaf, lower=distance.lower - room, upper=distance.upper + room
    )
    most = values(field, centres) + field.lipschitz * np.sqrt(3.0) * half
    return float(most.max()) - chaser_radius
