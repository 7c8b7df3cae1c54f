"""An exploration that nobody flew: a camera carried round a box on a circle; what it sees is known in closed form."""

import math

import jax.numpy as jnp
import numpy as np

from keepout.apps.led.camera import Pinhole
from keepout.apps.unknown.exploration import Exploration, TakenView, departures
from keepout.apps.unknown.known_free import KnownFreeMap
from keepout.apps.unknown.skin import Stages
from keepout.apps.unknown.view import SensorBounds, View
from keepout.core.audit.audit import audit
from keepout.core.flight.loop import FlightOutcome
from keepout.core.flight.record import FlightRecord
from keepout.core.geometry.target import Target
from keepout.core.mission.flight import Flight
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings

CAMERA = Pinhole(80, 60, math.pi / 3.0)
BOUNDS = SensorBounds(surely_returned_width=0.1)
HALF = np.array([2.0, 1.5, 1.0])
"""Of the built-in box, m."""
CIRCLE, BALL, PERIOD, REFUSED = 6.0, 4.0, 20.0, 3
"""Radius of the chaser's circle and of the declared ball, m; between views, s; the view that jumped."""


def look_at(position, at):
    """Camera axes as columns: z towards a place, y as far down as may be."""
    z = (at - position) / np.linalg.norm(at - position)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def box_ranges(position, directions, half=HALF):
    """Where rays from a place first meet the box round the origin, m; inf where they pass it (slabs)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        near, far = (-half - position) / directions, (half - position) / directions
    enter, leave = np.fmin(near, far).max(axis=-1), np.fmax(near, far).min(axis=-1)
    return np.where((enter <= leave) & (leave > 0.0), enter, np.inf)


def box_view(position, time, *, at=(0.0, 0.0, 0.0), half=HALF):
    """The image of the box from a place, without errors."""
    axes = look_at(position, np.asarray(at))
    rays = CAMERA.directions(BOUNDS.rays_across) @ axes.T
    ranges = box_ranges(position, rays, half)
    across = BOUNDS.rays_across
    ranges = ranges.reshape(CAMERA.height, across, CAMERA.width, across).min(axis=(1, 3))
    ranges[(ranges > BOUNDS.greatest_range) & np.isfinite(ranges)] = np.inf
    return View(CAMERA, position, axes, ranges, time)


def circle(time, whole):
    """Where the chaser is: half a turn from x = -6 m over y = -6 m to x = 6 m, once in `whole` seconds."""
    angle = np.pi + np.pi * np.asarray(time, float) / whole
    return CIRCLE * np.stack([np.cos(angle), np.sin(angle), np.full_like(angle, 0.3)], axis=-1)


def made_up(*, views=8, spacing=0.2, outcome="no way known", expected=None, name="made-up", **scenario):
    """Give the exploration; the scenario's other tables are as given."""
    whole = PERIOD * views
    entries = {"target": {"source": "box"}, "goal": {"position": (6.0, 0.0, 1.8)}, "duration": whole} | scenario
    entries = {"map": {"radius": BALL, "spacing": spacing}, "depth_sensor": {"width": 80, "height": 60}} | entries
    told = Scenario().replace(name=name, **entries)
    target = Target.load("box")
    known = KnownFreeMap.begin(np.zeros(3), BALL, spacing=spacing, cap=1.2, bounds=BOUNDS, name="box")
    taken, stages, volume = [], Stages(known, 0.0), 0.0
    for number in range(views):
        time = PERIOD * number
        position = circle(time, whole)
        view = box_view(position, time)
        if number == REFUSED:
            taken.append(TakenView(time, position, view.axes[:, 2], "pose jump", 0, volume, "towards the goal"))
            continue
        report = known.see(view)
        volume += report.opened * spacing**3
        taken.append(TakenView(time, position, view.axes[:, 2], report.status.value, report.opened, volume, "goal"))
        stages.note(known, time, volume)
    record = made_up_record(told, target, whole)
    cells = np.argwhere(~known.free)
    centres = known.origin + (cells + 0.5) * spacing
    unknown = centres[(np.abs(centres) > 1.2).any(axis=1) & (centres[:, 0] > 1.5)]
    return Exploration(
        flight=made_up_flight(told, target, record),
        outcome=outcome,
        why="every view that can still be taken opens nothing towards the goal",
        seconds=1.0,
        expected=expected,
        map=known,
        views=tuple(taken),
        stages=stages.at_the_end(known, whole),
        seen_share=0.5,
        unknown=unknown,
        departures=None if expected is None else departures(known, expected, CAMERA),
        keep=0.8,
    )


def made_up_flight(scenario, target, record):
    """Give the flight of a record, audited, with a guard that did nothing."""
    verdict = audit(
        record,
        target,
        chaser_radius=scenario.chaser.radius,
        bounds=Surroundings(scenario).flight_bounds,
        force_limit=scenario.chaser.force_limit,
        speed_limit=1.0,
    )
    clearance = target.distance.distance(record.position) - scenario.chaser.radius
    return Flight(scenario, target, record, made_up_outcome(), verdict, clearance, start_certified=True, guard={})


def made_up_record(scenario, target, whole):
    time = np.arange(0.0, whole + 0.5)
    rows = len(time)
    position = circle(time, whole)
    velocity = np.gradient(position, time, axis=0)
    zeros = (
        *("angular_velocity", "estimated_velocity", "commanded_force", "guarded_force"),
        *("force", "disturbance", "disturbance_estimate", "desired_velocity"),
    )
    columns = {
        "position": position,
        "velocity": velocity,
        "estimated_position": position,
        "attitude": np.tile([1.0, 0.0, 0.0, 0.0], (rows, 1)),
        "safe_velocity": velocity,
        "barrier": np.full(rows, 1.0),
        **{name: np.zeros((rows, 3)) for name in zeros},
        **{name: np.zeros(rows) for name in ("backstepping_barrier", "lyapunov", "field_value")},
        **{name: np.zeros(rows, np.int32) for name in ("control_status", "guard_status")},
        "saturated": np.zeros(rows, bool),
    }
    header = {"scenario": scenario.model_dump_json(), "target_sha256": target.sha256}
    return FlightRecord(header, time, **columns)


def made_up_outcome():
    none = jnp.zeros(16, int)
    numbers = {name: jnp.asarray(0.0) for name in FlightOutcome.__annotations__} | {
        "reached": jnp.asarray(False),
        "finite": jnp.asarray(True),
        "guard_interventions": jnp.asarray(0),
        "guard_flags": jnp.asarray(0),
        "control_status_counts": none,
        "guard_status_counts": none,
        "propellant": None,
    }
    return FlightOutcome(**numbers)
