"""A chaser that sees, maps and flies by what it saw, with errors at their bounds; and one whose law only pushes in."""

import math
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from truths.boxes import HALF
from truths.depth_views import Box, axes_towards, cube_centres, view_of
from truths.growing_maps import Cubes

from keepout.audit.audit import Contact, audit
from keepout.fields.map_field import MapField
from keepout.flight.segment import begin, fly_segment, joined
from keepout.geometry.target import Target
from keepout.guard.safety_layer import mode
from keepout.guard.status import GuardStatus
from keepout.mapping import KnownFreeMap, Pinhole, SensorBounds, ViewStatus
from keepout.mission import environment
from keepout.mission.by_map import DeclaredBall, guard_by_map, law_by_map, led_on, require_start, setup_by_map
from keepout.mission.scenario import Scenario

pytestmark = pytest.mark.long

BALL = DeclaredBall((0.0, 0.0, 0.0), 3.0)
BODY = (Box(tuple(-HALF), tuple(HALF)),)
SENSOR = SensorBounds()
START = np.array([0.0, 6.0, 0.0])
ENTRIES = {
    "target": {"source": "box"},
    "guard": {"position_error": 0.05, "velocity_error": 0.002},
    "faults": {"position_noise": 0.05, "velocity_noise": 0.002},
    "start": {"position": START.tolist()},
    "safety": {"margin": 0.05},
}


class Flown:
    """A flight by a map: each leg takes the field of now, a law for it, and flies some steps."""

    def __init__(self, scenario, field):
        self.scenario, self.guard = scenario, guard_by_map(scenario, field, BALL)
        self.setup, self.state, self.logs = None, None, []

    @property
    def position(self):
        return START if self.state is None else np.asarray(self.state.motion.position)

    def fly(self, field, goal, steps):
        law = law_by_map(self.scenario, field, goal, self.position, ball=BALL, guard=self.guard)
        if self.setup is None:
            self.setup = setup_by_map(self.scenario, field, BALL, law, self.guard)
            initial = self.setup.motion.initial_state(START, np.zeros(3))
            require_start(self.scenario, BALL, initial, self.guard)
            self.state = begin(self.setup, initial, jax.random.key(0))
        self.setup = led_on(self.setup, field, law)
        self.state, log = fly_segment(self.setup, self.state, steps)
        self.logs.append(log)

    def judged(self):
        """The whole log, what the guard did in each step, its flags, and the audit on the exact mesh."""
        log = joined([*self.logs, fly_segment(self.setup, self.state, 1)[1]])
        done = np.asarray(mode(log.guard_status))
        flags = int(np.bitwise_or.reduce(np.asarray(log.guard_status) - done))
        record = SimpleNamespace(**{name: np.asarray(rows) for name, rows in vars(log).items() if rows is not None})
        verdict = audit(
            record,
            Target.load("box"),
            chaser_radius=self.scenario.chaser.radius,
            bounds=environment.flight_bounds(self.scenario),
            force_limit=self.scenario.chaser.force_limit,
            speed_limit=2.0 * self.scenario.chaser.speed_limit,
        )
        return log, done, flags, verdict


def field_of(known):
    return MapField.of(known.squares, known.origin, known.spacing)


def test_a_chaser_sees_its_way_to_a_goal_within_the_ball_and_never_touches():
    camera, generator = Pinhole(160, 120, math.radians(60.0)), np.random.default_rng(0)
    known = KnownFreeMap.begin(BALL.centre, BALL.radius, bounds=SENSOR, name="box")
    flown = Flown(Scenario.parse(ENTRIES), field_of(known))

    def look(at):
        move = generator.normal(size=3)
        view = view_of(
            BODY,
            camera,
            SENSOR,
            flown.position,
            axes_towards(np.asarray(at) - flown.position),
            range_error=SENSOR.range_error,
            move=SENSOR.position_error * move / np.linalg.norm(move),
            turn=SENSOR.attitude_error,
            about=generator.normal(size=3),
        )
        assert known.see(view).status is ViewStatus.SEEN

    legs = [(3.5, 3.5, 2.6), (0.0, 0.0, 5.0), (0.0, 0.0, 2.1)]
    for goal in legs:
        for _ in range(12):
            for at in (-1.5, 0.0, 1.5):
                look((at, 0.0, 0.0))
            flown.fly(field_of(known), goal, 20)
            if np.linalg.norm(flown.position - goal) < 0.2:
                break
    assert np.linalg.norm(flown.position - legs[-1]) < 0.2
    _, done, flags, verdict = flown.judged()
    assert not (done == GuardStatus.ESCAPING).any()
    assert flags == 0
    assert done.astype(bool).mean() < 0.02
    assert verdict.contact is Contact.NO
    assert verdict.minimum_clearance > 0.3
    # What it flew by is what no sensor within its promises can say of the box.
    assert not (known.free & BODY[0].meets_cubes(cube_centres(known), known.spacing)).any()


def test_a_law_that_pushes_into_the_unknown_is_held_through_every_update():
    scenario = Scenario.parse(ENTRIES | {"faults": ENTRIES["faults"] | {"law": "through"}})
    cubes = Cubes(BALL.centre, BALL.radius)
    flown = Flown(scenario, cubes.field())
    held = []
    for face in (9.0, 2.2, 1.7, 1.7):
        field = cubes.field(cubes.solid & (cubes.centres[..., 1] < face))
        flown.fly(field, (0.0, -6.0, 0.0), 150)
        held.append(float(flown.position[1]))
    log, done, flags, verdict = flown.judged()
    # Each update lets it in by as much as opened, and no further.
    assert held[0] > 3.5
    assert held[1] < held[0] - 0.5
    assert held[2] < held[1] - 0.3
    assert held[3] == pytest.approx(held[2], abs=0.1)
    assert (done != GuardStatus.CLEAR).mean() > 0.3
    assert not (done == GuardStatus.ESCAPING).any()
    assert flags & ~8 == 0  # the law's own estimate of the disturbance is as broken as the law
    assert float(np.min(log.field_value)) > flown.guard.threshold
    assert verdict.contact is Contact.NO
