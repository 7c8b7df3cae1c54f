"""Flights of a scenario flown together: one program for all, and how they are judged."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from keepout.core.audit.audit import Contact
from keepout.core.control.guidance import Straight
from keepout.core.flight.batches import states_at
from keepout.core.mission.build import prepare
from keepout.core.mission.flight import AUDITED, fly_audited, judge
from keepout.core.mission.scenario import Scenario

GOALS = np.array([[0.0, -9.0, -4.0], [0.0, -9.0, 4.0], [3.0, -9.0, -4.0]])
STARTS = np.array([[0.0, -10.0, -4.0], [0.0, -10.0, 4.0], [2.0, -10.0, -4.0]])


@pytest.fixture(scope="module")
def mission():
    scenario = Scenario().replace(
        start={"position": tuple(STARTS[0])},
        goal={"position": tuple(GOALS[0])},
        guard={"enabled": False},
        duration=60.0,
    )
    return prepare(scenario, guidance=Straight())


def varied(setup):
    return setup.goal, setup.controller.velocity.guidance.goal


@pytest.fixture(scope="module")
def flown(mission):
    setup = eqx.tree_at(varied, mission.setup, (jnp.asarray(GOALS), jnp.asarray(GOALS)))
    initial = states_at(setup.motion, STARTS)
    logs = []
    outcome, audits = fly_audited(
        mission.scenario,
        mission.target,
        setup,
        initial,
        columns=("disturbance",),
        landed=lambda first, log: logs.append((first, log)),
        vary=varied,
        batch=2,
    )
    return outcome, audits, logs


@pytest.mark.long
def test_flights_with_goals_of_their_own_are_judged_in_their_order(mission, flown):
    outcome, audits, logs = flown
    # Two batches, the second filled up: what fills it up is neither judged nor handed on.
    assert [(first, log["disturbance"].shape) for first, log in logs] == [(0, (2, 61, 3)), (2, (1, 61, 3))]
    for k, audit in enumerate(audits):
        path = logs[k // 2][1]["position"][k % 2]
        np.testing.assert_array_equal(path[0], STARTS[k])
        sampled = mission.target.distance.distance(path).min() - mission.scenario.chaser.radius
        assert sampled - 0.01 < audit.minimum_clearance <= sampled
        assert outcome.final_error[k] == pytest.approx(np.linalg.norm(path[-1] - GOALS[k]), abs=1e-12)
    assert [audit.contact for audit in audits] == 3 * [Contact.NO]


@pytest.mark.long
def test_verdicts_are_by_the_scenarios_own_numbers(mission, flown):
    # The first flight is the mission's own.
    log = {name: flown[2][0][1][name][:1] for name in AUDITED}
    one = judge(mission.scenario, mission.target, log)[0]
    larger = mission.scenario.replace(chaser={"radius": 0.75, "speed_limit": 0.01})
    wide = judge(larger, mission.target, log)[0]
    assert one.consistent
    assert one.minimum_clearance - wide.minimum_clearance == pytest.approx(0.25, abs=2e-3)
    assert wide.speed_violations > one.speed_violations == 0
    # Without the disturbance that flew, no motion within the bounds joins the states.
    still = judge(mission.scenario.replace(disturbance={"kind": "none"}), mission.target, log)[0]
    assert still.contact is Contact.UNDECIDED
