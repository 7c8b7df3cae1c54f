"""A scenario's target: loaded, and not touched by the chaser where the flight begins and ends. Needs no JAX."""

import numpy as np
from jaxtyping import Float

from keepout.core.audit.audit import proved_outside
from keepout.core.errors import ScenarioError
from keepout.core.geometry.distance import distance_within
from keepout.core.geometry.target import Target
from keepout.core.mission.entries import TargetEntry
from keepout.core.mission.scenario import Scenario


def load_target(entry: TargetEntry) -> Target:
    """Load a scenario's target."""
    return Target.load(**entry.model_dump(exclude={"centre_of_mass"}))


def require_apart(scenario: Scenario, target: Target) -> None:
    """Refuse a start or goal where the chaser would touch the target.

    Raises:
        ScenarioError: it would.

    """
    radius = scenario.chaser.radius
    for name, position in (("start", scenario.start.position), ("goal", scenario.goal.position)):
        point = np.asarray(position)
        if target.ball_radius > 0.0:
            distance = float(target.distance.distance(point[None])[0])
        else:  # without the hierarchy of triangles, which is compiled first
            distance = distance_within(target.vertices, target.faces, point, radius)
        if distance <= radius:
            raise ScenarioError(
                f"{name}.position: {list(position)} m is {distance:.3f} m from the target, where a chaser of radius "
                f"{radius} m touches it; it must be further than that radius"
            )
        if is_enclosed(target, point):
            raise ScenarioError(
                f"{name}.position: {list(position)} m is inside the target: its surface is closed around that place, "
                "and no way leads out; give a place outside"
            )


def is_enclosed(target: Target, point: Float[np.ndarray, "3"]) -> bool:
    """Whether a mesh whose edges all close winds around a point (m) off its surface; False where the mesh is open.

    Along a path that crosses no triangle of such a mesh the winding number stays the same, and far away it is 0.
    """
    faces = target.faces.astype(np.int64)
    count = len(target.vertices)
    ahead, back = (np.sort((faces * count + np.roll(faces, turn, axis=1)).ravel()) for turn in (-1, 1))
    if not np.array_equal(ahead, back):
        return False
    a, b, c = np.moveaxis(target.vertices[faces] - point, 1, 0)
    la, lb, lc = (np.linalg.norm(corner, axis=1) for corner in (a, b, c))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c))
    around = la * lb * lc + sum(np.einsum("ij,ij->i", x, y) * z for x, y, z in ((a, b, lc), (b, c, la), (c, a, lb)))
    return bool(abs(np.arctan2(volume, around).sum()) > np.pi)


def room_to_start(scenario: Scenario) -> float:
    """Give the distance (m) from the mesh that a random start needs: chaser, margin and 0.2 m."""
    return scenario.chaser.radius + scenario.safety.margin + 0.2


def has_way_out(scenario: Scenario, target: Target, point: Float[np.ndarray, "3"], away: float | None = None) -> bool:
    """Whether the chaser is proved to get from a point (m) out of the target; `away` is its distance (m), if known."""
    mesh, radius = target.distance, scenario.chaser.radius
    return proved_outside(point, mesh.distance, mesh.lower, mesh.upper, radius=radius, expansions=100, away=away)
