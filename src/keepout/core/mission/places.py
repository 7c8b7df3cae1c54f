"""Places to start from: room beside the target, and a proved way out of it."""

import numpy as np
from jaxtyping import Float

from keepout.core.audit.outside import proved_outside
from keepout.core.geometry.target import Target
from keepout.core.mission.scenario import Scenario


def room_to_start(scenario: Scenario) -> float:
    """Give the distance (m) from the mesh that a random start needs: chaser, margin and 0.2 m."""
    return scenario.chaser.radius + scenario.safety.margin + 0.2


def has_way_out(scenario: Scenario, target: Target, point: Float[np.ndarray, "3"], away: float | None = None) -> bool:
    """Whether the chaser is proved to get from a point (m) out of the target; `away` is its distance (m), if known."""
    mesh, radius = target.distance, scenario.chaser.radius
    return proved_outside(point, mesh.distance, mesh.lower, mesh.upper, radius=radius, expansions=100, away=away)
