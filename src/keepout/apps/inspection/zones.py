"""The mesh and a scenario's zones as one distance: for drifts, which begin at any time, and for places to look from.

What zones are to law, guard and audit is in `core/mission/zones.py`.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from keepout.core.audit.tube import lengths
from keepout.core.audit.zones import Signed
from keepout.core.compiled.kept_executables import kept_jit
from keepout.core.fields.field import PIECE, in_pieces
from keepout.core.fields.zones import SweptCone, Zone
from keepout.core.geometry.distance import Distance
from keepout.core.mission.surroundings import Surroundings
from keepout.core.mission.zones import standing_zone, zones_judged
from keepout.core.motion.arrays import as_float64

Points = Float[np.ndarray, "points 3"]
Numbers = Float[np.ndarray, "points"]
Nearest = Callable[[Points, Int[np.ndarray, "points"], Numbers, Numbers], tuple[Numbers, Numbers]]
"""Of points (m) on drifts, by their index, so many s after these began: the least distance at that time, m.

With it a lower bound, 1-Lipschitz in the point, for as many s before and after as are given.
"""
_FEW = 64
"""Places, up to which no whole piece of them is asked for."""


def with_zones(distance: Signed, around: Surroundings, begun: Float[np.ndarray, "drifts"]) -> Nearest:
    """Give the least of a mesh's distance and of those to zones that have not ended when drifts begin (s).

    These count until the drift is over, as nobody says "go" any more. A zone that turns by ψ or less against its axes
    at a moment is nearer by at most ψ‖p‖ (docs/guard.md, section 9).
    """
    zones, period = zones_judged(around), around.scenario.control.period

    def nearest(
        points: Points, drifts: Int[np.ndarray, "points"], since: Numbers, about: Numbers
    ) -> tuple[Numbers, Numbers]:
        found = distance(points)
        least, time = found, begun[drifts] + since
        for zone in zones:
            moment = np.minimum(np.rint(time / period).astype(int), len(zone.rotations) - 1)
            away = zone.distance(np.einsum("nij,nj->ni", zone.rotations[moment], points))
            turned = zone.rate * (about + 0.5 * period)
            nearer = (away - turned * lengths(points)) / (1.0 + turned)
            stood = begun[drifts] < zone.until
            found = np.where(stood & (time >= zone.start), np.minimum(found, away), found)
            least = np.where(stood & (time + about >= zone.start), np.minimum(least, nearer), least)
        return found, least

    return nearest


class MeshAndZones:
    """The least of a mesh's distance and of those to a scenario's zones, m: negative in a zone, and 1-Lipschitz.

    A zone counts with all the room that it takes at any time of the flight, as law and guard ask it at the start.
    """

    def __init__(self, mesh: Distance, around: Surroundings) -> None:
        self._mesh = mesh
        zones = tuple(standing_zone(around, entry, 0.0) for entry in around.scenario.zone)
        self._nearest = functools.partial(_nearest, zones)

    def distance(self, points: Points) -> Numbers:
        """Give it of points (m)."""
        size = _FEW if len(points) <= _FEW else PIECE
        return np.minimum(self._mesh.distance(points), in_pieces(self._nearest, points, size))


def mesh_and_zones(mesh: Distance, around: Surroundings) -> Distance | MeshAndZones:
    """Give the distance to both, or the mesh's own where the scenario has no zones."""
    return MeshAndZones(mesh, around) if around.scenario.zone else mesh


@kept_jit
def _nearest(zones: tuple[Zone | SweptCone, ...], points: Float[Array, "points 3"]) -> Float[Array, "points"]:
    start = as_float64(0.0)
    return jax.vmap(lambda point: jnp.min(jnp.stack([zone.value(point, start) for zone in zones])))(points)
