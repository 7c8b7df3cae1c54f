"""Random approaches to a target, seen by several sensors at once, each into a map of its own; and what came out wrong.

All sensors take the same images from the same places; they differ in how errors are drawn, which promise is broken, and
which width of parts is promised to return. All approaches to a target go into one map.
"""

import dataclasses
import math
import time
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from closed_targets import FILES, MESHES, closed_target
from explore_counts import bad_cubes, gaps, meeting, over_statements, seen_surface, under_statements

from keepout.apps.led.camera import axes_towards
from keepout.apps.led.first_hit import FirstHit
from keepout.apps.unknown.depth_sensor import DepthCamera, ErrorDraw, take
from keepout.apps.unknown.known_free import KnownFreeMap, ViewStatus
from keepout.apps.unknown.map_field import MapField
from keepout.apps.unknown.view import SensorBounds
from keepout.core.geometry.builtin import BUILTINS
from keepout.core.geometry.level_set import surface_points, towards_level
from keepout.core.geometry.target import Target

ROOM = 0.5
"""Metres by which the declared ball is larger than the target."""
VIEWS = 15
"""Of an approach."""
OUTSIDE = 3.0
"""Metres from the ball to where an approach begins: the window of a cube nearer than half a metre fits no image."""
WAITS = 10
"""Further views at most, from where the chaser stays because what is ahead is not known to be free."""
GRAZING_ANGLE = 1.48
"""Of incidence, rad, beyond which returns are lost, where any are: a scenario's default."""
_CLEAR = 1.2
"""Metres that an approach keeps from the surface."""
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Sensor:
    """How a map's images come about: errors drawn, promise broken, promised width (m), rays, and what is lost.

    Where ranges are wrong beyond the promise they are so many `times` as wrong as promised.
    """

    errors: str = "adversarial"
    broken: str | None = None
    width: float = 0.03
    rays_across: int = 5
    dropout: float = 0.0
    grazing_angle: float = 0.5 * math.pi
    times: float = 2.0

    @property
    def told(self):
        """What rows say of it."""
        named = {"width_m": self.width, "rays_across": self.rays_across, "times": self.times, "dropout": self.dropout}
        return {"errors": self.errors, "broken": self.broken, **named, "grazing_angle": self.grazing_angle}


SOUND = Sensor()
BROKEN = (
    *(Sensor("adversarial", broken) for broken in ("range", "pose", "mixed", "late")),
    Sensor("adversarial", "losses", dropout=0.01, grazing_angle=GRAZING_ANGLE),
    *(Sensor("adversarial", broken, width=0.02) for broken in (None, "range", "pose")),
    *(Sensor("adversarial", "range", times=times) for times in (3.0, 4.0)),
)
"""The promised width is room to spare before walls, of more than a range error beyond its bound by once the bound."""
ACCURATE = (
    Sensor("random"),
    Sensor("random", width=0.05, rays_across=3),
    Sensor("random", grazing_angle=GRAZING_ANGLE),
    Sensor("random", dropout=0.001),
    Sensor("random", dropout=0.01),
)


def load(name, mesh):
    """Give a target "closed", or "as it is" in its file."""
    if mesh == "closed":
        return closed_target(name)
    return Target.load(name) if name in BUILTINS else Target.load(MESHES / FILES[name], units="m")


class OnceCast(FirstHit):
    """Casts the rays of an image once for all sensors that ask for them in a row."""

    def __init__(self, vertices, faces):
        super().__init__(vertices, faces)
        self._last = {}

    def cast(self, origins, directions, greatest=np.inf):
        """Give ranges and faces as `FirstHit` does, from memory where the rays are those of the last call as many."""
        last = self._last.get(len(directions))
        if last is None or not (np.array_equal(last[0], origins) and np.array_equal(last[1], directions)):
            last = origins.copy(), directions, super().cast(origins, directions, greatest)
            self._last[len(directions)] = last
        return last[2]


def enclosing(target):
    """Give centre and radius of a ball round a target, m, ROOM larger than it is."""
    lower, upper = target.vertices.min(axis=0), target.vertices.max(axis=0)
    centre = 0.5 * (lower + upper)
    return centre, float(np.linalg.norm(target.vertices - centre, axis=1).max()) + ROOM


def approach(target, centre, radius, generator, views=VIEWS):
    """Draw an approach: places (views, 3) from outside the ball to 2 to 3 m from the surface, and what is looked at.

    Straight, or bent aside by up to a fifth of its length; it keeps `_CLEAR` from the surface.
    """
    while True:
        foot = surface_points(target.distance, 1, generator, by_area=0.5)
        away = generator.normal(size=(1, 3))
        end, arrived, _ = towards_level(target.distance, foot + 0.5 * away, generator.uniform(2.0, 3.0))
        if not arrived[0] or np.linalg.norm(end[0] - centre) > radius:
            continue
        end, foot = end[0], target.distance.closest(end)[1][0]
        outwards = _unit(_unit(end - foot) + 0.5 * generator.normal(size=3))
        along = outwards @ (end - centre)
        length = -along + np.sqrt(along**2 + (radius + OUTSIDE) ** 2 - (end - centre) @ (end - centre))
        start = end + length * outwards
        aside = np.cross(outwards, generator.normal(size=3))
        bend = 0.2 * length * generator.uniform() * (generator.random() < 0.5) * _unit(aside)
        share = np.linspace(0.0, 1.0, 200)[:, None]
        path = (1.0 - share) * start + share * end + 4.0 * share * (1.0 - share) * bend
        if target.distance.distance(path).min() < _CLEAR:
            continue
        at = path[np.linspace(0, 199, views).round().astype(int)]
        return at, foot + generator.uniform(-0.5, 0.5, (views, 3))


class Approaching(NamedTuple):
    """How many approaches, of so many views each, into maps of a spacing (m); the seed draws approaches and errors."""

    approaches: int
    views: int
    spacing: float
    seed: int


def run(name, mesh, sensors, how: Approaching, *, points, say=lambda text: None):
    """Fly the approaches past all sensors, and count; yields a row for each sensor.

    Args:
        name: of the target.
        mesh: "closed" or "as it is".
        sensors: `Sensor`s.
        how: they are flown.
        points: at which the field of each map is checked, a number for each sensor.
        say: told how it goes on.

    """
    approaches, views, spacing, seed = how
    began = time.perf_counter()
    target = load(name, mesh)
    centre, radius = enclosing(target)
    first_hit = OnceCast(target.vertices, target.faces)
    worlds = [_World(sensor, centre, radius, spacing, name, seed) for sensor in sensors]
    met = meeting(target, worlds[0].known)
    # The sound sensor says where the chaser may be, so that all see the same, whichever are asked for.
    pilot = next((world for world in worlds if world.sensor == SOUND), None)
    pilot, unasked = pilot or _World(SOUND, centre, radius, spacing, name, seed), pilot is None
    generator = np.random.default_rng((seed, 0))
    poses, arrived = [], 0
    for number in range(approaches):
        places, looked_at = approach(target, centre, radius, generator, views)
        before, reached = None, 0
        for _ in range(views + WAITS):
            if reached == views:
                break
            # Where the next place is not known to be free, the chaser stays, and looks there.
            free = pilot.may_be_at(places[reached])
            place = places[reached if free else reached - 1]
            pose = place, axes_towards((looked_at if free else places)[reached] - place, _UP)
            reached += free
            for world in [*worlds, *([pilot] if unasked else [])]:
                world.look(first_hit, pose, before, 10.0 * len(poses))
            poses.append(pose)
            before = pose
        arrived += reached == views
        for world in worlds:
            world.bad_after.append(len(bad_cubes(world.known, met)))
        say(f"{name}, {mesh}: {number + 1} approaches, bad cubes {[world.bad_after[-1] for world in worlds]}")
    generator = np.random.default_rng((seed, 1))
    seen = seen_surface(target, first_hit, pilot.camera.camera, poses, generator)
    for number, world in enumerate(worlds):
        yield (
            {"target": name, "mesh": mesh, "seed": seed, "approaches": approaches, "views_each": views}
            | {"outside_m": OUTSIDE, "arrived": arrived}
            | world.counted(target, met, seen, points[number], generator)
            | {"contacts": None, "complete": None, "seconds": time.perf_counter() - began}
        )


@dataclass
class _World:
    """A sensor and its map."""

    sensor: Sensor
    centre: np.ndarray
    radius: float
    spacing: float
    name: str
    seed: int
    refused: int = 0
    opened: int = 0
    bad_after: list = field(default_factory=list)

    def __post_init__(self):
        bounds = SensorBounds(surely_returned_width=self.sensor.width, rays_across=self.sensor.rays_across)
        # An error draw that breaks the promise of ranges makes their errors twice as large as the sensor's own.
        true = dataclasses.replace(bounds, range_error=0.5 * self.sensor.times * bounds.range_error)
        self.camera = DepthCamera(
            bounds=true if self.sensor.broken == "range" else bounds,
            dropout=self.sensor.dropout,
            grazing_angle=self.sensor.grazing_angle,
        )
        self.draw = ErrorDraw(self.sensor.errors, self.sensor.broken)
        self.generator = np.random.default_rng((self.seed, 2))
        settings = {"spacing": self.spacing, "bounds": bounds, "name": self.name}
        self.known = KnownFreeMap.begin(self.centre, self.radius, **settings)

    def may_be_at(self, place):
        """Whether a sensor at a place is surely taken to be in known-free room."""
        reach = self.known.bounds.position_error
        return bool(self.known.is_free(place + reach * np.concatenate([np.eye(3), -np.eye(3)])).all())

    def look(self, first_hit, pose, before, now):
        told = (before or pose) if self.sensor.broken == "late" else None
        view = take(self.camera, first_hit, *pose, self.generator, self.draw, time=now, told=told)
        report = self.known.see(view)
        self.refused += report.status is not ViewStatus.SEEN
        self.opened += report.opened

    def counted(self, target, met, seen, points, generator):
        """Count what is wrong in the map, and measure how much of what is free it does not know."""
        known = self.known
        map_field = MapField.of(known.squares, known.origin, known.spacing)
        allowed = map_field.evaluation_error
        over = over_statements(map_field, target, known.spacing, points, generator, allowed=allowed)
        bad = bad_cubes(known, met)
        gap, under = gaps(known, seen), under_statements(map_field, target, seen)
        return {
            **self.sensor.told,
            "usable_range_m": known.bounds.usable_range(self.camera.camera),
            "spacing_m": known.spacing,
            "views": known.views,
            "refused_views": self.refused,
            "opened_cubes": self.opened,
            "surface_cubes": int(met.sum()),
            "bad_cubes": len(bad),
            "bad_after": self.bad_after,
            "bad_at": np.round(known.origin + known.spacing * (bad[:: max(1, len(bad) // 10)] + 0.5), 2).tolist(),
            "points": over.random + over.by_ascent,
            "points_by_ascent": over.by_ascent,
            "over_statements": over.found,
            "largest_excess_m": over.largest_excess,
            "seen_points": len(gap),
            "gap_median_m": _percentile(gap, 50),
            "gap_p95_m": _percentile(gap, 95),
            "under_points": len(under),
            "under_median_m": _percentile(under, 50),
            "under_p95_m": _percentile(under, 95),
        }


def _percentile(values, share):
    return float(np.percentile(values, share)) if len(values) else None


def _unit(vector):
    return vector / np.linalg.norm(vector)
