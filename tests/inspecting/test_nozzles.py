"""Plumes of a layout's thrusters: where body axes would say the opposite, and which fired, against what was flown."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linprog
from truths.invented_flight import Invented

from keepout.control.policy import PolicyLaw
from keepout.flight.loop import fly
from keepout.flight.record import FlightRecord
from keepout.inspecting.nozzles import Nozzles, _on_times
from keepout.inspecting.plume import Protected, plume_violations, sparing
from keepout.mission.build import flight_setup
from keepout.mission.environment import faults, relative_motion
from keepout.mission.scenario import Scenario
from keepout.mission.thrusters import thrusters

CORNERS = [
    {"position": [0.0, 0.0, 0.0], "direction": list(d), "force": 0.2} for d in itertools.product((1, -1), repeat=3)
]
"""Eight thrusters that push towards the corners of a cube: 54.7° off each axis."""
AWAY = np.array([8.0, 0.0, 0.0])


def scenario(own=CORNERS, **entries):
    chosen = {"layout": "own", "own": own, "least_on_time": 0.0} if own else {}
    return Scenario.parse({"thrusters": chosen, "disturbance": {"kind": "none"}, **entries})


def asked(centre, own=CORNERS, radius=0.3, **inspect):
    part = {"centre": list(centre), "radius": radius}
    return scenario(own, inspect={"no_thrust_towards": [part], "plume_half_angle": 0.3, **inspect})


def pushing(case, force):
    """Judge one step at `AWAY` in which a force was commanded and given."""
    columns = {
        "position": np.tile(AWAY, (2, 1)),
        "force": np.tile(force, (2, 1)),
        "guarded_force": np.tile(force, (2, 1)),
    }
    record = Invented(case, {}, time=np.arange(2.0), **columns).record
    return bool(plume_violations(record, Protected.of(case), case)[0])


ALONG, ASIDE = np.zeros(3), AWAY - 5.0 * np.array([1.0, 1.0, 1.0])
"""Parts behind a push along +x, and behind the thruster that pushes along (1, 1, 1)."""


@pytest.mark.parametrize(
    ("part", "force", "by_axes"), [(ALONG, (0.05, 0, 0), True), (ASIDE, (0.05, 0.05, 0.05), False)]
)
def test_a_layout_blows_where_its_thrusters_point_and_not_along_the_axes(part, force, by_axes):
    assert pushing(asked(part, own=None), force) is by_axes
    assert pushing(asked(part), force) is not by_axes
    assert not pushing(asked(part), np.zeros(3))


def test_the_apex_is_where_the_thruster_is():
    """Those along x sit 3 m to the side: their plume passes a part that one from the centre hits."""
    moved = [
        {
            "position": [0.0, 3.0 if axis == 0 else 0.0, 0.0],
            "direction": (sign * np.eye(3)[axis]).tolist(),
            "force": 0.2,
        }
        for axis in range(3)
        for sign in (1, -1)
    ]
    force = np.array([0.05, 0.0, 0.0])
    for part, by_centre in ((ALONG, True), ([0.0, 3.0, 0.0], False)):
        assert pushing(asked(part, own=None), force) is by_centre
        assert pushing(asked(part, own=moved), force) is not by_centre


def least_propellant(force):
    """Which thrusters fire for a force, by linear program."""
    pushes = 0.2 * np.array([thruster["direction"] for thruster in CORNERS]).T / np.sqrt(3.0)
    return linprog(np.ones(8), A_eq=pushes, b_eq=force, bounds=(0.0, 1.0), method="highs")


@pytest.mark.parametrize("seed", range(6))
def test_what_a_sparing_law_asks_for_fires_no_thruster_that_is_barred(seed):
    generator = np.random.default_rng(seed)
    barred = generator.uniform(size=8) < 0.4
    force = generator.uniform(-0.06, 0.06, 3)
    nozzles = Nozzles.of(scenario())
    left = np.asarray(eqx.filter_jit(Nozzles.without)(nozzles, jnp.asarray(force), jnp.asarray(barred)))
    found = least_propellant(left)
    assert found.status == 0
    assert np.all(np.asarray(nozzles.gives(jnp.asarray(left)))[barred] < 1e-6)
    free = linprog(
        np.ones(8),
        A_eq=0.2 * np.array([thruster["direction"] for thruster in CORNERS]).T / np.sqrt(3.0),
        b_eq=left,
        bounds=[(0.0, 0.0 if bar else 1.0) for bar in barred],
        method="highs",
    )
    assert free.status == 0
    assert free.fun == pytest.approx(found.fun, abs=1e-6)
    none = nozzles.without(jnp.asarray(force), jnp.zeros(8, bool))
    assert np.allclose(none, force)


def test_a_law_keeps_what_no_barred_thruster_gives():
    case = asked(ASIDE)
    law = sparing(PolicyLaw(jnp.zeros(3), lambda off, velocity, time: jnp.array([0.05, 0.03, 0.03])), case)
    at = relative_motion(case).initial_state(AWAY, np.zeros(3))
    _, command = law.step(law.initial_state(at), at)
    assert 0.0 < float(np.linalg.norm(command.force)) < 0.06
    assert not pushing(case, np.asarray(command.force))
    assert pushing(case, np.array([0.05, 0.03, 0.03]))


def test_thrusters_that_fired_are_those_of_the_flight_with_its_delay_and_lost_commands():
    """Their pushes times their on-times are the mean forces that the flight recorded."""
    case = scenario(faults={"delay": 2, "dropped": 0.2}, guard={"enabled": False}, seed=5)
    law = PolicyLaw(jnp.zeros(3), lambda off, velocity, time: 0.04 * jnp.sin(jnp.array([0.3, 0.7, 1.1]) * time))
    log = fly(flight_setup(case, law), relative_motion(case).initial_state(AWAY, np.zeros(3)), 60, jax.random.key(5))
    record = FlightRecord.of_log(log, scenario=case.model_dump_json(), seed=5)
    on_time = np.asarray(
        _on_times(
            faults(case),
            thrusters(case),
            jnp.asarray(record.guarded_force),
            jnp.asarray(record.time),
            jax.random.key(5),
        )
    )
    pushes = 0.2 * np.array([thruster["direction"] for thruster in CORNERS]) / np.sqrt(3.0)
    assert np.allclose(on_time @ pushes / case.control.period, record.force, atol=1e-12)
    fired = Nozzles.of(case).fired(record, case)
    assert np.array_equal(fired, on_time[:-1] > 0.0)
    assert 0 < fired.sum() < fired.size
    assert not np.allclose(record.force, record.guarded_force)
