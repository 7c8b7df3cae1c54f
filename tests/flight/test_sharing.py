"""What flights share is computed once for all of them: the flights stay what they are."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from truths.flights import make_setup

from keepout.errors import ScenarioError
from keepout.flight.batches import TARGET, _fly_batch, _shared, alike_among, flight_key, fly_batches, states_at
from keepout.flight.faults import WrongEstimate
from keepout.motion import Tumbling

STEPS = 200
TUMBLING = Tumbling([0.002, -0.003, 0.001], np.diag([1.0, 2.0, 2.5]))


def shell(generator, count):
    direction = generator.standard_normal((count, 3))
    return 8 * direction / np.linalg.norm(direction, axis=1, keepdims=True), np.zeros((count, 3))


def tumbling_setup(**changes):
    setup = make_setup(**changes)
    return eqx.tree_at(lambda s: s.motion.attitude_motion, setup, TUMBLING)


def flown(setup, states, **options):
    parts = []
    fly_batches(
        setup,
        states,
        STEPS,
        columns=("time", "position", "velocity", "attitude"),
        landed=lambda _, log: parts.append(log),
        **options,
    )
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


@pytest.mark.long
def test_shared_or_not_a_flight_is_the_same():
    setup = tumbling_setup()
    states = states_at(setup.motion, *shell(np.random.default_rng(1), 5))
    assert alike_among(states) == ("time", "attitude", "angular_velocity")
    shared, own = flown(setup, states, batch=4), flown(setup, states, batch=4, alike=())
    for name, array in shared.items():
        np.testing.assert_allclose(array, own[name], rtol=0.0, atol=1e-12, err_msg=name)


def test_what_is_shared_has_no_axis_of_flights_in_the_loop():
    setup = tumbling_setup()
    states = states_at(setup.motion, *shell(np.random.default_rng(1), 4))

    def carried(alike):
        shared, own = _shared(states, alike)
        nothing = eqx.filter(setup, jax.tree.map(lambda _: False, setup))
        cases = (nothing, own, jnp.arange(4))
        fly = functools.partial(_fly_batch, setup, steps=3, columns=("position",))
        program = jax.make_jaxpr(lambda shared, cases: fly(shared, jnp.asarray(0), cases))(shared, cases)
        return [v.aval.shape for loop in _loops(program.jaxpr) for v in loop.outvars[: loop.params["num_carry"]]]

    # The flights' time and attitude: numbers of no axis and of four, and of one and of four more, where not shared.
    shared = carried(alike_among(states))
    assert (4,) in shared
    assert (4, 4) not in shared
    assert (4, 4) in carried(())


def _loops(program):
    for equation in program.eqns:
        if equation.primitive.name == "scan" and equation.params["length"] == 4:
            yield equation
        for inner in jax.tree.leaves(equation.params, is_leaf=lambda x: hasattr(x, "jaxpr")):
            if hasattr(inner, "jaxpr"):
                yield from _loops(inner.jaxpr)


@pytest.mark.long
def test_a_target_that_turns_otherwise_in_each_flight():
    setup = tumbling_setup()
    rates = jnp.array([[0.002, -0.003, 0.001], [0.0, 0.004, 0.0], [0.001, 0.0, -0.002]])
    many = eqx.tree_at(lambda s: s.motion.attitude_motion.angular_velocity, setup, rates)
    states = states_at(setup.motion, *shell(np.random.default_rng(1), 3))
    states = eqx.tree_at(lambda s: s.angular_velocity, states, rates)
    assert alike_among(states) == ("time", "attitude")
    varied = flown(many, states, vary=lambda s: s.motion.attitude_motion.angular_velocity, batch=3)
    for k in range(3):
        own = eqx.tree_at(lambda s, k=k: s.motion.attitude_motion.angular_velocity, setup, rates[k])
        single = flown(own, jax.tree.map(lambda x, k=k: x[k : k + 1], states), batch=3)
        np.testing.assert_allclose(varied["position"][k], single["position"][0], rtol=0.0, atol=1e-12)


@pytest.mark.long
@pytest.mark.parametrize("k", [0, 3, 6])
def test_a_run_flown_alone_is_the_run_of_the_campaign(k):
    setup = make_setup(faults=WrongEstimate(0.1, 0.0, 0.1, 0.01))
    states = states_at(setup.motion, *shell(np.random.default_rng(3), 7))
    # Whatever flies beside it, in whatever place: the same batch size gives the same bits.
    whole = flown(setup, states, seed=5, batch=4, workers=2)
    states = jax.tree.map(lambda x: x[k : k + 1], states)
    alone = flown(setup, states, seed=5, batch=4, first=k, alike=alike_among(states))
    np.testing.assert_array_equal(alone["position"][0], whole["position"][k])
    assert np.abs(flown(setup, states, seed=5, batch=4)["position"][0] - whole["position"][k]).max() > 1e-3 or k == 0


def test_keys_of_flights_differ():
    keys = jax.vmap(lambda place: flight_key(7, place))(jnp.arange(100_000))
    assert len(np.unique(jax.random.key_data(keys), axis=0)) == 100_000
    np.testing.assert_array_equal(jax.random.key_data(flight_key(7, 99_990)), jax.random.key_data(keys)[99_990])


def test_an_entry_that_no_target_has_is_refused():
    setup = make_setup()
    states = states_at(setup.motion, *shell(np.random.default_rng(0), 2))
    with pytest.raises(ScenarioError, match="alike: position; valid are time"):
        fly_batches(setup, states, 5, alike=("position",))
    assert set(TARGET) < set(vars(states))
