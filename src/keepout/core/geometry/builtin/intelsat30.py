"""Intelsat 30: a communications satellite on the SSL-1300 bus, with two wings and four deployed reflectors."""

import numpy as np
from manifold3d import Manifold

from keepout.core.geometry.builtin.solids import box, dish, rod, unite

_HALF_X, _HALF_Y = 1.10, 1.20
_AFT, _DECK = -2.85, 1.35


def intelsat30(wing_span: float = 26.8, wing_angle: float = 0.0) -> Manifold:
    """Build Intelsat 30 in its body frame: wings along x, Earth deck towards +z, reflectors towards ±y.

    Public dimensions: NASA's model of the SSL-1300 (NASA 3D Resources) is 26.8 m along the wings, 8.0 m across the
    deployed reflectors and 6.1 m from the aft end to the top of the feed tower, and shows four reflectors and one
    crosswise panel pair a wing; Intelsat 30 (DLA-1, launched 2014, 6320 kg, 20 kW; Gunter's Space Page) is of that
    family. Its own panel and reflector sizes are not published: those here are read off that model to a tenth of a
    metre.

    Args:
        wing_span: tip to tip along x, metres.
        wing_angle: rotation of both wings about x, radians; 0 leaves the panels in the xy plane.

    """
    bus = box((0.0, 0.0, 0.5 * (_AFT + _DECK)), (2.0 * _HALF_X, 2.0 * _HALF_Y, _DECK - _AFT))
    radiators = [box((side * (_HALF_X + 0.02), 0.0, -0.6), (0.10, 2.70, 3.60)) for side in (-1, 1)]
    engine = rod((0.0, 0.0, _AFT + 0.05), (0.0, 0.0, _AFT - 0.25), 0.12, 0.24)
    hinge = -0.35
    wings = [_wing(side, 0.5 * wing_span).rotate((np.degrees(wing_angle), 0.0, 0.0)) for side in (-1, 1)]
    wings = [wing.translate((0.0, 0.0, hinge)) for wing in wings]
    return unite([bus, *radiators, engine, *wings, *_tower(), *_reflectors()])


def _wing(side: int, tip: float) -> Manifold:
    """Yoke, four panels in line and one crosswise pair, about the x axis."""
    thickness = 0.06
    root = 3.0
    length = (tip - root) / 4.0
    parts = [
        rod((side * (_HALF_X - 0.1), 0.0, 0.0), (side * 1.7, 0.0, 0.0), 0.09),
        rod((side * 1.65, 0.0, 0.0), (side * (root + 0.05), 0.9, 0.0), 0.06),
        rod((side * 1.65, 0.0, 0.0), (side * (root + 0.05), -0.9, 0.0), 0.06),
    ]
    for panel in range(4):
        centre = root + (panel + 0.5) * length
        parts.append(box((side * centre, 0.0, 0.0), (length - 0.06, 2.1, thickness)))
        if panel:
            joint = root + panel * length
            parts += [box((side * joint, y, 0.0), (0.2, 0.12, thickness)) for y in (-0.8, 0.8)]
    cross = root + 2.5 * length
    for sign in (-1, 1):
        parts.append(box((side * cross, sign * 2.17, 0.0), (length - 0.06, 2.1, thickness)))
        parts += [box((side * (cross + x), sign * 1.09, 0.0), (0.12, 0.2, thickness)) for x in (-0.8, 0.8)]
    return unite(parts)


def _tower() -> list[Manifold]:
    """Feed tower on the Earth deck: a tapering block with feed horns aimed at the reflectors, and a small dish."""
    parts = [
        box((0.0, 0.0, _DECK + 0.30), (1.5, 1.2, 0.7)),
        box((0.0, 0.0, _DECK + 0.85), (1.1, 0.8, 0.7)),
        rod((0.0, 0.0, _DECK + 1.1), (0.0, 0.0, 2.75), 0.12),
        dish((0.0, 0.0, 2.72), (0.0, 0.0, 1.0), 0.9, 0.45, 0.04),
        rod((0.0, 0.0, 2.7), (0.0, 0.0, 3.05), 0.05),
    ]
    for x in (-0.55, 0.55):
        for y in (-1, 1):
            parts.append(rod((x, 0.35 * y, _DECK + 0.55), (1.3 * x, 0.85 * y, _DECK + 0.35), 0.10, 0.20))
            parts.append(rod((0.6 * x, 0.25 * y, _DECK + 1.0), (0.9 * x, 0.75 * y, _DECK + 0.95), 0.08, 0.16))
    return parts


def _reflectors() -> list[Manifold]:
    """Four paraboloid shells, two a side at different heights, each on an arm from the bus edge, facing the feeds."""
    parts = []
    places = (
        (-0.95, 2.9, -0.95, 2.3),
        (1.0, 2.6, 0.30, 2.0),
        (-1.0, -2.6, 0.30, 2.0),
        (0.95, -2.9, -0.95, 2.3),
    )
    for x, y, z, diameter in places:
        side = np.sign(y)
        vertex = np.array([x, y, z])
        boresight = np.array([0.0, -0.35 * side, 1.0])
        parts.append(dish(vertex, boresight, diameter, 1.6, 0.05))
        root = np.array([x * 0.75, side * (_HALF_Y - 0.05), z - 0.35])
        parts.append(rod(root, vertex - np.array([0.0, 0.05 * side, 0.01]), 0.06))
        parts.append(rod(root, vertex - np.array([0.0, 0.55 * side, 0.10]), 0.05))
    return parts
