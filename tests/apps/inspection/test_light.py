"""The light of a scenario against published places of the sun, closed forms of night and turning, and SciPy's paths."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from truths.orbits import EARTH, MU

from keepout.apps.inspection.light import SUN_RADIUS, Light, shines
from keepout.core.errors import InspectionError
from keepout.core.mission.scenario import Scenario


def light(**tables):
    return Light(Scenario().replace(light={"kind": "sun"}, **tables))


def equatorial(direction):
    """ECI axes of a vector in VVLH at the start of an equatorial orbit from the x axis: x is ECI's y, z is its -x."""
    x, y, z = direction
    return np.array([-z, x, -y])


def apart(one, other):
    return math.degrees(math.atan2(np.linalg.norm(np.cross(one, other)), float(np.dot(one, other))))


@pytest.mark.parametrize(
    ("epoch", "right_ascension", "declination"),
    [
        # Vallado, Fundamentals of Astrodynamics, example 5-1.
        ("2006-04-02T00:00:00Z", 11.140899, 4.788425),
        # Meeus, Astronomical Algorithms, example 25.b (by VSOP87), at 0 h of dynamical time, 59 s before 0 h UTC.
        ("1992-10-12T23:59:01Z", 198.378121, -7.783817),
        # The Astronomical Almanac's solstice: 23.436 degrees north, at 6 h.
        ("2026-06-21T08:25:00Z", 90.0, 23.436),
    ],
)
def test_the_sun_stands_over_the_target_where_it_is_published(epoch, right_ascension, declination):
    alpha, delta = math.radians(right_ascension), math.radians(declination)
    published = [math.cos(delta) * math.cos(alpha), math.cos(delta) * math.sin(alpha), math.sin(delta)]
    found = light(epoch=epoch).sun(0.0)
    assert np.linalg.norm(found) == pytest.approx(1.0, abs=1e-12)
    assert apart(equatorial(found), published) < 0.02


@pytest.mark.parametrize("beta", [0.0, 0.6, 1.1])
@pytest.mark.parametrize("radius", [6.7e6, 2.6e7])
def test_a_circular_orbit_has_the_night_of_its_closed_form(radius, beta):
    """Dark where the sun is within ρ of the Earth's centre: half the night's angle has cos ν = cos ρ / cos β."""
    sun = (math.cos(beta), 0.0, math.sin(beta))
    rho = math.asin(EARTH / radius) + SUN_RADIUS
    share = 0.0 if math.cos(rho) >= math.cos(beta) else math.acos(math.cos(rho) / math.cos(beta)) / math.pi
    period = 2.0 * math.pi * math.sqrt(radius**3 / MU)
    times = period * (np.arange(20_000) + 0.5) / 20_000
    found = light(orbit={"semi_major_axis": radius, "true_anomaly": 1.0}, sun={"direction": sun}).suns(times)
    assert np.isnan(found).any(axis=1).mean() == pytest.approx(share, abs=2e-4)
    assert (share == 0.0) == (beta > rho)


@given(st.floats(6.45e6, 5e7), st.floats(-1.0, 1.0), st.floats(0.0, 6.28), st.floats(-0.02, 0.02))
def test_the_sun_shines_where_no_ray_from_its_disc_meets_the_earth(radius, height, turn, beyond):
    """Brute force: rays to the disc's rim and middle against the Earth as a ball, near the shadow's edge."""
    sine = math.sqrt(1.0 - height * height)
    toward = np.array([sine * math.cos(turn), sine * math.sin(turn), height])
    side = np.cross(toward, np.eye(3)[np.argmin(np.abs(toward))])
    side /= np.linalg.norm(side)
    other = np.cross(toward, side)
    angle = math.asin(EARTH / radius) + SUN_RADIUS + beyond
    position = -radius * (math.cos(angle) * toward + math.sin(angle) * side)
    around = np.linspace(0.0, 2.0 * math.pi, 3600, endpoint=False)[:, None]
    rim = math.cos(SUN_RADIUS) * toward + math.sin(SUN_RADIUS) * (np.cos(around) * side + np.sin(around) * other)
    rays = np.concatenate([rim, toward[None]])
    along = -(rays @ position)
    nearest = np.linalg.norm(position + np.maximum(along, 0.0)[:, None] * rays, axis=1)
    if np.abs(nearest - EARTH).min() > 50.0:
        assert shines(position[None], toward[None])[0] == bool(np.all(nearest > EARTH))


def test_without_light_and_with_a_fixed_one():
    none = Light(Scenario())
    assert not none.matters
    assert none.sun(5.0) is None
    assert np.isnan(none.suns([0.0, 1.0])).all()
    fixed = Light(Scenario().replace(light={"kind": "fixed", "direction": (0.0, -3.0, 4.0)}))
    assert fixed.matters
    np.testing.assert_allclose(fixed.sun(1e6), [0.0, -0.6, 0.8])
    assert fixed.suns([]).shape == light().suns([]).shape == (0, 3)


@pytest.mark.parametrize("time", [-1.0, math.nan, math.inf])
def test_a_time_that_is_none_is_refused(time):
    with pytest.raises(InspectionError, match="the light is known from 0 to"):
        light().sun(time)
