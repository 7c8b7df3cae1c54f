"""Tiangong: the core module Tianhe, the laboratories Wentian and Mengtian, a docked Shenzhou and Tianzhou."""

import numpy as np
from manifold3d import Manifold

from keepout.core.geometry.builtin.solids import box, rod, sphere, turned, unite


def tiangong(wing_span: float = 56.0, wing_angle: float = 0.0) -> Manifold:
    """Tiangong space station in T form: laboratories along x, the core along y, laboratory wings of 56 m span along y.

    Body frame: Mengtian to +x, Wentian to -x, Tianhe aft along +y, z to nadir; origin at the core's docking hub.

    Public dimensions: Tianhe 16.6 m long, 4.2 m and 2.8 m across, Wentian 17.9 m and Mengtian 17.88 m long, 4.2 m
    across, flexible wings of the laboratories more than 55 m tip to tip, Shenzhou 9 m with 17 m wing span, Tianzhou
    10.6 x 3.35 m with 14.9 m wing span (China Manned Space Agency, en.cmse.gov.cn, module and mission pages). Tianhe's
    wings, 12.6 m each, and places of fittings are read off published drawings to about half a metre.

    Args:
        wing_span: tip to tip of a laboratory's two wings, metres.
        wing_angle: rotation of the laboratories' wings about x, radians; 0 leaves them in the xy plane.

    """
    parts = [*_tianhe(), *_shenzhou(), *_tianzhou()]
    for side in (-1, 1):
        parts += _laboratory(side, airlock=side < 0)
        wings = unite(_flexible_wing(side * 18.2, sign, 0.5 * wing_span) for sign in (-1, 1))
        parts.append(wings.rotate((np.degrees(wing_angle), 0.0, 0.0)))
    return unite(parts)


def _tianhe() -> list[Manifold]:
    """Hub, small and large cylinder, resource section, and two wings along x."""
    parts = [
        sphere((0.0, 0.0, 0.0), 1.55, 32),
        turned(
            (0.0, 0.0, 0.0),
            (0.0, 1.0, 0.0),
            [(1.0, 1.4), (6.6, 1.4), (7.6, 2.1), (13.6, 2.1), (13.7, 1.5), (15.1, 1.5)],
        ),
        rod((0.0, 0.0, 1.2), (0.0, 0.0, 2.1), 0.65),
        rod((0.0, 0.0, -1.2), (0.0, 0.0, -2.1), 0.65),
    ]
    for side in (-1, 1):
        parts.append(rod((0.0, 5.2, 0.0), (side * 2.6, 5.2, 0.0), 0.15, segments=8))
        parts.append(box((side * (2.4 + 6.1), 5.2, 0.0), (12.2, 4.6, 0.08)))
    # The arm, folded along the large cylinder.
    parts.append(rod((0.0, 8.0, -1.9), (0.0, 8.0, -2.5), 0.25))
    parts.append(rod((0.0, 8.0, -2.5), (0.0, 13.0, -2.5), 0.16))
    return parts


def _laboratory(side: int, *, airlock: bool) -> list[Manifold]:
    """Laboratory on the hub's side: tunnel, working cabin, airlock or cargo section, and the truss of its wings."""
    axis = (float(side), 0.0, 0.0)
    cabin = [(1.2, 0.7), (2.2, 0.7), (2.3, 1.3), (3.2, 2.1), (11.4, 2.1), (12.2, 1.3)]
    if airlock:
        parts = [
            turned((0.0, 0.0, 0.0), axis, [*cabin, (15.6, 1.3)]),
            rod((side * 14.0, 0.0, 1.0), (side * 14.0, 0.0, 1.7), 0.6),
            rod((side * 6.0, 0.0, -2.05), (side * 10.5, 0.0, -2.3), 0.2),
        ]
    else:
        parts = [
            turned((0.0, 0.0, 0.0), axis, [*cabin, (12.4, 1.3), (12.5, 2.0), (15.6, 2.0)]),
            box((side * 13.8, 0.0, 1.9), (2.4, 1.6, 0.6)),
        ]
    half = 0.75
    for y in (-half, half):
        parts += [rod((side * 15.4, y, z), (side * 18.8, y, z), 0.12, segments=6) for z in (-half, half)]
    for x in (15.9, 17.3, 18.7):
        parts.append(box((side * x, 0.0, 0.0), (0.2, 2.0 * half + 0.2, 2.0 * half + 0.2)))
    parts.append(rod((side * 15.4, 0.0, 0.0), (side * 19.1, 0.0, 0.0), 0.45))
    return parts


def _flexible_wing(x: float, side: int, tip: float) -> Manifold:
    """One flexible wing: a mast between two blankets, held by a root and a tip bar."""
    root = 1.6
    parts = [
        rod((x, 0.0, 0.0), (x, side * tip, 0.0), 0.2, segments=8),
        box((x, side * root, 0.0), (4.6, 0.35, 0.3)),
        box((x, side * (tip - 0.15), 0.0), (4.6, 0.3, 0.2)),
    ]
    middle, length = 0.5 * side * (root + tip), tip - root
    parts += [box((x + sign * 1.3, middle, 0.0), (1.9, length, 0.08)) for sign in (-1, 1)]
    return unite(parts)


def _shenzhou() -> list[Manifold]:
    """Shenzhou at the hub's forward port: orbital, descent and service modules with two wings along x."""
    return [
        rod((0.0, -1.3, 0.0), (0.0, -2.3, 0.0), 0.6),
        rod((0.0, -2.2, 0.0), (0.0, -4.8, 0.0), 1.12),
        turned((0.0, 0.0, 0.0), (0.0, -1.0, 0.0), [(4.7, 0.9), (7.2, 1.25), (10.4, 1.4)]),
        box((0.0, -8.8, 0.0), (17.0, 2.0, 0.08)),
    ]


def _tianzhou() -> list[Manifold]:
    """Tianzhou at the aft port: cargo cabin and propulsion section with two wings along x."""
    return [
        rod((0.0, 15.0, 0.0), (0.0, 16.0, 0.0), 0.7),
        turned((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), [(15.9, 0.9), (16.9, 1.675), (22.6, 1.675), (22.7, 1.4), (26.2, 1.4)]),
        box((0.0, 24.4, 0.0), (14.9, 2.2, 0.08)),
    ]
