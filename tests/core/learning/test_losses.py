"""What training minimises, and its derivative, written out, against JAX's own reverse of the reverse."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from truths.networks import random_layers

from keepout.core.errors import FieldError
from keepout.core.fields import neural
from keepout.core.geometry.target import Target
from keepout.core.learning import losses, training
from keepout.core.learning.losses import PROFILES

PROFILE = PROFILES["quick"]
SCALE, BETA = 12.0, 30.0


def labelled(count: int, share: float) -> losses.Batch:
    """Points of which a share has a gradient, and half of the others are hidden."""
    rng = np.random.default_rng(count)
    smooth = rng.random(count) < share
    hidden = ~smooth & (rng.random(count) < 0.5)
    gradient = rng.normal(size=(count, 3)) * smooth[:, None]
    columns = (rng.normal(size=(count, 3)), rng.normal(size=count), gradient, rng.uniform(0.5, 2.0, count))
    x, distance, gradient, weight = (jnp.asarray(column, jnp.float32) for column in columns)
    return losses.Batch(x, distance, gradient, jnp.asarray(smooth), jnp.asarray(hidden), weight)


@pytest.mark.long
def test_points_in_two_parts_count_as_if_each_had_its_gradient_evaluated():
    """Points that have no gradient to learn cost less, and count the same."""
    layers, whole = random_layers(3, dtype=jnp.float32), labelled(80, 0.6)
    parts = losses.Parted.by(PROFILE, whole)
    sloped, joined = int(parts.sloped), jax.tree.map(lambda column: column[:80], parts.points)
    assert sloped == int(whole.smooth.sum())
    assert int(parts.known) == 80

    def total(layers, rows, sloped):
        value_term, slope_term = losses.terms(layers, PROFILE, SCALE, rows, sloped)
        return jnp.sum(value_term) + jnp.sum(slope_term)

    derivative = jax.jit(jax.value_and_grad(total), static_argnums=2)
    ours, ours_slope = derivative(layers, joined, sloped)
    truth, truth_slope = derivative(layers, whole, 80)
    assert float(ours) == pytest.approx(float(truth), rel=1e-5)
    for a, b in zip(jax.tree.leaves(ours_slope), jax.tree.leaves(truth_slope), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5 * float(np.abs(b).max()))


@pytest.mark.long
def test_steps_of_two_meshes_are_one_program_and_count_each_kind_in_its_true_share():
    """What a step draws of each kind is rounded, to few programs for all meshes; weights make up for it."""
    profile = dataclasses.replace(PROFILE, samples=900, batch=64, width=8, depth=1)
    compiled = []
    for count, share in ((900, 0.57), (800, 0.58)):
        whole = labelled(count, share)
        whole = whole._replace(weight=jnp.where(whole.smooth, whole.weight, 10.0 * whole.weight))
        parts = losses.Parted.by(profile, whole)
        state = training._initial(profile, whole, 0, 0)
        sloped = parts.rows(profile.batch)
        assert sloped == 40
        given = jnp.float32(SCALE), jnp.float32(1e-6), jax.random.key(0), np.zeros(400, np.float32)
        _, _, value_mean, slope_mean = training._train_round(profile, 0, sloped, state, parts, *given)
        compiled.append(training._train_round._cache_size())
        value_term, slope_term = losses.terms(state.layers, profile, SCALE, whole, count)
        assert float(value_mean) == pytest.approx(float(value_term.mean()), rel=0.03)
        assert float(slope_mean) == pytest.approx(float(slope_term.mean()), rel=0.03)
    assert compiled[0] == compiled[1]


@pytest.mark.long
def test_a_step_of_all_points_takes_each_as_it_is():
    profile = dataclasses.replace(PROFILE, samples=80, batch=80, width=8, depth=1)
    whole = labelled(80, 0.57)
    parts = losses.Parted.by(profile, whole)
    state = training._initial(profile, whole, 0, 0)
    given = (state, parts, jnp.float32(SCALE), jnp.float32(0.7), jax.random.key(0), np.zeros(1, np.float32))
    _, _, value_mean, slope_mean = training._train_round(profile, 0, int(parts.sloped), *given)
    value_term, slope_term = losses.terms(state.layers, profile, SCALE, whole, 80, 0.7)
    assert float(value_mean) == pytest.approx(float(value_term.mean()), rel=1e-5)
    assert float(slope_mean) == pytest.approx(float(slope_term.mean()), rel=1e-5)


@pytest.mark.long
@pytest.mark.parametrize("name", ["paper", "paper_printed"])
def test_the_papers_eikonal_term_is_asked_of_every_point(name):
    parts = losses.Parted.by(PROFILES[name], labelled(50, 0.3))
    assert (int(parts.sloped), int(parts.known), parts.rows(40)) == (50, 50, 40)


@pytest.mark.long
def test_the_keepout_loss_by_hand():
    """Weighted pinball, by another share beyond the near field; no under-statement where hidden; a slope's error."""
    x = np.float32([[0.1, 0.2, 0.3]] * 3)
    layers = random_layers(1, dtype=jnp.float32)
    y, gradient = jax.jit(losses.value_and_gradient, static_argnums=1)(layers, PROFILE.beta, x)
    f = float(y[0]) * SCALE
    distance = np.float32([f + 1.0, f - 1.0, f + 1.0])
    profile = dataclasses.replace(PROFILE, over_weight=0.8, far_over_weight=0.6, near_field=f)
    off = np.asarray(gradient) + np.float32([0.0, 0.0, 1.0])
    smooth, hidden = np.array([True, False, False]), np.array([False, False, True])
    batch = losses.Batch(*map(jnp.asarray, (x, distance, off, smooth, hidden, np.float32([2.0, 3.0, 1.0]))))
    value_term, slope_term = jax.jit(lambda batch: losses.terms(layers, profile, SCALE, batch, 1))(batch)
    np.testing.assert_allclose(value_term, [2.0 * 0.4, 3.0 * 0.8, 0.0], rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(slope_term, [PROFILE.gradient_weight / (1.0 + abs(distance[0]))], rtol=1e-4)
    bent, _ = jax.jit(lambda batch: losses.terms(layers, profile, SCALE, batch, 1, 0.4))(batch)
    np.testing.assert_allclose(bent, [2.0 * 0.4 * 0.8, 3.0 * 0.8 * 0.8, 0.0], rtol=1e-4, atol=1e-5)
    squared, _ = jax.jit(lambda batch: losses.terms(layers, profile, SCALE, batch, 1, 4.0))(batch)
    np.testing.assert_allclose(squared, [2.0 * 0.4 / 8.0, 3.0 * 0.8 / 8.0, 0.0], rtol=1e-4, atol=1e-5)


@pytest.mark.long
@pytest.mark.parametrize("shape", [(3, 16, 8, 1), pytest.param((3, 32, 16, 24, 16, 1), marks=pytest.mark.slow)])
def test_the_second_sweep_is_the_derivative_that_jax_finds(shape):
    rng = np.random.default_rng(0)
    x, target = (jnp.asarray(rng.normal(size=(40, 3))) for _ in range(2))

    def loss(layers, function, of_value, of_gradient, of_both):
        value, gradient = function(layers, BETA, x)
        apart = jnp.sum((gradient - target) ** 2)
        return of_value * jnp.sum(jnp.sin(value) ** 2) + of_gradient * apart + of_both * jnp.sum(value * gradient[:, 1])

    derivative = jax.jit(jax.value_and_grad(loss), static_argnums=1)
    for weights in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (1.0, 1.0, 1.0)):
        ours, ours_gradient = derivative(random_layers(1, shape), losses.value_and_gradient, *weights)
        truth, truth_gradient = derivative(random_layers(1, shape), neural.value_and_gradient, *weights)
        assert float(ours) == pytest.approx(float(truth), rel=1e-13)
        for a, b in zip(jax.tree.leaves(ours_gradient), jax.tree.leaves(truth_gradient), strict=True):
            assert a.shape == b.shape
            np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-12 * float(np.abs(b).max()))


@pytest.mark.long
def test_small_errors_count_by_their_square_up_to_what_the_profile_says_of_each_phase(monkeypatch):
    told = []

    def nothing(profile, hard, sloped, state, data, scale, bend, key, rates):
        told.append((hard > 0, float(bend)))
        return state.layers, state.optimizer, jnp.float32(0.0), jnp.float32(0.0)

    monkeypatch.setattr(training, "_train_round", nothing)
    numbers = {"width": 8, "depth": 2, "samples": 2000, "batch": 64, "steps": 250, "tuning_steps": 250}
    profile = losses.TrainingProfile(**numbers, polish_steps=100, squared_below=(0.5, 0.25))
    training.fit(Target.load("box"), profile=profile)
    assert told == 5 * [(False, 0.5)] + 5 * [(True, 0.5)] + 2 * [(True, 0.25)]


@pytest.mark.long
def test_a_small_fit_by_a_stations_numbers_learns_the_distance():
    """All that is a station's own at once: its start, its samples, and squares until the polish."""
    small = {"width": 24, "depth": 2, "samples": 20_000, "batch": 512, "steps": 750, "tuning_steps": 250}
    station = PROFILES["default"].large
    assert station is not None
    model = training.fit(Target.load("box"), profile=dataclasses.replace(station, **small, polish_steps=50))
    curve = model.training["curve"]
    assert curve["value_term"][2] < 0.5 * curve["value_term"][0]
    assert curve["gradient_term"][2] < 0.5 * curve["gradient_term"][0]
    assert abs(curve["mean_error_m"][-1]) < 0.05


@pytest.mark.parametrize("batch", [0, -3, 300_001])
def test_a_batch_is_of_the_samples_that_there_are(batch):
    with pytest.raises(FieldError, match=rf"batch {batch}: it must be between 1 and the profile's 300000 samples"):
        PROFILES["default"].with_batch(batch)
    changed = PROFILES["default"].with_batch(77)
    assert changed.batch == 77
    assert changed.large is not None
    assert changed.large.batch == 77


def test_a_surface_start_bends_at_points_of_the_surface_and_weighs_them_unequally():
    """Where the distance is least and no point hidden; sizes a third to three times those of the start without."""
    profile = dataclasses.replace(PROFILE, start="surface", width=64)
    whole = labelled(2000, 0.5)
    whole = whole._replace(distance=jnp.abs(whole.x[:, 0]))
    first = training._initial(profile, whole, 1, 0).layers
    weights, biases = np.asarray(first.weights[0]), np.asarray(first.biases[0])
    nearest = np.argsort(np.where(whole.hidden, np.inf, whole.distance))[:200]
    away = np.abs(np.asarray(whole.x) @ weights.T + biases).argmin(axis=0)
    assert np.isin(away, nearest).all()
    plain = training._initial(dataclasses.replace(profile, start="he"), whole, 1, 0).layers
    ratio = weights / np.asarray(plain.weights[0])
    np.testing.assert_allclose(ratio, ratio[:, :1].repeat(3, axis=1), rtol=1e-5)
    assert ratio.min() >= np.exp(-1.0)
    assert ratio.max() <= np.exp(1.0)
    assert np.ptp(ratio) > 1.0


def test_a_geometric_start_is_about_the_distance_to_half_the_unit_ball():
    profile = dataclasses.replace(PROFILE, start="geometric", width=256, depth=5)
    layers = training._initial(profile, labelled(4, 1.0), 1, 0).layers
    radii = np.linspace(0.1, 1.2, 12)
    directions = np.random.default_rng(0).normal(size=(400, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    value = training._value(
        layers, profile.beta, jnp.asarray(radii[:, None, None] * directions, jnp.float32).reshape(-1, 3)
    )
    mean = np.asarray(value).reshape(12, 400).mean(axis=1)
    np.testing.assert_allclose(mean, radii - 0.5, atol=0.25)
    assert np.all(np.diff(mean) > 0.0)
