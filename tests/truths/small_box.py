"""A box of 2 x 1 x 1 m, its closed form, and what is built of it once for all tests of a process."""

import functools
import os
from pathlib import Path

import numpy as np

from keepout.core.fields.grid_build import build_grid
from keepout.core.fields.model import FieldModel
from keepout.core.geometry.offset_solid import OffsetSolid
from keepout.core.geometry.target import Target
from keepout.core.proof.grid import certify_grid

PARAMETERS = {"length": 2.0, "width": 1.0, "height": 1.0}
RADIUS = 0.3
"""Of the chaser that the grid is certified for, besides a point, metres."""


@functools.cache
def target() -> Target:
    return Target.load("box", parameters=PARAMETERS)


@functools.cache
def solid() -> OffsetSolid:
    return OffsetSolid.build(target().distance)


@functools.cache
def grid() -> FieldModel:
    """A certified grid field of two levels, so that blocks of both meet: certified once in a run of the tests."""
    kept = Path(os.environ["KEEPOUT_TESTS_BUILT"], "small-box.keepout")
    if not kept.exists():
        model = build_grid(target(), spacing=0.08, band=0.4, solid=solid())
        assert len(model.field.tables) == 2
        assert (np.asarray(model.field.tables[0]) < 0).any()
        certify_grid(certify_grid(model, target()), target(), chaser_radius=RADIUS).save(kept)
    return FieldModel.load(kept, target=target())


def distance(points: np.ndarray) -> np.ndarray:
    """Signed distance from the box, m; within it minus the depth."""
    q = np.abs(points) - np.array([1.0, 0.5, 0.5])
    return np.linalg.norm(np.maximum(q, 0.0), axis=1) + np.minimum(q.max(axis=1), 0.0)
