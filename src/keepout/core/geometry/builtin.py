"""Built-in targets, each made by parametric code: plain bodies, and spacecraft by documented public dimensions."""

import inspect
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import manifold3d
import numpy as np
from jaxtyping import Float, Int
from manifold3d import CrossSection, Manifold

from keepout.core.errors import MeshError

Vector = Sequence[float] | Float[np.ndarray, "3"]


def box(centre: Vector, size: Vector) -> Manifold:
    """Make an axis-aligned box, metres."""
    return Manifold.cube(triple(size), center=True).translate(triple(centre))


def rod(start: Vector, end: Vector, radius: float, end_radius: float | None = None, segments: int = 16) -> Manifold:
    """Make a cylinder, or a frustum where `end_radius` differs, between two points."""
    axis = np.asarray(end, dtype=float) - np.asarray(start, dtype=float)
    length = float(np.linalg.norm(axis))
    shape = Manifold.cylinder(length, radius, radius if end_radius is None else end_radius, segments)
    return _placed(shape, start, axis)


def turned(origin: Vector, axis: Vector, outline: Sequence[tuple[float, float]], segments: int = 32) -> Manifold:
    """Revolve (distance along the axis, radius) pairs, in rising order, about an axis through the origin given."""
    stations = [(0.0, outline[0][0]), *[(radius, along) for along, radius in outline], (0.0, outline[-1][0])]
    return _placed(Manifold.revolve(CrossSection([np.array(stations)]), segments), origin, axis)


def sphere(centre: Vector, radius: float, segments: int = 24) -> Manifold:
    """Make a faceted sphere whose corners lie on the radius."""
    return Manifold.sphere(radius, segments).translate(triple(centre))


def dish(vertex: Vector, boresight: Vector, diameter: float, focal_length: float, thickness: float) -> Manifold:
    """Make a paraboloid shell z = r²/(4 f) of constant thickness along its axis, opening towards `boresight`."""
    radii = np.linspace(0.0, 0.5 * diameter, 9)
    depth = radii**2 / (4.0 * focal_length)
    outline = np.concatenate([np.column_stack([radii, depth - thickness]), np.column_stack([radii, depth])[::-1]])
    return _placed(Manifold.revolve(CrossSection([outline.tolist()]), 32), vertex, boresight)


def unite(parts: Iterable[Manifold]) -> Manifold:
    """Unite all parts into one closed surface a body, with nothing inside.

    No part may be a union itself: manifold3d makes one apart only where somebody else holds it, be it a debugger, and
    the triangles are others then.
    """
    return Manifold.batch_boolean(list(parts), manifold3d.OpType.Add)


def mesh(solid: Manifold) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """Vertices in metres and outward triangles of a solid."""
    made = solid.to_mesh64()
    return np.array(made.vert_properties[:, :3], dtype=np.float64), np.array(made.tri_verts, dtype=np.int64)


def triple(vector: Vector) -> tuple[float, float, float]:
    """Give three numbers as a tuple of Python's."""
    x, y, z = (float(value) for value in vector)
    return x, y, z


def _placed(shape: Manifold, origin: Vector, axis: Vector) -> Manifold:
    """Turn a body's z axis to a direction of any length, and move its origin."""
    third = np.asarray(axis, dtype=float)
    third = third / np.linalg.norm(third)
    first = np.cross(np.eye(3)[int(np.argmin(np.abs(third)))], third)
    first /= np.linalg.norm(first)
    return shape.transform(np.column_stack([first, np.cross(third, first), third, np.asarray(origin, dtype=float)]))


_HALF_X, _HALF_Y = 1.10, 1.20
_AFT, _DECK = -2.85, 1.35
"""Of the bus of Intelsat 30, metres."""
_STACK = 4.6
"""Metres from the ISS's truss axis to the axis of its pressurised modules, towards nadir."""


def _plain_box(length: float = 4.0, width: float = 3.0, height: float = 2.0) -> Manifold:
    """Solid box about the origin, `length` along x, `width` along y, `height` along z, metres."""
    return box((0.0, 0.0, 0.0), (length, width, height))


def _plain_sphere(radius: float = 2.0) -> Manifold:
    """Sphere about the origin, metres, in 96 segments: its facets lie at most 0.06 % of the radius inside it."""
    return sphere((0.0, 0.0, 0.0), radius, 96)


def pocket(length: float = 6.0, width: float = 6.0, depth: float = 4.0, wall: float = 0.3) -> Manifold:
    """Box open towards +y: walls `wall` metres thick round an outer `length` (x) by `width` (z), `depth` along y.

    Straight guidance from +y to a goal behind the floor at -y flies into the pocket and stays there.
    """
    outer = box((0.0, 0.0, 0.0), (length, depth, width))
    return outer - box((0.0, wall, 0.0), (length - 2.0 * wall, depth, width - 2.0 * wall))


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
    wings = [part for side in (-1, 1) for part in _panel_wing(side, 0.5 * wing_span)]
    wings = [part.rotate((np.degrees(wing_angle), 0.0, 0.0)).translate((0.0, 0.0, hinge)) for part in wings]
    return unite([bus, *radiators, engine, *wings, *_tower(), *_reflectors()])


def _panel_wing(side: int, tip: float) -> list[Manifold]:
    """Yoke, four panels in line and one crosswise pair, about the x axis."""
    thickness = 0.06
    root = 3.0
    length = (tip - root) / 4.0
    parts = [
        rod((side * (_HALF_X - 0.1), 0.0, 0.0), (side * 1.7, 0.0, 0.0), 0.09),
        *(rod((side * 1.65, 0.0, 0.0), (side * (root + 0.05), y, 0.0), 0.06) for y in (0.9, -0.9)),
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
    return parts


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
    places = ((-0.95, 2.9, -0.95, 2.3), (1.0, 2.6, 0.30, 2.0), (-1.0, -2.6, 0.30, 2.0), (0.95, -2.9, -0.95, 2.3))
    for x, y, z, diameter in places:
        side = np.sign(y)
        vertex = np.array([x, y, z])
        boresight = np.array([0.0, -0.35 * side, 1.0])
        parts.append(dish(vertex, boresight, diameter, 1.6, 0.05))
        root = np.array([x * 0.75, side * (_HALF_Y - 0.05), z - 0.35])
        parts.append(rod(root, vertex - np.array([0.0, 0.05 * side, 0.01]), 0.06))
        parts.append(rod(root, vertex - np.array([0.0, 0.55 * side, 0.10]), 0.05))
    return parts


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
    wings = [_blanket_wing(x, side, 0.5 * wing_span) for x in (-48.4, -33.0, 33.0, 48.4) for side in (-1, 1)]
    parts = [*_truss(), *_radiators(), *_american_segment(), *_russian_segment()]
    return unite([*parts, *_turned_about_x(wings, wing_angle)])


def _turned_about_x(wings: list[list[Manifold]], angle: float) -> list[Manifold]:
    """Parts of wings, turned about x by an angle (rad), the last wing first: the order that shipped fields are of."""
    return [part.rotate((np.degrees(angle), 0.0, 0.0)) for wing in reversed(wings) for part in wing]


def _blanket_wing(x: float, side: int, tip: float) -> list[Manifold]:
    """Mast canister and mast, and a blanket on each side of the mast between two blanket boxes."""
    root = 3.2
    parts = [
        rod((x, 0.0, 0.0), (x, side * root, 0.0), 0.7),
        rod((x, side * root, 0.0), (x, side * tip, 0.0), 0.35, segments=8),
        box((x, side * (root + 0.2), 0.0), (12.0, 0.4, 0.35)),
        box((x, side * (tip - 0.15), 0.0), (12.0, 0.3, 0.25)),
    ]
    middle, length = 0.5 * side * (root + tip), tip - root
    return [*parts, *(box((x + sign * 3.35, middle, 0.0), (4.6, length - 0.2, 0.1)) for sign in (-1, 1))]


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
    return [*parts, rod((-1.0, -0.8, 0.0), (4.0, -4.2, -1.5), 0.18), rod((4.0, -4.2, -1.5), (10.5, -3.0, -0.5), 0.18)]


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
    parts, wings = [*_tianhe(), *_shenzhou(), *_tianzhou()], []
    for side in (-1, 1):
        parts += _laboratory(side, airlock=side < 0)
        wings += [_flexible_wing(side * 18.2, sign, 0.5 * wing_span) for sign in (-1, 1)]
    return unite([*parts, *_turned_about_x(wings, wing_angle)])


def _tianhe() -> list[Manifold]:
    """Hub, small and large cylinder, resource section, and two wings along x."""
    outline = [(1.0, 1.4), (6.6, 1.4), (7.6, 2.1), (13.6, 2.1), (13.7, 1.5), (15.1, 1.5)]
    parts = [
        sphere((0.0, 0.0, 0.0), 1.55, 32),
        turned((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), outline),
        *(rod((0.0, 0.0, side * 1.2), (0.0, 0.0, side * 2.1), 0.65) for side in (1, -1)),
    ]
    for side in (-1, 1):
        parts.append(rod((0.0, 5.2, 0.0), (side * 2.6, 5.2, 0.0), 0.15, segments=8))
        parts.append(box((side * (2.4 + 6.1), 5.2, 0.0), (12.2, 4.6, 0.08)))
    # The arm, folded along the large cylinder.
    return [*parts, rod((0.0, 8.0, -1.9), (0.0, 8.0, -2.5), 0.25), rod((0.0, 8.0, -2.5), (0.0, 13.0, -2.5), 0.16)]


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


def _flexible_wing(x: float, side: int, tip: float) -> list[Manifold]:
    """One flexible wing: a mast between two blankets, held by a root and a tip bar."""
    root = 1.6
    parts = [
        rod((x, 0.0, 0.0), (x, side * tip, 0.0), 0.2, segments=8),
        box((x, side * root, 0.0), (4.6, 0.35, 0.3)),
        box((x, side * (tip - 0.15), 0.0), (4.6, 0.3, 0.2)),
    ]
    middle, length = 0.5 * side * (root + tip), tip - root
    return [*parts, *(box((x + sign * 1.3, middle, 0.0), (1.9, length, 0.08)) for sign in (-1, 1))]


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


@dataclass(frozen=True)
class Parameter:
    """A shape parameter: lengths in metres, angles in radians."""

    default: float
    lower: float
    upper: float


@dataclass(frozen=True)
class Builtin:
    """A built-in target: what makes it, and the parameters it takes."""

    name: str
    make: Callable[..., Manifold]
    ranges: dict[str, tuple[float, float]]

    @property
    def summary(self) -> str:
        """The first line of the maker's docstring."""
        return (inspect.getdoc(self.make) or "").splitlines()[0]

    @property
    def parameters(self) -> dict[str, Parameter]:
        """Every parameter with its default and range."""
        defaults = inspect.signature(self.make).parameters
        return {name: Parameter(defaults[name].default, *limits) for name, limits in self.ranges.items()}

    def build(
        self, parameters: dict[str, float] | None = None
    ) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
        """Vertices in metres and outward triangles.

        Raises:
            MeshError: an unknown parameter, or a value outside its range.

        """
        given = parameters or {}
        for name, value in given.items():
            if name not in self.ranges:
                taken = ", ".join(self.ranges) or "none"
                raise MeshError(f"{self.name}: parameter {name!r} is unknown; it takes {taken}")
            lower, upper = self.ranges[name]
            if not lower <= value <= upper:
                raise MeshError(f"{self.name}: {name} = {value}; it must be from {lower} to {upper}")
        return mesh(self.make(**given))


_ANGLE = (-float(np.pi), float(np.pi))
BUILTINS: dict[str, Builtin] = {
    b.name: b
    for b in (
        Builtin("intelsat30", intelsat30, {"wing_span": (12.0, 60.0), "wing_angle": _ANGLE}),
        Builtin("iss", iss, {"wing_span": (20.0, 100.0), "wing_angle": _ANGLE}),
        Builtin("tiangong", tiangong, {"wing_span": (10.0, 100.0), "wing_angle": _ANGLE}),
        Builtin("box", _plain_box, {"length": (0.1, 400.0), "width": (0.1, 400.0), "height": (0.1, 400.0)}),
        Builtin("sphere", _plain_sphere, {"radius": (0.1, 200.0)}),
        Builtin(
            "pocket",
            pocket,
            {"length": (2.0, 100.0), "width": (2.0, 100.0), "depth": (1.0, 100.0), "wall": (0.05, 0.4)},
        ),
    )
}
