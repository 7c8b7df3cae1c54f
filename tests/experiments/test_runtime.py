"""Computation time: the usual way is the same law, and what is missing is said."""

import dataclasses
import importlib.util
import warnings

import jax.numpy as jnp
import numpy as np
import pytest
from truths.invented_flight import Invented
from truths.results import check_picture

from keepout.control.velocity import VelocityPoint
from keepout.control.velocity_program.cone import ConeStatus
from keepout.experiments import runtime, step_times, usual_way
from keepout.experiments.step_times import Timed
from keepout.experiments.work import Work
from keepout.mission.build import prepare
from keepout.mission.scenario import Scenario
from keepout.report.runtime_view import draw_step_times


@pytest.fixture
def nothing_flown(monkeypatch):
    """Contenders that take 1, 2, … ms a step and stay where they start."""
    asked = []

    def timed(contenders):
        asked.extend(contenders)
        return [
            Timed(np.full(c.scenario.steps, 1e-3 * (k + 1)), np.zeros((c.scenario.steps + 1, 3)), 0)
            for k, c in enumerate(contenders)
        ]

    monkeypatch.setattr(runtime, "time_apart", timed)
    return asked


def test_a_missing_extra_is_a_row_that_names_it(tmp_path, monkeypatch, nothing_flown):
    found = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *rest: None if name == "torch" else found(name, *rest)
    )
    rows = [row for row, _ in runtime.step_rows(Work(tmp_path, quick=True), None)]
    usual = [row for row in rows if row["contender"].startswith("usual way")]
    assert len(usual) == 1
    assert usual[0]["note"].endswith("pip install 'keepout[bench]'")
    assert "torch" in usual[0]["note"]
    assert usual[0]["median_ms"] is None
    assert len(rows) == 3
    assert len(nothing_flown) == 2
    assert usual[0]["note"] in " ".join(runtime.found(rows, []))


def test_the_times_are_those_measured(tmp_path, monkeypatch, nothing_flown):
    monkeypatch.setattr(runtime, "missing_extra", lambda: None)
    rows = [row for row, _ in runtime.step_rows(Work(tmp_path), None)]
    assert [row["median_ms"] for row in rows] == [*(pytest.approx(k) for k in (1.0, 2.0, 3.0, 4.0)), None]
    assert rows[-1]["note"] == "no such field: give --fields with one of the paper's network"
    assert all(row["above_10_ms"] == 0 for row in rows[:-1])
    assert rows[0]["final_error_m"] == pytest.approx(np.linalg.norm(Scenario().goal.position))
    runtime.step_rows(Work(tmp_path), None)
    assert len(nothing_flown) == 4  # kept, not timed again


@pytest.mark.parametrize(("error", "drifts", "trapped"), [(0.01, 0.0, False), (5.0, 0.0, True), (5.0, 0.05, False)])
def test_trapped_is_at_rest_away_from_the_goal(error, drifts, trapped):
    scenario = Scenario().replace(
        control={"profile": "paper", "paper": {"gradient_error": 0.3}}, name="cone-shipped-0.3"
    )
    time = np.arange(401.0)
    position = np.asarray(scenario.goal.position) + error + drifts * time[:, None] * [1.0, 0.0, 0.0]
    summary = {"reached": error < 0.1, "time_to_reach_s": None, "final_error_m": error}
    summary |= {"minimum_clearance_m": 1.0, "contact_verdict": "no"}
    row = runtime._cone_row(Invented(scenario, summary, time=time, position=position, barrier=time))
    assert (row["trapped"], row["gradient_error"]) == (trapped, 0.3)
    said = runtime.found([], [row])[-1]
    assert ("trapped with 0.3" in said) == trapped
    assert ("arrives with e_∇h = 0.3" in said) == (error < 0.1)


def test_the_figure_shows_something(tmp_path):
    time, draw = np.arange(600.0), np.random.default_rng(0)
    times = {f"way {k}": (time, 0.1 * 10.0**k * draw.uniform(1.0, 2.0, 600)) for k in range(3)}
    draw_step_times(tmp_path / "times.png", times, limit=10.0)
    check_picture(tmp_path / "times.png")


@pytest.fixture(scope="module")
def printed():
    pytest.importorskip("torch", exc_type=ImportError)
    pytest.importorskip("cvxpy", exc_type=ImportError)
    control = {"profile": "paper", "paper": {"gradient_error": 0.2}}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return prepare(Scenario().replace(control=control, guard={"enabled": False}))


@pytest.mark.long
def test_the_usual_way_is_the_same_law(printed):
    usual, law = step_times.usual_way(printed), printed.setup.controller
    layer = dataclasses.replace(law.velocity, differentiate=False)
    draw = np.random.default_rng(0)
    compared = 0
    for position in draw.uniform([-6.0, -6.0, -6.0], [6.0, 6.0, 6.0], (12, 3)):
        velocity = draw.uniform(-0.1, 0.1, 3)
        point, _ = layer(jnp.asarray(position), jnp.asarray(velocity), jnp.zeros(3))
        if point.status != ConeStatus.SOLVED or float(point.barrier) < 0.05:
            continue
        barrier, normal, safe = usual.safe_velocity(position)
        assert barrier == pytest.approx(float(point.barrier), abs=2e-5)
        np.testing.assert_allclose(normal, point.normal, atol=2e-4)
        np.testing.assert_allclose(safe, point.velocity, atol=1e-4)
        drift = usual.drift(position, velocity)
        state = printed.setup.motion.initial_state(position, velocity)
        np.testing.assert_allclose(drift, printed.setup.motion.drift_acceleration(state), atol=1e-9)
        flat = VelocityPoint(
            point.barrier, point.normal, point.desired, point.velocity, jnp.zeros((3, 3)), point.status
        )
        ours = law.tracking(flat, jnp.asarray(position) - law.goal, jnp.asarray(velocity), jnp.asarray(drift), law.mass)
        theirs = usual._tracked(
            *(float(point.barrier), np.asarray(point.normal), np.asarray(point.velocity)),
            *(np.zeros(3), position, velocity, drift),
        )
        np.testing.assert_allclose(theirs, ours.control, rtol=1e-6, atol=1e-9)
        compared += 1
    assert compared >= 4
    assert usual.unsolved == 0


def test_only_the_papers_law_is_written_the_usual_way(printed):
    far = np.array([500.0, 0.0, 0.0])
    with pytest.raises(usual_way.ControlError, match="where the network was not learned"):
        step_times.usual_way(printed).safe_velocity(far)
