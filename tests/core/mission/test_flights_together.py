"""Flights of a scenario flown together: where they start, one program for all, how they are judged, what is kept."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from keepout.core.audit.audit import Contact
from keepout.core.control.guidance.plan import Straight
from keepout.core.errors import ScenarioError
from keepout.core.flight.batches import states_at
from keepout.core.geometry.target import Target
from keepout.core.mission import series
from keepout.core.mission.audited import AUDITED, fly_audited, judge
from keepout.core.mission.build import prepare
from keepout.core.mission.campaign import draw_starts, plan_campaign
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.series import SERIES, SeriesKeeper


@pytest.fixture(scope="module")
def shell(tmp_path_factory):
    """A hollow cube of 6 m: its inside has room for the chaser, and no way out."""
    path = tmp_path_factory.mktemp("mesh") / "shell.stl"
    trimesh.creation.box(extents=(6.0, 6.0, 6.0)).export(path)
    return Target.load(path, units="m")


def drawn(target, **campaign):
    return draw_starts(Scenario().replace(campaign=campaign), target).position


@pytest.mark.long
def test_starts_are_seeded_outside_and_roomy(shell):
    starts = drawn(shell, runs=50, lower=(-5.0, -5.0, -5.0), upper=(5.0, 5.0, 5.0))
    # Not in the hollow, and away from the walls.
    assert np.abs(starts).max(axis=1).min() > 3.0 + 0.8 / 3**0.5
    assert shell.distance.distance(starts).min() > 0.8
    with pytest.raises(ScenarioError, match="only 0 lie outside"):
        drawn(shell, runs=5, lower=(-2.0, -2.0, -2.0), upper=(2.0, 2.0, 2.0))


@pytest.mark.long
def test_starts_that_are_drawn_again_are_counted(shell):
    campaign = {"runs": 50, "lower": (-5.0, -5.0, 3.0), "upper": (5.0, 5.0, 5.0)}
    scenario = Scenario().replace(campaign=campaign)
    draws = np.random.default_rng(scenario.seed).uniform(campaign["lower"], campaign["upper"], (1000, 3))
    # Distance to the cube in closed form: every draw lies at or above its upper face.
    away = np.linalg.norm(np.maximum(np.abs(draws) - 3.0, 0.0), axis=1)
    fiftieth = np.flatnonzero(away > 0.8)[49]
    starts = draw_starts(scenario, shell)
    np.testing.assert_array_equal(starts.position, draws[: fiftieth + 1][away[: fiftieth + 1] > 0.8])
    assert starts.drawn_again == fiftieth + 1 - 50 > 0


def test_dispersions_are_refused_where_only_starts_vary(shell):
    scenario = Scenario().replace(campaign={"dispersions": {"chaser.mass": {"uniform": (9.0, 11.0)}}})
    with pytest.raises(ScenarioError, match=r"campaign\.dispersions: chaser\.mass; .*keepout campaign"):
        plan_campaign(scenario, target=shell)


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


END = (1.0, -2.0, 3.0)
ROWS = 10


def log(flights):
    draw, rows = np.random.default_rng(0), ROWS + 1
    vectors = {name: draw.normal(size=(flights, rows, 3)) for name in ("position", "velocity")}
    return vectors | {name: draw.normal(size=(flights, rows)) for name in ("barrier", "lyapunov")}


def keeper(**options):
    return SeriesKeeper(tuple(SERIES), **{"flights": 5, "steps": ROWS, "period": 0.5, "goal": END, **options})


def test_each_quantity_is_the_logs():
    whole, kept = log(5), keeper()
    assert set(kept.columns) == set(whole)
    kept.land(0, {name: array[:3] for name, array in whole.items()})
    kept.land(3, {name: array[3:] for name, array in whole.items()})
    values = kept.kept().values
    error = np.sqrt(((whole["position"] - END) ** 2).sum(axis=2))
    np.testing.assert_allclose(values["position_error"], error, rtol=1e-6)
    np.testing.assert_allclose(values["speed"], np.sqrt((whole["velocity"] ** 2).sum(axis=2)), rtol=1e-6)
    np.testing.assert_allclose(values["axis_speed"], abs(whole["velocity"]).max(axis=2), rtol=1e-6)
    for name in ("barrier", "lyapunov"):
        np.testing.assert_array_equal(values[name], whole[name].astype(np.float32))
    np.testing.assert_array_equal(kept.kept().time, 0.5 * np.arange(ROWS + 1))


def test_a_stride_keeps_the_end_and_flights_that_did_not_land_are_not_numbers():
    whole, keeping = log(2), keeper(stride=4)
    keeping.land(0, whole)
    kept = keeping.kept()
    np.testing.assert_array_equal(kept.time, [0.0, 2.0, 4.0, 5.0])
    np.testing.assert_array_equal(kept.values["barrier"][:2], whole["barrier"][:, [0, 4, 8, 10]].astype(np.float32))
    assert np.isnan(kept.values["speed"][2:]).all()


def test_many_flights_are_kept_at_a_stride(monkeypatch):
    monkeypatch.setattr(series, "MOST_NUMBERS", 5 * 11 * 5 // 2)
    kept = keeper().kept()
    assert sum(values.size for values in kept.values.values()) <= series.MOST_NUMBERS


def test_what_cannot_be_kept_is_refused():
    with pytest.raises(ScenarioError, match="series: 'thrust' is not known; valid: barrier"):
        SeriesKeeper(("thrust",), flights=1, steps=1, period=1.0, goal=END)
    with pytest.raises(ScenarioError, match="a stride of -1"):
        keeper(stride=-1)
