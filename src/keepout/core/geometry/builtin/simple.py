"""Plain bodies: a box, a sphere, and a pocket that traps naive guidance."""

from manifold3d import Manifold

from keepout.core.geometry.builtin import solids


def box(length: float = 4.0, width: float = 3.0, height: float = 2.0) -> Manifold:
    """Solid box about the origin, `length` along x, `width` along y, `height` along z, metres."""
    return solids.box((0.0, 0.0, 0.0), (length, width, height))


def sphere(radius: float = 2.0) -> Manifold:
    """Sphere about the origin, metres, in 96 segments: its facets lie at most 0.06 % of the radius inside it."""
    return solids.sphere((0.0, 0.0, 0.0), radius, 96)


def pocket(length: float = 6.0, width: float = 6.0, depth: float = 4.0, wall: float = 0.3) -> Manifold:
    """Box open towards +y: walls `wall` metres thick round an outer `length` (x) by `width` (z), `depth` along y.

    Straight guidance from +y to a goal behind the floor at -y flies into the pocket and stays there.
    """
    outer = solids.box((0.0, 0.0, 0.0), (length, depth, width))
    return outer - solids.box((0.0, wall, 0.0), (length - 2.0 * wall, depth, width - 2.0 * wall))
