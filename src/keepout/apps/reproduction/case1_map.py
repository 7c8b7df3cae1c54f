"""The map of Case 1: over many start and goal pairs and k_p, how often each choice of circulation is trapped."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from keepout.apps.reproduction.passages import Landed, Passage, Triple
from keepout.core.control.guidance.geodesic import BarrierGrid, geodesic_guidance
from keepout.core.control.guidance.guidance import Guidance, StraightGuidance
from keepout.core.control.guidance.plan import Straight
from keepout.core.mission.build import Mission
from keepout.core.mission.law import build_law

NEAR, FAR = 5.0, 12.0
"""Starts lie between these y (m), goals between their negatives."""
ASIDE, UP = 4.0, 3.0
"""Starts and goals lie within ± these x and z (m)."""
_ROOM = 3.0
"""Between the pairs and the sides of the grid of travel times, m."""


def draw_pairs(count: int, *, seed: int) -> list[tuple[Triple, Triple]]:
    """Draw starts and goals on either side of the target: "±y pairs".

    Uniform and independent: x in [-4, 4] m and z in [-3, 3] m, where bus and dishes are, for both; y in [5, 12] m for
    the start and in [-12, -5] m for the goal.
    That is 1 m and more beside `intelsat30`, whose y ends at ±3.93 m.

    """
    corner = np.array([ASIDE, NEAR, UP])
    points = np.random.default_rng(seed).uniform(corner * (-1.0, 1.0, -1.0), (ASIDE, FAR, UP), (count, 2, 3))
    points[:, 1, 1] *= -1.0
    return [((a[0], a[1], a[2]), (b[0], b[1], b[2])) for a, b in points.tolist()]


def map_rows(
    choice: str, lengths: Sequence[float | None], pairs: int, landed: Mapping[str, np.ndarray]
) -> list[dict[str, Any]]:
    """Count what became of the passages of one choice: a row for each k_p, `pairs` passages each, in that order."""
    rows = []
    for place, length in enumerate(lengths):
        own = {name: column[place * pairs : (place + 1) * pairs] for name, column in landed.items()}
        arrived, touched = np.isfinite(own["first_within_s"]), own["contact"] != "no"
        rows.append(
            {
                "circulation": choice,
                "k_p m": length,
                "pairs": pairs,
                "trapped": int(own["trapped"].sum()),
                "arrived": int(arrived.sum()),
                "clean": int(np.sum(arrived & ~touched)),
                "touched": int(touched.sum()),
                "least gap m": round(float(own["minimum_clearance_m"].min()), 4),
            }
        )
    return rows


def only(landed: Landed, first: int) -> Landed:
    """Leave out the first passages, and the logs."""
    return {name: column[first:] for name, column in landed.items() if not name.startswith("log_")}


def geodesic_passages(
    mission: Mission, pairs: Sequence[tuple[Triple, Triple]]
) -> tuple[Mission, Callable[[Sequence[Passage]], Guidance]]:
    """Give the default law for all pairs, without a guard, and what makes their geodesic guidances, stacked.

    One barrier grid serves them all; a way is marched for each goal, from it to its start.
    """
    points = np.asarray(pairs).reshape(-1, 3)
    reach = float(np.linalg.norm(points, axis=1).max())
    law = build_law(mission.scenario, mission.model, guidance=Straight(), reach=reach)
    leader, offset = law.velocity.guidance, float(law.velocity.offset)
    assert isinstance(leader, StraightGuidance)
    lower = np.minimum(points.min(axis=0), mission.target.vertices.min(axis=0)) - _ROOM
    upper = np.maximum(points.max(axis=0), mission.target.vertices.max(axis=0)) + _ROOM
    grid = BarrierGrid.build(mission.model.field, offset, lower, upper)
    speed, length = float(leader.speed), float(leader.slowing_length)

    def stacked(passages: Sequence[Passage]) -> Guidance:
        made = {
            passage: geodesic_guidance(
                grid,
                mission.model.field,
                offset,
                np.asarray(passage.goal),
                speed=speed,
                slowing_length=length,
                start=np.asarray(passage.start),
            )
            for passage in set(passages)
        }
        return jax.tree.map(lambda *leaves: jnp.stack(leaves), *(made[passage] for passage in passages))

    return mission.with_law(law), stacked
