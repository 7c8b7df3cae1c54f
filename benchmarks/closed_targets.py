"""Closed versions of targets, for a sensor that is promised no sheet thinner than what surely returns; moved panels.

A mesh file's sheets have no thickness, so no sensor is promised to see them edge-on. Here each triangle of an open part
becomes a slab, each closed part a solid (with slabs where it is thin), and all are united (manifold3d, Lalish). The
built-in targets are closed already.

Run: python benchmarks/closed_targets.py [NAME ...] [--meshes DIRECTORY] [--cache DIRECTORY] [--json FILE]

Prints what was open, what is closed, and the share of the surface behind which less than the sensor's width is solid.
"""

import argparse
import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from manifold3d import Error, Manifold, Mesh64, OpType

from keepout.apps.led.first_hit import FirstHit
from keepout.core.geometry.builtin import BUILTINS, mesh
from keepout.core.geometry.level_set import surface_points
from keepout.core.geometry.mesh_files.contents import MeshContents
from keepout.core.geometry.target import Target, describe, part_labels, weld, zero_area
from keepout.core.kept import digest
from keepout.core.whole_file import write_whole

ROOT = Path(__file__).parents[1]
MESHES, CACHE = ROOT.parent / "shared" / "meshes", ROOT / "out" / "closed"
THICKNESS = 0.06
"""Metres: of a slab."""
WIDTH = 0.05
"""Metres: the sensor's `surely_returned_width`; what is thinner is reported."""
SIMPLER = 2e-3
"""Metres by which the united surface may be moved to have fewer triangles."""
SPECK = 1e-6
"""Cubic metres: loose bodies that are smaller are left out, as are voids inside, which nobody sees."""
FILES = {"ssl1300": "ssl1300.glb", "hubble": "hubble.glb", "tdrs": "tdrs.glb"}
NAMES = ("intelsat30", "tiangong", *FILES)
HINGES = {"intelsat30": (0, 3.0), "tiangong": (1, 12.0), "ssl1300": (0, 2.05), "hubble": (0, 2.5), "tdrs": (0, 1.8)}
"""Axis along which the panels reach out, and how far from the body frame's origin their hinges are, m."""
_SLAB = np.array([[0, 2, 1], [3, 4, 5], [0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4], [2, 0, 3], [2, 3, 5]])
_GROUP = 64
_POINTS = 50_000


@dataclass(frozen=True)
class MovedPanel:
    """A target as it is, as it was believed to be, and how the panel was moved."""

    true: Target
    expected: Target
    moved: float
    """Largest distance found from the true surface to the expected one, m."""
    axis: str
    """Of the hinge."""
    angle: float
    """rad."""


def closed_solid(name: str, *, meshes: Path = MESHES, cache: Path = CACHE) -> Manifold:
    """Give the closed version of a target, from the cache where it is there."""
    if name in BUILTINS:
        return BUILTINS[name].make()
    source = meshes / FILES[name]
    made_of = digest(np.fromfile(source, dtype=np.uint8), f"{THICKNESS} {SIMPLER} {SPECK}")
    kept = cache / f"{name}-{made_of[:12]}.npz"
    if kept.exists():
        with np.load(kept) as arrays:
            return Manifold(Mesh64(arrays["vertices"], arrays["faces"]))
    made = _closed(Target.load(source, units="m"))
    vertices, faces = _arrays(made)
    kept.parent.mkdir(parents=True, exist_ok=True)
    partial = kept.with_suffix(".partial.npz")
    np.savez_compressed(partial, vertices=vertices, faces=faces)
    partial.rename(kept)
    return made


def closed_target(name: str, *, meshes: Path = MESHES, cache: Path = CACHE) -> Target:
    """Give the closed version of a target as a target, in metres."""
    return _target(name, closed_solid(name, meshes=meshes, cache=cache))


def moved_panel(name: str, seed: int, *, meshes: Path = MESHES, cache: Path = CACHE) -> MovedPanel:
    """Turn a closed target's panels on one side about their hinge, so that they move by 1 to 2.5 m.

    Args:
        name: of the target.
        seed: draws the side, the hinge's axis, the sense, and how far the farthest corner moves.
        meshes: the folder of mesh files.
        cache: the folder of closed targets.

    """
    generator = np.random.default_rng((seed, NAMES.index(name)))
    along, reach = HINGES[name]
    side = int(generator.choice([-1, 1]))
    normal = np.zeros(3)
    normal[along] = side
    solid = closed_solid(name, meshes=meshes, cache=cache)
    panel, body = solid.split_by_plane(normal.tolist(), reach)
    corners = _arrays(panel)[0]
    hinge = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
    hinge[along] = side * reach
    about = int(generator.integers(3))
    axis = np.eye(3)[about]
    lever = float(np.linalg.norm(np.cross(corners - hinge, axis), axis=1).max())
    sense, wanted = int(generator.choice([-1, 1])), float(generator.uniform(1.1, 2.5))
    expected = _target(name, solid)
    angle = min(wanted / lever, 0.5 * np.pi)
    while True:
        degrees = np.zeros(3)
        degrees[about] = sense * np.degrees(angle)
        turned = panel.translate((-hinge).tolist()).rotate(degrees.tolist()).translate(hinge.tolist())
        true = _target(name, Manifold.batch_boolean([body, turned], OpType.Add))
        sample = surface_points(true.distance, _POINTS, np.random.default_rng(0), by_area=0.5)
        moved = float(expected.distance.distance(sample).max())
        if moved >= 1.0 or angle >= 0.5 * np.pi:
            return MovedPanel(true, expected, moved, "xyz"[about], sense * angle)
        angle = min(1.2 * angle, 0.5 * np.pi)


def _closed(target: Target) -> Manifold:
    """Unite slabs and solids; see the module."""
    welded = weld(target.vertices, target.faces)
    places = np.zeros((int(welded.max()) + 1, 3))
    places[welded] = target.vertices[target.faces]
    part = part_labels(welded)
    solids, sheets = [], []
    for label in range(int(part.max()) + 1):
        faces = welded[part == label]
        whole = _solid(places, faces)
        if whole is not None:
            solids.append(whole)
        # The mean thickness of a plate is twice its volume over its area.
        if whole is None or 2.0 * whole.volume() < THICKNESS * whole.surface_area():
            sheets.append(places[faces])
    triangles = np.concatenate(sheets)
    triangles = triangles[~zero_area(triangles)]
    near = np.lexsort(np.floor(triangles.mean(axis=1) / 0.5).T)
    slabs = [_slab(corners) for corners in triangles[near]]
    groups = [_united(slabs[first : first + _GROUP]) for first in range(0, len(slabs), _GROUP)]
    while len(groups) > 1:  # neighbours first: the pieces stay small
        groups = [_united(groups[first : first + 4]) for first in range(0, len(groups), 4)]
    return _filled(_united([*groups, *solids]))


def _filled(solid: Manifold) -> Manifold:
    """Fill the voids inside, and leave out specks."""
    return _united([body for body in solid.decompose() if body.volume() > SPECK])


def _solid(places: np.ndarray, faces: np.ndarray) -> Manifold | None:
    """Give a part as a solid, or None if it is not closed; its triangles may all face inwards."""
    used, index = np.unique(faces, return_inverse=True)
    index = index.reshape(-1, 3)
    start, end = index.ravel(), np.roll(index, -1, axis=1).ravel()
    # Every side must be met from the other one: manifold3d may crash where one is not.
    if not np.array_equal(np.sort(start * len(used) + end), np.sort(end * len(used) + start)):
        return None
    for corners in (index, index[:, ::-1]):
        made = Manifold(Mesh64(places[used], np.ascontiguousarray(corners, dtype=np.uint64)))
        if made.status() == Error.NoError and made.volume() > 0.0:
            return made
    return None


def _slab(corners: np.ndarray) -> Manifold:
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    aside = 0.5 * THICKNESS * normal / np.linalg.norm(normal)
    return Manifold(Mesh64(np.concatenate([corners - aside, corners + aside]), _SLAB.astype(np.uint64)))


def _united(pieces: list[Manifold]) -> Manifold:
    return Manifold.batch_boolean(pieces, OpType.Add).simplify(SIMPLER)


def _arrays(solid: Manifold) -> tuple[np.ndarray, np.ndarray]:
    return mesh(solid)


def _target(name: str, solid: Manifold) -> Target:
    vertices, faces = _arrays(solid)
    return Target(name, vertices, faces, describe(MeshContents(vertices, faces)))


def thin_share(target: Target, seed: int = 0) -> tuple[float, float]:
    """Measure how much of the surface has less than WIDTH of solid behind it, and the thickness of its 1 %, m."""
    generator = np.random.default_rng(seed)
    points = surface_points(target.distance, _POINTS, generator)
    face = target.distance.closest(points)[2]
    a, b, c = np.moveaxis(target.vertices[target.faces[face]], 1, 0)
    inwards = np.cross(c - a, b - a)
    length = np.linalg.norm(inwards, axis=1)
    inwards, points = inwards[length > 0.0] / length[length > 0.0, None], points[length > 0.0]
    behind = FirstHit(target.vertices, target.faces).ranges(points + 1e-5 * inwards, inwards) + 1e-5
    return float((behind < WIDTH * (1.0 - 1e-3)).mean()), float(np.percentile(behind, 1))


def row(name: str, meshes: Path, cache: Path) -> dict:
    """Say of one target what was open, and what its closed version is."""
    before = Target.load(name) if name in BUILTINS else Target.load(meshes / FILES[name], units="m")
    start = time.perf_counter()
    after = closed_target(name, meshes=meshes, cache=cache)
    seconds = time.perf_counter() - start
    thin, least = thin_share(after)
    moved = moved_panel(name, 0, meshes=meshes, cache=cache)
    return {
        "target": name,
        "before": _counts(before),
        "after": _counts(after),
        "thin_share": thin,
        "thickness_1_percent_m": least,
        "moved_panel": {"moved_m": moved.moved, "axis": moved.axis, "angle": moved.angle, **_counts(moved.true)},
        "seconds": seconds,
    }


def _counts(target: Target) -> dict:
    report = asdict(target.report)
    kept = ("triangles", "parts", "open_edges", "non_manifold_edges", "degenerate_faces")
    return {key: report[key] for key in kept} | {"watertight": target.report.watertight}


def main() -> None:
    """Close the targets named on the command line, or all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("targets", nargs="*", default=list(NAMES), help=f"of {', '.join(NAMES)}")
    parser.add_argument("--meshes", type=Path, default=MESHES, help="folder of the mesh files")
    parser.add_argument("--cache", type=Path, default=CACHE, help="folder of the closed ones")
    parser.add_argument("--json", type=Path, help="write the rows here")
    arguments = parser.parse_args()
    rows = []
    for name in arguments.targets:
        rows.append(row(name, arguments.meshes, arguments.cache))
        print(json.dumps(rows[-1]), flush=True)
        if arguments.json:
            write_whole(arguments.json, json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
