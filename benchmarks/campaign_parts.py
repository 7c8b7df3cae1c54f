"""What each part of a flight-step costs in a batch on one core: compiled alone, run over and over on moving flights."""

import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from keepout.core.fields.neural import NeuralField
from keepout.core.flight.batches import BATCH

ROUNDS = 200
REPEATS = 5


def shares(plan):
    """Give microseconds of processor time a flight-step of each part, and the network's products alone."""
    setup = plan.mission.setup
    arrays, rest = eqx.partition(setup, eqx.is_array)
    states = jax.tree.map(lambda array: array[:BATCH], plan.initial)
    first = jax.tree.map(lambda array: array[0], states)

    def microseconds(part):
        def many(arrays, position, velocity):
            own = eqx.combine(arrays, rest)

            def one(position, velocity):
                def again(carry, _):
                    time, position, velocity = carry
                    state = eqx.tree_at(lambda s: (s.time, s.position, s.velocity), first, (time, position, velocity))
                    answers = [x for x in jax.tree.leaves(part(own, state)) if jnp.issubdtype(x.dtype, jnp.floating)]
                    # Too little to change anything, and enough that nothing is left out.
                    trace = sum(jnp.sum(x) for x in answers) * 1e-30
                    return (time + 1.0, position + 0.002 + trace, velocity + 1e-7 + trace), None

                return jax.lax.scan(again, (first.time, position, velocity), length=ROUNDS)[0]

            return jax.vmap(one)(position, velocity)

        program = jax.jit(many)
        jax.block_until_ready(program(arrays, states.position, states.velocity))
        return _least(lambda: program(arrays, states.position, states.velocity)) / ROUNDS

    law = setup.controller
    found = {
        "network": microseconds(lambda s, at: law_field(s).value_and_gradient(at.position)),
        "guidance": microseconds(lambda s, at: s.controller.velocity.guidance.desired_velocity(at.position)),
        "law in all": microseconds(lambda s, at: s.controller.step(s.controller.initial_state(at), at)[1]),
        "Runge-Kutta": microseconds(
            lambda s, at: s.motion.step(at, 1e-9 * at.position, s.disturbance, s.period, s.mass)
        ),
    }
    if setup.guard is not None:
        found["guard"] = microseconds(
            lambda s, at: s.guard.filter(s.guard.initial_state(at), at, 1e-6 * at.velocity, jnp.zeros(3))
        )
    found["law's rest"] = found.pop("law in all") - found["network"] - found["guidance"]
    if isinstance(law.velocity.field, NeuralField):
        found["products alone (the network's limit)"] = _products(law.velocity.field.layers)
    return found


def law_field(setup):
    """Give the field that the law flies by."""
    return setup.controller.velocity.field


def _products(layers):
    """Multiply as the two sweeps of value and gradient do, and nothing else."""
    hidden = layers.weights[1:-1]

    def many(weights, rows):
        def again(rows, _):
            for weight in weights:
                rows = jnp.matmul(rows, weight.T, precision=jax.lax.Precision.HIGHEST)
            for weight in weights:
                rows = jnp.matmul(rows, weight, precision=jax.lax.Precision.HIGHEST)
            return 1e-3 * rows, None

        return jax.lax.scan(again, rows, length=ROUNDS)[0]

    rows = jnp.asarray(np.random.default_rng(0).normal(size=(BATCH, hidden[0].shape[1])), jnp.float32)
    program = jax.jit(many)
    jax.block_until_ready(program(hidden, rows))
    return _least(lambda: program(hidden, rows)) / ROUNDS


def _least(work):
    """Give the least processor time of a few runs, microseconds a flight."""
    least = np.inf
    for _ in range(REPEATS):
        began = time.process_time()
        jax.block_until_ready(work())
        least = min(least, time.process_time() - began)
    return 1e6 * least / BATCH
