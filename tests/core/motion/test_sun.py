import jax.numpy as jnp
import numpy as np
import pytest

from keepout.core.errors import ScenarioError
from keepout.core.mission.bounds import sun_of
from keepout.core.mission.epoch import parse_instant
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings
from keepout.core.motion.orbit import SolarPressure, lit, sun_direction

EARTH = 6378137.0


def test_the_shadow_is_a_cylinder_with_an_edge():
    toward = jnp.array([1.0, 0.0, 0.0])
    for position, share in (
        ([7e6, 0.0, 0.0], 1.0),
        ([-7e6, 0.0, 0.0], 0.0),
        ([-7e6, EARTH, 0.0], 0.5),
        ([-7e6, 0.0, EARTH + 1.1e4], 1.0),
        ([-7e6, 0.0, EARTH - 1.1e4], 0.0),
    ):
        assert float(lit(jnp.array(position), toward)) == pytest.approx(share)


def test_the_push_points_away_from_the_sun_and_is_that_of_the_area():
    push = SolarPressure(0.02, 0.05, (0.6, 0.8, 0.0))
    at, rest = jnp.array([7e6, 0.0, 0.0]), jnp.zeros(3)
    np.testing.assert_allclose(push.of_target(at, rest), -4.56e-6 * 0.02 * np.array([0.6, 0.8, 0.0]), rtol=1e-12)
    np.testing.assert_allclose(push.of_chaser(at, rest), -4.56e-6 * 0.05 * np.array([0.6, 0.8, 0.0]), rtol=1e-12)


def test_a_scenario_carries_the_push_and_its_bound_and_an_empty_one_does_not():
    plain = Scenario()
    assert Surroundings(plain).motion.perturbations == ()
    pushed = plain.replace(sun={"chaser_area_to_mass": 0.05, "target_area_to_mass": 0.02})
    (push,) = Surroundings(pushed).motion.perturbations
    assert isinstance(push, SolarPressure)
    np.testing.assert_allclose(push.direction, sun_direction(parse_instant(plain.epoch)))
    more = Surroundings(pushed).flight_bounds.disturbance_force - Surroundings(plain).flight_bounds.disturbance_force
    assert more == pytest.approx(20.0 * 4.56e-6 * 0.03, rel=1e-6)


def test_a_direction_is_given_by_any_length_and_refused_where_it_is_none():
    assert sun_of(Scenario().replace(sun={"direction": (0.0, 3.0, 4.0)})) == pytest.approx((0.0, 0.6, 0.8))
    with pytest.raises(ScenarioError, match=r"sun: direction \[0, 0, 0\]"):
        Scenario().replace(sun={"direction": (0.0, 0.0, 0.0)})
