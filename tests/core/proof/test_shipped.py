"""The fields that come with the package belong to the built-in targets and keep what their certificates say."""

import numpy as np
import pytest
from shipped import CHASER_RADII

from keepout.core.errors import FieldError
from keepout.core.fields import load_shipped, shipped_folder, shipped_names
from keepout.core.fields.field import values, values_and_gradients
from keepout.core.geometry.level_set import surface_points
from keepout.core.geometry.target import Target
from keepout.core.proof.certificate import SMALLEST_GAP, certify, check_certificate

NAMES = pytest.mark.parametrize("name", shipped_names())
RADII = pytest.mark.parametrize("radius", CHASER_RADII)


def on_contact(distance, x, radius):
    """The points moved onto {d = radius} along the distance's gradient, less those that do not arrive."""
    if radius == 0.0:
        return distance.closest(x)[1]
    for _ in range(3):
        d, away = distance.distance_and_gradient(x)
        x = x + (radius - d)[:, None] * away
    return x[np.abs(distance.distance(x) - radius) < 1e-9]


def contact_points(distance, radius, count, rng):
    x = surface_points(distance, count, rng, by_area=0.5)
    return on_contact(distance, x + rng.normal(scale=1e-3, size=x.shape), radius) if radius > 0.0 else x


def attack_field(model, target, radius, points, starts):
    """Largest f̃ - R that random points and ascents find on {d = R}."""
    rng, distance = np.random.default_rng(0), target.distance
    best, seen = -np.inf, 0
    while seen < points:
        x = contact_points(distance, radius, min(500_000, points), rng)
        seen += len(x)
        best = max(best, float(values(model.field, x).max()))
    x = contact_points(distance, radius, 2 * starts, rng)[:starts]
    for step in np.geomspace(0.1, 0.001, 30 if points > 100_000 else 5):
        found, gradient = values_and_gradients(model.field, x)
        best = max(best, float(found.max()))
        x = x + step * gradient / np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-9)
        x = on_contact(distance, x, radius)
    return best - radius


def test_there_is_a_field_and_all_are_small():
    assert "intelsat30" in shipped_names()
    assert sum(path.stat().st_size for path in shipped_folder().glob("*.keepout")) <= 1_000_000
    with pytest.raises(FieldError, match="'sputnik': there is none"):
        load_shipped("sputnik")


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "radius"),
    [
        pytest.param(name, radius, marks=[] if radius > 0.0 or name == "intelsat30" else [pytest.mark.slow])
        for name in shipped_names()
        for radius in CHASER_RADII
    ],
)
def test_certificates_hold(name, radius):
    """A station's for a chaser that is a point by `make test-all`, where all are searched at full size."""
    target = Target.load(name)
    proof = load_shipped(name, target=target).certificate(radius)
    assert proof.kind == "certified"
    assert name != "intelsat30" or proof.gradient_kind == "certified"
    assert attack_field(load_shipped(name), target, radius, points=20_000, starts=300) <= proof.error_bound


@pytest.mark.slow
@NAMES
@RADII
def test_certificates_hold_at_full_size_and_can_be_proved_again(name, radius):
    target = Target.load(name)
    model = load_shipped(name, target=target)
    worst, bound = attack_field(model, target, radius, 2_000_000, 10_000), model.certificate(radius).error_bound
    print(f"{name}, R = {radius:g} m: largest found {worst:+.5f} m, certified {bound:+.5f} m")
    assert worst <= bound
    assert check_certificate(model, target, model.certificate(radius)).proved
    again = certify(model, target, chaser_radius=radius).certificate(radius)
    # Each proof ends so near to the largest value found, wherever it split.
    assert again.error_bound == pytest.approx(bound, abs=SMALLEST_GAP)


@pytest.mark.slow
@RADII
def test_no_search_beats_a_proved_slope(radius):
    target = Target.load("intelsat30")
    model = load_shipped("intelsat30", target=target)
    proof, distance = model.certificate(radius), target.distance
    rng = np.random.default_rng(0)
    points = surface_points(distance, 1_000_000, rng, by_area=0.5)
    points += (radius + rng.exponential(0.4, size=(len(points), 1))) * rng.normal(size=points.shape)
    for step in (0.0, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002):
        if step:
            moved = np.repeat(points, 8, axis=0)
            points = np.concatenate([points, moved + step * rng.normal(size=moved.shape)])
        points = points[distance.distance(points) >= radius]
        slope = np.linalg.norm(values_and_gradients(model.field, points)[1], axis=1)
        assert slope.max() <= proof.gradient_bound
        points = points[np.argsort(-slope)[:10_000]]
    print(f"R = {radius:g} m: steepest found {slope.max():.3f}, proved {proof.gradient_bound:.3f}")
