"""The examples of your own parts fly as they say: each judged by the closed form of what it brings."""

import importlib.util
import itertools
from pathlib import Path
from types import ModuleType

import jax.numpy as jnp
import numpy as np
import pytest
from truths.boxes import contact_with_box

import keepout
from keepout.core.errors import FieldError
from keepout.core.guard.field import guard_field
from keepout.core.proof.certificate import stated_error_bound

FOLDER = Path(__file__).parents[1] / "examples"
pytestmark = pytest.mark.long


def example(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def clear(flight: keepout.Flight) -> bool:
    """Whether no recorded position touches, by the mesh's distance alone, and the audit excludes it between them."""
    radius = flight.scenario.chaser.radius
    away = flight.target.distance.distance(flight.record.position)
    return bool((away > radius).all()) and str(flight.audit.contact) == "no"


@pytest.mark.slow  # tests/core/mission/test_own.py has parts of one's own
def test_a_disturbance():
    flight = example("own_disturbance").main(200.0)
    assert clear(flight)
    assert flight.start_certified is True
    swell = 0.012 * np.sin(np.pi * flight.record.time / 60.0) ** 2
    np.testing.assert_allclose(flight.record.disturbance, swell[:, None] * [0.0, 0.6, 0.8], atol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize("force_limit", [0.1, 100.0])
def test_the_papers_step_in_numpy_is_keepouts(force_limit):
    ours, plain = example("paper_step").compare(force_limit)
    np.testing.assert_allclose(plain, ours, rtol=0.0, atol=1e-9)
    assert len(ours) == 120
    assert np.ptp(ours, axis=0).min() > 0.1


@pytest.mark.slow
def test_a_pid_law_under_the_guard():
    flight = example("own_law").main(400.0)
    assert clear(flight)
    assert flight.start_certified is True
    assert flight.outcome.guard_interventions > 0
    # Its own words, from the positions that it was told: the integral is the sum of what it was shown.
    error = flight.record.estimated_position - np.asarray(flight.scenario.goal.position)
    error *= np.minimum(1.0, 4.0 / np.linalg.norm(error, axis=1, keepdims=True))
    wanted = -20.0 * (1.5e-3 * error + 1e-6 * np.cumsum(error, axis=0) + 0.09 * flight.record.estimated_velocity)
    np.testing.assert_allclose(flight.record.commanded_force, np.clip(wanted, -0.1, 0.1), atol=1e-12)


@pytest.mark.slow
def test_policies_under_the_guard():
    module = example("own_policy")
    flights = module.main(250.0)
    assert all(clear(flight) for flight in flights.values())
    assert sum(int(flight.outcome.guard_interventions) for flight in flights.values()) > 0
    record, network = flights["network"].record, module.Network()
    goal = np.asarray(flights["network"].scenario.goal.position)
    asked = [network(r - goal, v, t) for r, v, t in zip(record.position, record.velocity, record.time)]
    np.testing.assert_allclose(record.commanded_force, asked, atol=1e-12)


@pytest.mark.slow
def test_a_guidance():
    flight = example("own_guidance").main(600.0)
    assert clear(flight)
    assert flight.outcome.reached


@pytest.mark.slow
def test_a_field():
    flight = example("own_field").main(guard_field(keepout.Target.load("box"), 0.5), 500.0)
    assert clear(flight)
    assert flight.outcome.reached
    axes = np.sqrt(3.0) * np.array([2.0, 1.5, 1.0])
    own = axes.min() * (np.sqrt(((flight.record.position / axes) ** 2).sum(axis=1) + 1e-12) - 1.0)
    np.testing.assert_allclose(flight.record.field_value, own, atol=1e-9)


@pytest.mark.slow
def test_thrusters():
    flight = example("own_thrusters").main(200.0)
    assert clear(flight)
    assert flight.start_certified is False
    assert any(broken.startswith("thrusters: others") for broken in flight.assumptions_broken)
    record = flight.record
    given = np.clip(np.round(record.guarded_force / 0.004) * 0.004, -0.1, 0.1)
    np.testing.assert_allclose(record.force, given, atol=1e-12)


@pytest.mark.slow
def test_a_gain_tuned_by_the_flights_derivative():
    gains, costs = zip(*example("tune_gain").main())
    assert gains[0] == 1.0
    assert all(after <= before for before, after in itertools.pairwise(costs))
    assert costs[-1] < 0.97 * costs[0]
    # At rest: the derivative says that there is nothing left to gain.
    assert abs(np.log(gains[-1] / gains[-2])) < 0.02


@pytest.mark.slow
def test_laws_on_the_same_pairs():
    good = example("compare_laws").main(3)
    assert good["default"] == [True, True, True]
    assert len(good["paper"]) == len(good["own"]) == 3


def test_the_error_bound_of_a_stated_field_is_one():
    """Against points at distance R of the box by closed form."""
    field = keepout.stated_field(example("own_field").ellipsoid, 1.0, lower=[-8.0] * 3, upper=[8.0] * 3)
    radius, leaf = 0.5, 0.1
    bound = stated_error_bound(field, keepout.Target.load("box"), radius, leaf=leaf)
    points = contact_with_box(20_000, radius)
    worst = float(np.max(np.asarray(field.value(jnp.asarray(points))))) - radius
    assert worst <= bound <= worst + 2.0 * np.sqrt(3.0) * 0.5 * leaf + 0.02


def test_a_lipschitz_bound_that_is_broken_is_refused_and_a_sampled_one_is_named_so():
    room: dict = {"lower": [-2.0] * 3, "upper": [2.0] * 3}

    def steep(point):
        return 3.0 * point[0] + 4.0 * point[1]

    with pytest.raises(FieldError, match=r"bound of 4\.9 is stated, and the gradient .* is 5"):
        keepout.stated_field(steep, 4.9, **room)
    assert keepout.stated_field(steep, 5.0, **room).kind == "stated"
    sampled = keepout.sampled_field(steep, allowance=0.1, **room)
    assert (sampled.kind, sampled.lipschitz) == ("sampled", pytest.approx(5.5))
    with pytest.raises(FieldError, match="not a finite number"):
        keepout.sampled_field(lambda point: jnp.log(point[0]), **room)
    for wrong in (0.0, np.inf, np.nan):
        with pytest.raises(FieldError, match="positive and finite"):
            keepout.stated_field(steep, wrong, **room)


@pytest.mark.slow
def test_policies_learn_behind_the_guard_without_contact(tmp_path):
    curves = example("learn_a_policy").main(3, tmp_path / "curves.png", policies=16, episodes=4)
    assert (tmp_path / "curves.png").is_file()
    assert not curves[True][:, 1].any()
    assert curves[False][:, 1].any()
    assert curves[True][-1, 0] > curves[False][-1, 0]
