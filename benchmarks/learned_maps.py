"""Fields learned from a map, beside those learned from the mesh: room, error, reach, seconds, certificates.

Run: python benchmarks/learned_maps.py [TARGET ...] [--views N] [--spacing H] [--profile NAME] [--wing-span M]
     [--folder DIRECTORY] [--json FILE]

The map is made of views with random errors from 4 to 8 m before what is unknown; where from, and where to, is chosen
greedily with the true mesh known, since this is not about the choice of views (`keepout explore`). Then each field is
fitted and certified for a chaser of RADIUS: to the mesh, and to the skin of the map, which is what `keepout fit
MAP.keepmap --certify` does. All is measured on the true mesh; the map's own skin, without a network, is a third row.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np
import scipy.ndimage
from kept_rows import on_one_line

from keepout.apps.led.camera import axes_towards
from keepout.apps.led.first_hit import FirstHit
from keepout.apps.unknown.depth_sensor import DepthCamera, ErrorDraw, take
from keepout.apps.unknown.known_free import KnownFreeMap
from keepout.apps.unknown.map_file import load, save
from keepout.apps.unknown.skin import skin
from keepout.core.fields import load_shipped, shipped_names
from keepout.core.fields.field import values
from keepout.core.fields.model import FieldModel
from keepout.core.geometry.level_set import level_points
from keepout.core.geometry.offset_solid import OffsetSolid
from keepout.core.geometry.target import Target
from keepout.core.learning.training import fit
from keepout.core.proof.certificate import certify
from keepout.core.whole_file import write_whole

RADIUS, MARGIN = 0.5, 0.1
"""Metres: of the chaser, and the operator's margin that a goal needs beyond it."""
CAMERA = DepthCamera()
POINTS, GOALS, CELL = 200_000, 2_000, 0.25
EXPLAINED = 0.6
"""Metres: unknown room farther than this from the mesh is looked for first."""


def build_map(target: Target, *, views: int, spacing: float = 0.1, seed: int = 0) -> KnownFreeMap:
    """Take views all round a target at random errors.

    Args:
        target: the true mesh.
        views: how many; fewer where nothing is left to see.
        spacing: edge of the map's cubes, m.
        seed: of places and errors.

    """
    generator, first_hit = np.random.default_rng(seed), FirstHit(target.vertices, target.faces)
    centre = 0.5 * (target.distance.lower + target.distance.upper)
    radius = float(np.linalg.norm(target.vertices - centre, axis=1).max()) + 0.2
    known = KnownFreeMap.begin(
        centre, radius, spacing=spacing, cap=12 * spacing, bounds=CAMERA.bounds, name=target.name
    )
    for number in range(views):
        unknown = np.argwhere(~known.free)
        unknown = known.origin + spacing * (unknown[generator.integers(len(unknown), size=12_000)] + 0.5)
        far = unknown[target.distance.distance(unknown) > EXPLAINED]
        # Every third view looks at what is close to the surface.
        wanted = unknown if number % 3 == 2 or len(far) < 5 else far
        position, axes = _best_view(known, target, wanted, generator)
        known.see(take(CAMERA, first_hit, position, axes, generator, ErrorDraw(), time=float(number)))
        on_one_line(number / views, f"map: view {number}, {(~known.free).sum() * spacing**3:.0f} m³ not free")
    return known


def _best_view(
    known: KnownFreeMap, target: Target, wanted: np.ndarray, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Of places from which the sensor may look, the one with most of the wanted points well inside its image."""
    camera = CAMERA.camera
    half = 0.85 * np.array([camera.width, camera.height]) / (2.0 * camera.focal)
    best, answer = -1, None
    while answer is None:
        looked_at = wanted[generator.integers(len(wanted), size=60)]
        aside = generator.normal(size=looked_at.shape)
        aside *= generator.uniform(4.0, 8.0, (len(aside), 1)) / np.linalg.norm(aside, axis=1, keepdims=True)
        places = looked_at + aside
        allowed = known.is_free(places) & (target.distance.distance(places) > 2.0)
        for place, at in zip(places[allowed], looked_at[allowed]):
            axes = axes_towards(at - place, np.array([0.0, 0.0, 1.0]))
            seen = (wanted - place) @ axes
            slope = np.abs(seen[:, :2]) / np.maximum(seen[:, 2:], 1e-6)
            score = int(((slope < half).all(axis=1) & (seen[:, 2] > 0.0) & (seen[:, 2] < 9.5)).sum())
            if score > best:
                best, answer = score, (place, axes)
    return answer


class Skin:
    """The map's own distance, without a network: what a field learned from it can reach at best."""

    def __init__(self, solid: OffsetSolid):
        self.solid = solid

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Signed distance to the obstacle, m."""
        return self.solid.signed_distance(points)


def measure(value, level: float, solid: OffsetSolid, returns: np.ndarray, seed: int = 0) -> dict:
    """Measure {value ≤ level} and value itself against the true mesh.

    Args:
        value: (n, 3) points to (n,) m.
        level: at or below which it keeps the chaser's centre out, m.
        solid: the mesh's offset solid.
        returns: (n, 3) the map's point cloud, m.
        seed: of the points.

    """
    generator, distance = np.random.default_rng(seed), solid.distance
    lower, upper = distance.lower - RADIUS - 1.5, distance.upper + RADIUS + 1.5
    box = generator.uniform(lower, upper, (POINTS, 3))
    volume = float(np.prod(upper - lower))
    one_metre = level_points(distance, 1.0, 20_000, generator, uniform=True)
    one_metre = one_metre[solid.is_exterior(one_metre)]  # not inside the bus
    error = value(one_metre) - 1.0
    goals = level_points(distance, RADIUS + 0.6, 2 * GOALS, generator, uniform=True)
    goals = goals[solid.is_exterior(goals)][:GOALS]
    return {
        "inside_m3": volume * float((value(box) <= level).mean()),
        "contact_of_mesh_m3": volume * float(_touches(solid, box).mean()),
        "p95_at_1_m": float(np.percentile(np.abs(error), 95)),
        "median_under_statement_at_1_m": float(np.median(-error)),
        "largest_over_statement_at_1_m": float(error.max()),
        "goals_reached_share": _reached(value, level + MARGIN, goals, lower, upper),
        "p95_at_returns_m": float(np.percentile(np.abs(value(returns)), 95)),
    }


def _touches(solid: OffsetSolid, points: np.ndarray) -> np.ndarray:
    return (solid.distance.distance(points) <= RADIUS) | (solid.signed_distance(points) <= 0.0)


def _reached(value, level: float, goals: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> float:
    """Share of goals in {value > level} whose cell is joined to the box's border by cells whose middles are in it."""
    shape = np.ceil((upper - lower) / CELL).astype(int)
    middles = lower + CELL * (np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1) + 0.5)
    room = np.concatenate([value(part.reshape(-1, 3)) > level for part in middles]).reshape(shape)
    joined = scipy.ndimage.label(np.pad(room, 1, constant_values=True))[0]
    joined = (joined == joined[0, 0, 0])[1:-1, 1:-1, 1:-1]
    at = np.clip(((goals - lower) / CELL).astype(int), 0, shape - 1)
    near = np.zeros(len(goals), dtype=bool)
    for step in np.ndindex(3, 3, 3):  # the goal itself need not be the middle of a cell
        near |= joined[tuple(np.clip(at + np.array(step) - 1, 0, shape - 1).T)]
    return float((near & (value(goals) > level)).mean())


def learned(target: Target, path: Path, profile: str) -> tuple[FieldModel, dict]:
    """Fit and certify a field of a target, or take the shipped one, or one from its file; and say what it took."""
    if profile == "default" and path.name.removesuffix("-default.keepout") in shipped_names():
        model = load_shipped(target.name, target=target)
    elif path.exists():
        model = FieldModel.load(path, target=target)
    else:
        processor = time.process_time()
        model = fit(target, profile=profile, chaser_radius=RADIUS, progress=on_one_line)
        model = certify(model, target, chaser_radius=RADIUS, progress=on_one_line)
        model = model.with_training(processor_seconds=time.process_time() - processor)
        model.save(path)
    certificate = model.certificate(RADIUS)
    return model, {
        "error_bound_m": certificate.error_bound,
        "sampled_maximum_m": certificate.sampled_maximum,
        "fit_s": model.training["seconds"],
        "certify_s": certificate.seconds,
        "processor_s": model.training.get("processor_seconds"),
        "profile": model.training["profile"],
    }


def rows(name: str, arguments: argparse.Namespace) -> list[dict]:
    """Measure one target: the field of its mesh, the field of its map, and the map itself."""
    parameters = {"wing_span": arguments.wing_span} if arguments.wing_span else None
    label = f"{name}-{arguments.wing_span:g}" if parameters else Path(name).stem
    mesh = Target.load(name, parameters=parameters, units="m" if Path(name).suffix else None)
    at = arguments.folder / f"{label}-{arguments.views}-{arguments.spacing:g}.keepmap"
    if not at.exists():
        save(build_map(mesh, views=arguments.views, spacing=arguments.spacing), at)
    known = load(at)
    seen = Target.load(at)
    returns = known.returns[:: max(len(known.returns) // 50_000, 1)].astype(np.float64)
    solid, outer = OffsetSolid.build(mesh.distance), OffsetSolid.build(seen.distance)
    found = []
    for source, target, path in (("mesh", mesh, label), ("map", seen, at.stem)):
        path = arguments.folder / f"{path}-{arguments.profile}.keepout"
        model, papers = learned(target, path, arguments.profile)
        level = RADIUS + model.certificate(RADIUS).error_bound
        measured = measure(lambda points, f=model.field: values(f, points), level, solid, returns)
        found.append({"target": label, "field": f"learned from the {source}", **measured, **papers})
    found.append({"target": label, "field": "none: the map's skin", **measure(Skin(outer), RADIUS, solid, returns)})
    for entry in found:
        entry |= {
            "views": known.views,
            "spacing_m": known.spacing,
            "skin_triangles": len(skin(known)[1]),
            "not_free_m3": float((~known.free).sum() * known.spacing**3),
        }
    return found


def main() -> None:
    """Measure the targets named on the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("targets", nargs="*", default=["intelsat30"], help="built-in names or mesh files in metres")
    parser.add_argument("--views", type=int, default=400)
    parser.add_argument("--spacing", type=float, default=0.1, help="edge of the map's cubes, m")
    parser.add_argument("--profile", default="default", help="of the fits")
    parser.add_argument("--wing-span", type=float, help="of a built-in target, m")
    parser.add_argument("--folder", type=Path, default=Path("out/learned-maps"), help="of maps and fields")
    parser.add_argument("--json", type=Path, help="write the rows here")
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    measured = []
    for name in arguments.targets:
        for entry in rows(name, arguments):
            measured.append(entry)
            print("\r" + json.dumps(entry), flush=True)
            if arguments.json:
                write_whole(arguments.json, json.dumps(measured, indent=1) + "\n")


if __name__ == "__main__":
    main()
