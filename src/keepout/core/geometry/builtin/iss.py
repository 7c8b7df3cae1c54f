"""The International Space Station: truss, eight array wings, radiators and the pressurised modules."""

import numpy as np
from manifold3d import Manifold

from keepout.core.geometry.builtin.solids import box, rod, sphere, turned, unite

_STACK = 4.6
"""Metres from the truss axis to the axis of the pressurised modules, towards nadir."""


def iss(wing_span: float = 73.9, wing_angle: float = 0.0) -> Manifold:
    """International Space Station: truss along x, modules along y below it, eight wings of two blankets.

    Body frame: x to starboard along the truss, y aft, z to nadir; origin on the truss axis at its middle segment.

    Public dimensions: 109 m end to end along the truss, array wings of 35 m by 12 m with two blankets each (NASA,
    "International Space Station Facts and Figures"); Destiny 8.5 x 4.3 m, Harmony 7.2 x 4.5 m, Unity 5.5 x 4.6 m,
    Tranquility 6.7 x 4.5 m, Columbus 6.9 x 4.5 m, Kibo 11.2 x 4.4 m, Quest 5.5 x 4.0 m, Zarya 12.6 x 4.1 m, Zvezda
    13.1 x 4.15 m with arrays of 29.7 m span, Nauka 13.1 x 4.25 m, Rassvet 6.0 x 2.35 m (NASA, "Reference Guide to the
    International Space Station", 2015; ESA and JAXA module fact sheets); radiators of 23.3 x 3.4 m a panel (heat
    rejection) and 13.6 x 3.1 m (photovoltaic). Places along the truss follow NASA's 42 model to about half a metre;
    the lattice and equipment are simplified.

    The goal [0, -10, 6] m that Zhou et al. fly to lies inside Harmony in this frame, not in free space.

    Args:
        wing_span: tip to tip of two opposite wings, metres.
        wing_angle: rotation of all eight wings about the truss (the alpha joints), radians; 0 leaves them in the xy
        plane.

    """
    wings = unite(_wing(x, side, 0.5 * wing_span) for x in (-48.4, -33.0, 33.0, 48.4) for side in (-1, 1))
    wings = wings.rotate((np.degrees(wing_angle), 0.0, 0.0))
    return unite([wings, *_truss(), *_radiators(), *_american_segment(), *_russian_segment()])


def _wing(x: float, side: int, tip: float) -> Manifold:
    """Mast canister and mast, and a blanket on each side of the mast between two blanket boxes."""
    root = 3.2
    parts = [
        rod((x, 0.0, 0.0), (x, side * root, 0.0), 0.7),
        rod((x, side * root, 0.0), (x, side * tip, 0.0), 0.35, segments=8),
        box((x, side * (root + 0.2), 0.0), (12.0, 0.4, 0.35)),
        box((x, side * (tip - 0.15), 0.0), (12.0, 0.3, 0.25)),
    ]
    middle, length = 0.5 * side * (root + tip), tip - root
    parts += [box((x + sign * 3.35, middle, 0.0), (4.6, length - 0.2, 0.1)) for sign in (-1, 1)]
    return unite(parts)


def _truss() -> list[Manifold]:
    """Four longerons with frames and diagonals round a core of equipment; slimmer outboard of the alpha joints."""
    parts = [
        box((0.0, 0.0, 0.0), (26.0, 2.0, 2.0)),
        box((0.0, 0.0, 0.0), (104.0, 0.9, 0.9)),
        box((0.0, 0.0, 1.5), (10.0, 4.2, 2.4)),
    ]
    parts += [box((x, 0.0, 0.0), (4.4, 3.4, 3.4)) for x in (-48.4, -33.0, 33.0, 48.4)]
    parts += [rod((side * 25.6, 0.0, 0.0), (side * 27.4, 0.0, 0.0), 1.9, segments=32) for side in (-1, 1)]
    parts += [box((side * 17.0, 1.4, 0.0), (3.4, 1.6, 2.6)) for side in (-1, 1)]
    for half, first, last, bays in ((1.9, -25.6, 25.6, 14), (1.45, 27.4, 51.8, 7), (1.45, -51.8, -27.4, 7)):
        corners = [(half * y, half * z) for y, z in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        stations = np.linspace(first, last, bays + 1)
        parts += [rod((first, *corner), (last, *corner), 0.14, segments=6) for corner in corners]
        for k, x in enumerate(stations):
            for i in range(4):
                start, end = corners[i], corners[(i + 1) % 4]
                parts.append(rod((x, *start), (x, *end), 0.11, segments=6))
                if k < bays:
                    a, b = (start, end) if (k + i) % 2 else (end, start)
                    parts.append(rod((x, *a), (stations[k + 1], *b), 0.08, segments=6))
    return parts


def _radiators() -> list[Manifold]:
    """Three heat-rejection panels on either side aft of the truss, and four photovoltaic radiators."""
    parts = []
    for side in (-1, 1):
        parts.append(box((side * 14.0, 2.8, 0.0), (11.5, 1.2, 0.8)))
        parts += [box((side * (14.0 + 3.8 * k), 3.0 + 11.65, 0.0), (3.4, 23.3, 0.12)) for k in (-1, 0, 1)]
    for x in (-44.6, -29.4, 29.4, 44.6):
        parts.append(rod((x, 0.0, -0.3), (x, 0.0, -2.4), 0.3, segments=8))
        parts.append(box((x, 0.0, -2.2 - 6.8), (3.1, 0.12, 13.6)))
    return parts


def _module(y: float, length: float, diameter: float, x: float = 0.0, along: str = "y") -> Manifold:
    """Revolve a cylinder with conical ends about its middle, at the height of the module stack."""
    half, radius = 0.5 * length, 0.5 * diameter
    outline = [(-half, 0.5 * radius), (0.7 - half, radius), (half - 0.7, radius), (half, 0.5 * radius)]
    return turned((x, y, _STACK), (1.0, 0.0, 0.0) if along == "x" else (0.0, 1.0, 0.0), outline)


def _american_segment() -> list[Manifold]:
    """Docking adapter, Harmony with Columbus and Kibo, Destiny, Unity with Quest, Tranquility and the Cupola."""
    parts = [
        rod((0.0, -15.6, _STACK), (0.0, -13.4, _STACK), 0.75, 1.0),
        _module(-10.0, 7.2, 4.5),
        _module(-2.2, 8.6, 4.3),
        _module(4.8, 5.6, 4.6),
        _module(-10.0, 6.9, 4.5, x=5.6, along="x"),
        _module(-10.0, 11.2, 4.4, x=-7.8, along="x"),
        rod((-9.0, -10.0, _STACK - 2.0), (-9.0, -10.0, _STACK - 6.0), 2.2, segments=32),
        box((-16.0, -10.0, _STACK - 0.4), (5.2, 4.6, 1.0)),
        rod((-13.0, -10.0, _STACK), (-16.5, -10.0, _STACK), 0.5),
        _module(4.8, 5.5, 4.0, x=4.9, along="x"),
        _module(4.8, 6.7, 4.5, x=-5.5, along="x"),
        rod((-6.0, 4.8, _STACK + 2.0), (-6.0, 4.8, _STACK + 3.6), 1.45, 1.0),
        rod((0.0, -10.0, _STACK + 2.0), (0.0, -10.0, _STACK + 3.0), 0.8),
        rod((0.0, 7.4, _STACK), (0.0, 9.9, _STACK), 1.0, 0.75),
        rod((0.0, -2.2, 2.2), (0.0, -2.2, 3.0), 1.2),
    ]
    # The station's arm, folded along the truss front.
    parts += [rod((-1.0, -0.8, 0.0), (4.0, -4.2, -1.5), 0.18), rod((4.0, -4.2, -1.5), (10.5, -3.0, -0.5), 0.18)]
    return parts


def _russian_segment() -> list[Manifold]:
    """Zarya, Zvezda with its arrays, Rassvet, Nauka and Prichal towards nadir, Poisk to zenith, and docked ships."""
    aft = (0.0, 1.0, 0.0)
    parts = [
        turned((0.0, 0.0, _STACK), aft, [(9.8, 0.75), (11.0, 2.05), (20.0, 2.05), (20.1, 1.4), (22.4, 1.4)]),
        sphere((0.0, 23.2, _STACK), 1.3),
        turned((0.0, 0.0, _STACK), aft, [(24.0, 1.45), (27.2, 1.45), (28.4, 2.08), (35.6, 2.08)]),
    ]
    for side in (-1, 1):
        parts.append(rod((0.0, 30.2, _STACK), (side * 4.0, 30.2, _STACK), 0.2, segments=8))
        parts.append(box((side * (3.6 + 5.62), 30.2, _STACK), (11.25, 3.4, 0.1)))
    parts += _ship((0.0, 35.6, _STACK), aft)
    parts += [rod((0.0, 12.6, _STACK + 1.8), (0.0, 12.6, _STACK + 8.0), 1.17)]
    parts += _ship((0.0, 12.6, _STACK + 8.0), (0.0, 0.0, 1.0))
    parts += [
        turned((0.0, 23.2, _STACK), (0.0, 0.0, 1.0), [(0.9, 1.25), (4.9, 1.25), (5.0, 2.12), (14.2, 2.12)]),
        sphere((0.0, 23.2, _STACK + 15.6), 1.65),
        rod((0.0, 23.2, _STACK - 1.0), (0.0, 23.2, _STACK - 5.0), 1.25),
    ]
    for side in (-1, 1):
        parts.append(rod((0.0, 23.2, _STACK + 9.0), (side * 3.2, 23.2, _STACK + 9.0), 0.15, segments=8))
        parts.append(box((side * 7.6, 23.2, _STACK + 9.0), (9.0, 0.1, 2.6)))
    return parts


def _ship(port: tuple[float, float, float], axis: tuple[float, float, float]) -> list[Manifold]:
    """Soyuz or Progress, 7.2 x 2.7 m with wings of 10.6 m span, docked at a port."""
    start, direction = np.array(port), np.array(axis)
    wing = start + 5.9 * direction
    size = np.where(direction != 0.0, 1.4, 0.08)
    size[0] = 10.6
    return [
        rod(start - 0.2 * direction, start + 0.5 * direction, 0.6),
        sphere(start + 1.6 * direction, 1.25),
        turned(start, direction, [(2.4, 0.95), (4.5, 1.1), (7.2, 1.36)]),
        box(wing, size),
    ]
