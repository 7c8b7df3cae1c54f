"""The measures of fields learned from maps, on fields whose answers are known: the box's own distance, and others."""

import learned_maps
import numpy as np
import pytest
from truths.boxes import HALF, box_distance, contact_with_box

from keepout.core.geometry.offset_solid import OffsetSolid
from keepout.core.geometry.target import Target

RADIUS = learned_maps.RADIUS


@pytest.fixture(scope="module")
def solid() -> OffsetSolid:
    return OffsetSolid.build(Target.load("box").distance, offset=0.001)


def signed(points: np.ndarray) -> np.ndarray:
    inside = np.minimum(np.max(np.abs(points) - HALF, axis=1), 0.0)
    return box_distance(points) + inside


@pytest.mark.long
def test_the_boxs_own_distance_loses_nothing(solid):
    found = learned_maps.measure(signed, RADIUS, solid, contact_with_box(1000, 0.0))
    # Steiner's formula for the box grown by the chaser's radius.
    a, b, c = 2.0 * HALF
    mean_width = np.pi * RADIUS**2 * (a + b + c) + 4.0 / 3.0 * np.pi * RADIUS**3
    grown = a * b * c + 2.0 * RADIUS * (a * b + b * c + c * a) + mean_width
    assert found["inside_m3"] == pytest.approx(grown, rel=0.02)
    assert found["inside_m3"] == pytest.approx(found["contact_of_mesh_m3"], rel=1e-3)
    assert found["p95_at_1_m"] < 1e-6
    assert found["p95_at_returns_m"] < 1e-6
    assert found["goals_reached_share"] == 1.0
