"""Flights to goals near a target whose panel is not where the mission believes: by what was seen free, and ordinarily.

The ordinary pilot flies by the truncated-distance map, to which what it has not seen is free. It has the same chaser,
sensor, law and guard, and plans anew with every image; it looks where it flies.
"""

import dataclasses
import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import scipy.ndimage
from closed_targets import MovedPanel, moved_panel
from explore_approaches import Sensor, enclosing
from explore_counts import bad_cubes, meeting
from kept_rows import timed
from truncated_distance import TruncatedDistanceMap

from keepout.apps.led.camera import Boresight, axes_towards
from keepout.apps.led.first_hit import FirstHit
from keepout.apps.unknown import equipment
from keepout.apps.unknown.by_map import ByMap
from keepout.apps.unknown.depth_sensor import ErrorDraw, take
from keepout.apps.unknown.explore import explore
from keepout.apps.unknown.map_field import MapField
from keepout.core.audit.audit import Contact
from keepout.core.errors import ControlError
from keepout.core.flight.loop import begin, fly_segment, joined
from keepout.core.geometry.level_set import surface_points, towards_level
from keepout.core.mission.flight import recorded
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings

GOAL_AWAY, WAY_CLEAR = 1.5, 1.3
"""Metres from the true surface: of the goal, and of a way that leads to it from outside."""
OUTSIDE = 1.5
"""Metres that flights begin outside the declared ball."""
_GRID = 0.3
"""Metres between the nodes on which a way to the goal is looked for."""
_MOVED = 0.3
"""Metres from where it was expected beyond which a point of the surface counts as moved."""
_MOVING = 0.02
"""Speed, m/s, above which the ordinary pilot looks along its velocity."""
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Flight:
    """A target with a moved panel, and a mission to a goal near it."""

    panel: MovedPanel
    scenario: Scenario
    near_moved: bool
    """Whether the goal is near what moved."""


_ROUND = 2.0
"""Metres to whose multiples the radius of the declared ball is rounded up."""


def flight(name, seed, *, spacing, duration):
    """Draw a flight: every second goal lies near the moved panel."""
    panel = moved_panel(name, seed)
    target = panel.true
    generator = np.random.default_rng((seed, 3))
    both = np.concatenate([target.vertices, panel.expected.vertices])
    centre, radius = enclosing(target)
    radius = max(radius, float(np.linalg.norm(both - centre, axis=1).max()))
    radius = _ROUND * math.ceil(radius / _ROUND)  # maps of one size fly by one compiled program
    outside = _connected(target, centre, radius)
    near_moved = seed % 2 == 0
    while True:
        feet = surface_points(target.distance, 2000, generator, by_area=0.5)
        if near_moved:
            feet = feet[panel.expected.distance.distance(feet) > _MOVED]
        goals, arrived, _ = towards_level(target.distance, feet + 0.5 * generator.normal(size=feet.shape), GOAL_AWAY)
        goals = goals[arrived & outside(goals) & (np.linalg.norm(goals - centre, axis=1) < radius)]
        if len(goals):
            break
    way = generator.normal(size=3)
    start = centre + (radius + OUTSIDE) * way / np.linalg.norm(way)
    tree = {
        "name": f"{name}-moved-panel-{seed}",
        "seed": seed,
        "duration": duration,
        "start": {"position": start.tolist()},
        "goal": {"position": goals[0].tolist()},
        "map": {"centre": centre.tolist(), "radius": radius, "spacing": spacing},
    }
    return Flight(panel, Scenario.parse(tree), near_moved)


def _connected(target, centre, radius):
    """Give a function that says of points whether a way with WAY_CLEAR from the surface leads to them from outside."""
    half = math.ceil((radius + WAY_CLEAR + 1.0) / _GRID)
    axis = _GRID * np.arange(-half, half + 1)
    nodes = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3) + centre
    lower, upper = target.vertices.min(axis=0) - WAY_CLEAR, target.vertices.max(axis=0) + WAY_CLEAR
    near = ((nodes > lower) & (nodes < upper)).all(axis=1)
    clear = np.ones(len(nodes), bool)
    clear[near] = target.distance.distance(nodes[near]) > WAY_CLEAR
    labels = scipy.ndimage.label(clear.reshape((len(axis),) * 3))[0]

    def outside(points):
        index = np.round((points - centre) / _GRID).astype(int) + half
        return labels[tuple(index.T)] == labels[0, 0, 0]

    return outside


def by_known_free(flown: Flight):
    """Explore with the map of what was seen free; gives figures."""
    flight = explore(flown.scenario, target=flown.panel.true, expected=flown.panel.expected)
    found = flight.summary()
    kept = ("outcome", "why", "contact", "contact_verdict", "minimum_clearance_m", "seen_share", "views", "duration_s")
    kept += ("delta_v_mps", "guard_interventions", "guard_flags", "start_certified", "assumptions_broken")
    said = {key: found[key] for key in (*kept, "refused_views", "departures_largest_m")}
    return {"bad_cubes": len(bad_cubes(flight.map, meeting(flown.panel.true, flight.map))), **said}


def by_truncated_distance(flown: Flight):
    """Fly straight on by a map to which the unseen is free, planning anew with every image; gives figures."""
    scenario, target = flown.scenario, flown.panel.true
    camera, ball = equipment.depth_camera(scenario), equipment.declared_ball(scenario)
    known = TruncatedDistanceMap(equipment.map_of(scenario, camera))
    goal = np.asarray(scenario.goal.position)

    def field():
        return MapField.of(known.squares(), known.origin, known.spacing)

    leading = ByMap.of(scenario, ball, field())
    start = np.asarray(scenario.start.position)
    setup = leading.setup(leading.law(start, start))
    state = begin(setup, leading.initial, jax.random.key(scenario.seed))
    first_hit, generator = FirstHit(target.vertices, target.faces), np.random.default_rng(scenario.seed)
    boresight = Boresight.at_rest(
        goal - start,
        greatest_rate=scenario.depth_sensor.turn_rate,
        greatest_acceleration=scenario.depth_sensor.turn_acceleration,
    )
    ticks = round(scenario.depth_sensor.period / scenario.control.period)
    draw, logs, resting, no_way = ErrorDraw(scenario.depth_sensor.errors), [], 0, 0
    while len(logs) * ticks < scenario.steps and resting < 10:
        position, velocity = np.asarray(state.motion.position), np.asarray(state.motion.velocity)
        axes = axes_towards(boresight.direction, _UP)
        known.see(take(camera, first_hit, camera.sensor_position(position, axes), axes, generator, draw))
        # Anew: `ByMap.by` refuses fields that fall, as those of this map do.
        leading = ByMap.of(scenario, ball, field())
        law = setup.controller
        try:
            law = leading.law(goal, position)
        except ControlError:
            no_way += 1  # the law made before goes on, watched by the guard on the map as it is now
        setup = dataclasses.replace(leading.led_on(setup, law), goal=jnp.asarray(goal))
        state, log = fly_segment(setup, state, ticks)
        logs.append(log)
        ahead = velocity if np.linalg.norm(velocity) > _MOVING else goal - position
        for _ in range(ticks):
            boresight = boresight.step(ahead, scenario.control.period)
        away = np.linalg.norm(np.asarray(log.position) - goal, axis=1) >= scenario.goal.tolerance
        resting = 0 if away[-1] else resting + ticks
    _, last = fly_segment(setup, state, 1)
    log = joined([*logs, last])
    standing = leading.start_certified, ()
    flight = recorded(scenario, target, setup, log, Surroundings(scenario).flight_bounds, standing)
    return {
        "bad_cubes": None,
        "outcome": "reached goal" if resting >= 10 else "out of time",
        "contact": flight.audit.contact is not Contact.NO,
        "contact_verdict": str(flight.audit.contact),
        "minimum_clearance_m": flight.audit.minimum_clearance,
        "views": len(logs),
        "views_without_way": no_way,
        "duration_s": float(flight.record.time[-1]),
        "delta_v_mps": float(flight.outcome.delta_v),
    }


PILOTS = {"flights": by_known_free, "ordinary": by_truncated_distance}


def row(part, flown: Flight, name):
    """Fly, and give a row."""
    found, seconds = timed(PILOTS[part], flown)
    entry = flown.scenario.depth_sensor
    sensor = Sensor(
        entry.errors, None, entry.surely_returned_width, entry.rays_across, entry.dropout, entry.grazing_angle
    )
    return {
        "part": part,
        "target": name,
        "mesh": "closed, a panel moved",
        "seed": flown.scenario.seed,
        "approaches": 1,
        "views_each": None,
        **sensor.told,
        "spacing_m": flown.scenario.map.spacing,
        "over_statements": None,
        "moved_m": flown.panel.moved,
        "goal_near_moved": flown.near_moved,
        "contacts": int(found["contact"]),
        "complete": found["outcome"] == "reached goal",
        **found,
        "seconds": seconds,
    }
