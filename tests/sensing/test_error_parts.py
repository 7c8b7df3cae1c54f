"""What errors are drawn: inside their balls, with the variance told, and beyond a bound as often as told."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from keepout.errors import ScenarioError
from keepout.sensing.error_parts import BallNoise, ErrorModel, GaussianNoise, Outliers, WanderingBias

COUNT = 200_000


def drawn(model, count=COUNT, seed=0):
    """Errors of many sensors, one draw each."""
    a, b = jax.random.split(jax.random.key(seed))

    def one(first, second):
        return model.draw(model.initial_state(first), second)[1]

    shape = count, model.normals()
    return np.asarray(jax.jit(jax.vmap(one))(jax.random.normal(a, shape), jax.random.normal(b, shape)))


@pytest.mark.parametrize("dimension", [1, 3])
@pytest.mark.parametrize("part", [BallNoise(0.3), GaussianNoise(0.3), WanderingBias(0.3, 0.01)])
def test_the_variance_is_the_one_told(part, dimension):
    model = ErrorModel((part,), dimension)
    errors = drawn(model)
    assert np.var(errors, axis=0) == pytest.approx(np.full(dimension, float(model.variance())), rel=0.02)
    assert np.abs(np.mean(errors, axis=0)).max() < 0.005


@pytest.mark.parametrize("dimension", [1, 3])
def test_noise_is_even_in_its_ball(dimension):
    length = np.linalg.norm(drawn(ErrorModel((BallNoise(2.0),), dimension)), axis=1)
    assert length.max() <= 2.0
    assert stats.kstest((length / 2.0) ** dimension, "uniform").pvalue > 1e-3


def test_independent_parts_add_up():
    model = ErrorModel((BallNoise(0.2), GaussianNoise(0.1), WanderingBias(0.3)), 3)
    assert float(model.variance()) == pytest.approx(0.04 / 5 + 0.01 + 0.09 / 5)
    assert np.var(drawn(model), axis=0) == pytest.approx(np.full(3, float(model.variance())), rel=0.02)
    assert float(model.bound()) == pytest.approx(0.2 + 6 * 0.1 + 0.3)


@settings(max_examples=30)
@given(st.floats(1e-6, 1e3), st.floats(0.0, 1.0), st.integers(0, 2**31))
def test_a_bias_stays_in_its_ball_and_moves_by_its_step(radius, share, seed):
    model = ErrorModel((WanderingBias(radius, share * radius),), 3)
    start, later = jax.random.split(jax.random.key(seed))
    memory = model.initial_state(jax.random.normal(start, (model.normals(),)))

    def step(memory, normals):
        return model.draw(memory, normals)

    _, path = jax.lax.scan(step, memory, jax.random.normal(later, (300, model.normals())))
    path = np.asarray(path)
    assert np.linalg.norm(path, axis=1).max() <= radius * (1 + 1e-12)
    # A step is as told, or reflected: then it leads no further than it would have.
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).max() <= 2 * share * radius * (1 + 1e-9)


def test_a_bias_that_wanders_gets_everywhere():
    """It forgets where it began, and is then spread evenly over its ball."""
    model = ErrorModel((WanderingBias(1.0, 0.2),), 3)

    def one(key):
        memory = (jnp.array([0.99, 0.0, 0.0]),)
        normals = jax.random.normal(key, (800, model.normals()))
        return jax.lax.scan(lambda state, some: model.draw(state, some), memory, normals)[1][-1]

    ends = np.asarray(jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(0), 4000)))
    assert np.linalg.norm(np.mean(ends, axis=0)) < 0.05
    assert np.var(ends, axis=0) == pytest.approx(np.full(3, 0.2), rel=0.1)


def test_outliers_are_as_many_and_as_large_as_told():
    model = ErrorModel((Outliers(0.01, 7.0),), 3)
    length = np.linalg.norm(drawn(model), axis=1)
    assert set(np.round(length, 9)) == {0.0, 7.0}
    assert stats.binomtest(int((length > 1).sum()), COUNT, 0.01).pvalue > 1e-3
    assert float(model.bound()) == 0.0
    assert model.beyond() == 0.01


@pytest.mark.parametrize("sigmas", [1.0, 2.0, 3.0])
@pytest.mark.parametrize("dimension", [1, 3])
def test_gaussian_noise_passes_its_bound_as_often_as_told(sigmas, dimension):
    model = ErrorModel((GaussianNoise(0.4, sigmas),), dimension)
    passed = int((np.linalg.norm(drawn(model), axis=1) > float(model.bound())).sum())
    assert stats.binomtest(passed, COUNT, model.beyond()).pvalue > 1e-3


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: BallNoise(-1.0), "noise radius: -1.0; it must be finite and at least 0"),
        (lambda: GaussianNoise(np.nan), "noise standard deviation: nan; it must be finite and at least 0"),
        (lambda: WanderingBias(0.1, 0.2), "bias step: 0.2; it must be at most the radius 0.1"),
        (lambda: Outliers(1.5, 1.0), "outlier probability: 1.5; it must be above 0 and below 1"),
    ],
)
def test_refused(make, said):
    with pytest.raises(ScenarioError) as caught:
        make()
    assert str(caught.value) == said
