"""Two small meshes as spacecraft models really come: open sheets, parts that cut each other, faces turned round.

Both are made here from nothing but a few formulas, so they are the same everywhere, and what is wrong with them is
known in numbers.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from keepout.core.geometry.target import Target
from truths.gltf_files import GltfFile
from truths.real_meshes import RealMesh, present


@dataclass(frozen=True)
class MessyMesh:
    """A mesh file and what is known of it by construction; metres."""

    path: Path
    sealed: np.ndarray
    """Points inside its closed bodies."""
    open: np.ndarray
    """Points that a chaser of 0.3 m radius can get to: in dishes, between panels and bus, below sheets."""
    closed_volume: float
    """What its closed bodies enclose together, cubic metres; the station's is a lower bound good to a hundredth."""


def box(lower, upper) -> np.ndarray:
    """Twelve triangles, (12, 3, 3), facing outwards."""
    corner = np.array([[(i >> axis) & 1 for axis in range(3)] for i in range(8)], dtype=np.float64)
    corner = np.asarray(lower, dtype=np.float64) + corner * (np.asarray(upper, dtype=np.float64) - lower)
    quads = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    return corner[[index for a, b, c, d in quads for index in (a, b, c, a, c, d)]].reshape(-1, 3, 3)


def grid(point: Callable[[np.ndarray, np.ndarray], np.ndarray], rows: int, columns: int) -> np.ndarray:
    """Triangles of a surface over the unit square, open at all its edges."""
    u, v = np.meshgrid(np.linspace(0.0, 1.0, rows + 1), np.linspace(0.0, 1.0, columns + 1), indexing="ij")
    p = point(u, v)
    a, b, c, d = p[:-1, :-1], p[1:, :-1], p[1:, 1:], p[:-1, 1:]
    return np.concatenate([np.stack([a, b, c], axis=2), np.stack([a, c, d], axis=2)]).reshape(-1, 3, 3)


def sheet(corner, along, across, rows: int, columns: int) -> np.ndarray:
    """A flat panel without thickness."""
    corner, along, across = (np.asarray(vector, dtype=np.float64) for vector in (corner, along, across))
    return grid(lambda u, v: corner + u[..., None] * along + v[..., None] * across, rows, columns)


def dish(centre, radius: float, depth: float, rings: int, sectors: int) -> np.ndarray:
    """A paraboloid open towards +z, without thickness, with a small hole at its tip."""

    def point(u, v):
        r, angle = radius * (0.02 + 0.98 * u), 2.0 * np.pi * v
        return np.stack([r * np.cos(angle), r * np.sin(angle), depth * (r / radius) ** 2], axis=-1) + np.asarray(centre)

    return grid(point, rings, sectors)


def tube(start, end, radius: float, sides: int, *, caps: bool) -> np.ndarray:
    """A rod of flat sides; without caps its ends are open."""
    start, end = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    axis = (end - start) / np.linalg.norm(end - start)
    first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    first /= np.linalg.norm(first)
    second = np.cross(axis, first)

    def point(u, v):
        angle = 2.0 * np.pi * (np.round(v * sides) % sides) / sides
        ring = radius * (np.cos(angle)[..., None] * first + np.sin(angle)[..., None] * second)
        return start + u[..., None] * (end - start) + ring

    side = grid(point, 1, sides)
    if not caps:
        return side
    ring = point(np.zeros(sides), np.arange(sides) / sides)
    near = np.stack([np.broadcast_to(start, ring.shape), np.roll(ring, -1, axis=0), ring], axis=1)
    far = near[:, ::-1] + (end - start)
    return np.concatenate([side, near, far])


def turned_round(triangles: np.ndarray, rng: np.random.Generator, share: float) -> np.ndarray:
    """Let a share of the triangles face the other way."""
    out = triangles.copy()
    wrong = rng.random(len(out)) < share
    out[wrong] = out[wrong][:, ::-1]
    return out


def messy_satellite(folder: Path) -> MessyMesh:
    """A communications satellite of 22 m, written as OBJ: every triangle has vertices of its own.

    A bus that two equipment boxes cut through, wings of open sheets whose neighbours have other divisions (T-junctions)
    and whose back sides lie 1 mm behind, dishes, yokes open at their ends, loose parts, slivers, duplicate triangles,
    triangles without area, and a stray part far away.
    """
    rng = np.random.default_rng(30)
    bus = box((-1.1, -1.2, -2.0), (1.1, 1.2, 2.0))
    parts = [bus, box((-1.4, -0.4, -1.0), (1.4, 0.5, 0.7)), box((-0.5, -1.5, 0.9), (0.6, 1.5, 2.3))]
    for side in (-1.0, 1.0):
        parts += [
            tube((side * 1.0, 0.0, 0.0), (side * 2.7, 0.7, 0.0), 0.05, 5, caps=False),
            tube((side * 1.0, 0.0, 0.0), (side * 2.7, -0.7, 0.0), 0.05, 5, caps=False),
        ]
        for panel in range(4):
            # Neighbours meet along an edge that one divides into three and the other into five.
            rows = (3, 5)[panel % 2]
            corner = (side * (2.6 + 2.1 * panel), -1.0, 0.0)
            parts.append(sheet(corner, (side * 2.1, 0.0, 0.0), (0.0, 2.0, 0.0), 4, rows))
            if panel < 2:
                parts.append(sheet(np.add(corner, (0.0, 0.0, -0.001)), (side * 2.1, 0.0, 0.0), (0.0, 2.0, 0.0), 3, 4))
        parts.append(dish((0.0, side * 3.2, -0.5), 1.3, 0.4, 5, 16))
        parts.append(tube((0.0, side * 1.0, -0.4), (0.0, side * 3.2, -0.48), 0.04, 3, caps=True))
    loose = [
        box(centre - 0.04, centre + 0.04) for centre in rng.uniform((-1.0, -1.0, 2.5), (1.0, 1.0, 2.9), size=(6, 3))
    ]
    slivers = np.array([[(x, -1.9, 0.0), (x, -1.9, 0.9), (x + 1e-4, -1.9, 0.45)] for x in np.linspace(-0.5, 0.5, 5)])
    without_area = np.array([[(0.0, -1.2, z), (0.0, -1.7, z), (0.0, -1.45, z)] for z in (-1.5, -1.0, -0.5)])
    body = turned_round(np.concatenate([*parts, *loose, slivers]), rng, 0.3)
    again = body[rng.choice(len(body), size=17, replace=False)][:, [1, 2, 0]]
    stray = box((60.0, 0.0, 0.0), (60.3, 0.3, 0.3))
    triangles = np.concatenate([body, without_area, again, stray])
    path = folder / "messy_satellite.obj"
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in triangles.reshape(-1, 3).tolist()]
    lines += [f"f {i + 1} {i + 2} {i + 3}" for i in range(0, 3 * len(triangles), 3)]
    path.write_text("\n".join([*lines, ""]))
    return MessyMesh(
        path,
        sealed=np.array([(0.0, 0.0, 0.0), (1.0, 1.1, -1.9), (1.25, 0.0, 0.0), (0.0, 1.35, 1.6), (0.0, 0.0, 2.15)]),
        open=np.array(
            [(0.0, 3.2, 0.2), (0.0, -3.2, 0.1), (2.0, 0.0, 0.6), (5.0, 0.0, 0.4), (5.0, 0.0, -0.4), (0, 0, 3.5)]
        ),
        closed_volume=2.2 * 2.4 * 4.0 + 0.6 * 0.9 * 1.7 + 1.1 * (3.0 * 1.4 - 2.4 * 1.1),
    )


def messy_station(folder: Path) -> MessyMesh:
    """A station segment of 16 m, written as binary glTF: parts in nodes, the truss as instances of one bay.

    Modules with a second hull inside, a module end that cuts into its neighbour, a truss of thin open bars, a dish,
    wings and a radiator as sheets that lie in the file twice, once facing each way.
    """
    rng = np.random.default_rng(109)
    along, across = np.array([12.0, 0.0, 0.0]), np.array([0.0, 6.0, 0.0])
    origin, gap, side = np.array([-6.0, 0.0, 0.0]), np.array([0.3, 0.0, 0.0]), np.array([1.0, 0.0, 0.0])
    modules = np.concatenate(
        [
            tube(origin, origin + along, 1.6, 14, caps=True),
            tube(origin + gap, origin + along - gap, 1.3, 9, caps=True),
            tube(side, side + across, 1.2, 12, caps=True),
            tube((1.0, 1.9, 0.0), (1.0, 5.7, 0.0), 0.9, 8, caps=True),
        ]
    )
    corners = np.array([(0.0, -0.5, -0.5), (0.0, 0.5, -0.5), (0.0, 0.5, 0.5), (0.0, -0.5, 0.5)])
    bay, step = [], np.array([1.6, 0.0, 0.0])
    for corner, following in zip(corners, np.roll(corners, -1, axis=0)):
        bay.append(tube(corner, corner + step, 0.03, 3, caps=False))
        bay.append(tube(corner, following, 0.02, 3, caps=False))
        bay.append(tube(corner, following + step, 0.02, 3, caps=False))
    truss = np.concatenate(bay)
    wing = sheet((-1.0, -1.5, 0.0), (2.0, 0.0, 0.0), (0.0, -5.0, 0.0), 2, 7)
    radiator = sheet((4.0, 1.9, 0.3), (1.6, 0.0, 0.0), (0.0, 3.0, 1.0), 3, 3)
    sheets = np.concatenate([wing, wing[:, ::-1], radiator, radiator[:, ::-1]])
    bowl = dish((0.0, 0.0, 0.0), 0.9, 0.35, 6, 15)
    file = GltfFile()
    file.tree["meshes"] = []
    for triangles in (modules, truss, sheets, bowl):
        file.tree["meshes"].append({"primitives": []})
        mixed = turned_round(triangles, rng, 0.4).reshape(-1, 3)
        # Vertices as first met, shared where equal: unlike the satellite's.
        points, index = np.unique(mixed.astype(np.float32), axis=0, return_inverse=True)
        position, indices = file.array(points, "f4"), file.array(index.reshape(-1), "u2")
        file.tree["meshes"][-1]["primitives"].append({"attributes": {"POSITION": position}, "indices": indices})
    places = np.array([(1.6 * number - 8.0, 0.0, 0.0) for number in range(10)])
    instances = {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": file.array(places, "f4")}}}
    file.tree["extensionsUsed"] = ["EXT_mesh_gpu_instancing"]
    file.tree["nodes"] = [
        {"children": [1, 2, 3, 4]},
        {"mesh": 0},
        {"mesh": 1, "translation": [0.0, 0.0, 2.6], "extensions": instances},
        {"mesh": 2, "translation": [-1.0, 0.0, 0.0]},
        {"mesh": 3, "translation": [-4.0, 0.0, 3.4]},
    ]
    area = 0.5 * 14 * np.sin(2.0 * np.pi / 14) * 1.6**2
    side_area = 0.5 * 12 * np.sin(2.0 * np.pi / 12) * 1.2**2
    return MessyMesh(
        file.write(folder / "messy_station.glb"),
        sealed=np.array([(0.0, 0.0, 0.0), (-5.85, 0.0, 0.0), (1.0, 1.75, 0.0), (1.0, 4.0, 0.0), (1.0, 5.9, 0.0)]),
        open=np.array([(-4.0, 0.0, 4.0), (-2.0, -4.0, 0.4), (-2.0, -4.0, -0.4), (3.2, 3.0, 0.0), (0.0, 0.0, -2.2)]),
        closed_volume=float(12.0 * area + 4.4 * side_area),
    )


MESSY: dict[str, Callable[[Path], MessyMesh]] = {"messy_satellite": messy_satellite, "messy_station": messy_station}


def _loads(made: Callable[[Path], MessyMesh] | RealMesh) -> Callable[[Path], Target]:
    if isinstance(made, RealMesh):
        return lambda folder: Target.load(made.path, scale=made.scale)
    return lambda folder: Target.load(made(folder).path)


MESSY_AND_REAL = [
    *(pytest.param(_loads(made), id=name) for name, made in MESSY.items()),
    *(pytest.param(_loads(mesh), id=mesh.name, marks=pytest.mark.slow) for mesh in present()),
]
"""Functions of a folder that give the target of each messy mesh, and of the real ones that are there."""
