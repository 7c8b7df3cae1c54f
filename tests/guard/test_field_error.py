"""What a field's evaluation may be off by is carried by every comparison of the guard, and exactly twice."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from truths.guarded_worlds import ASSUMED, directions, motion_state

from keepout.errors import ControlError
from keepout.fields.field import Field
from keepout.guard.guard import Guard
from keepout.guard.nominal import stop

pytestmark = pytest.mark.long

THRESHOLD, ERROR = 0.5, 0.02


class Rippled(Field):
    """Distance to a ball of 2 m, ± 0.02 m: too high in a thin shell about the place asked first, too low beside it."""

    place: jax.Array

    def value(self, points):
        radius = jnp.sqrt(jnp.sum(points**2, axis=-1))
        return radius - 2.0 + jnp.where(jnp.abs(radius - self.place) < 1e-6, ERROR, -ERROR)

    def value_and_gradient(self, points):
        return self.value(points), points / jnp.linalg.norm(points)

    def value_gradient_hessian(self, points):
        raise NotImplementedError


@eqx.filter_jit
def certified(guard, state):
    return guard.certified(state)


def certified_and_least(error, speed):
    """Over starts from near to far: whether each is certified, and the least field value in the tube of its stop."""
    way = directions(np.random.default_rng(0), 1)[0]
    answers = []
    built = Guard(Rippled(jnp.asarray(0.0)), THRESHOLD, 1.0, ASSUMED, evaluation_error=error)
    for place in np.linspace(2.5, 2.7, 101):
        guard = eqx.tree_at(lambda guard: guard.field.place, built, jnp.asarray(place))
        length = float(jnp.linalg.norm(stop(guard.assumptions, guard.braking, -speed * way)))
        least = place - 2.0 - length - guard.braking.position_radius - ERROR
        answers.append((bool(certified(guard, motion_state(place * way, -speed * way))), least))
    return answers


@pytest.mark.parametrize(
    ("error", "speed", "holds"),
    [(ERROR, 0.0, True), (ERROR, 0.02, True), (0.75 * ERROR, 0.0, False), (0.0, 0.0, False)],
)
def test_what_is_certified_stays_above_the_threshold_only_with_the_error_carried(error, speed, holds):
    answers = certified_and_least(error, speed)
    assert any(told for told, _ in answers)
    assert all(least > THRESHOLD - 1e-9 for told, least in answers if told) == holds


@pytest.mark.parametrize("error", [-1e-9, float("nan"), float("inf")])
def test_an_error_that_is_none_is_refused(error):
    with pytest.raises(ControlError, match="evaluation_error is"):
        Guard(Rippled(jnp.asarray(3.0)), THRESHOLD, 1.0, ASSUMED, evaluation_error=error)
