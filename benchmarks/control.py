"""Time one control step from Python on one core, the usual way in the same run, and batches of velocity programs.

The usual way is CVXPY + Clarabel with a PyTorch field. Run as `taskset -c 0 python benchmarks/control.py [--json]`. It
needs the extra `bench` (cvxpy, torch) and is left out, with the reason, where a package is missing.

A step runs as it would on board (`keepout.flights.on_board`): the compiled program on the calling thread
(`jax_cpu_enable_async_dispatch` off, to be set before JAX starts; handing over to another thread is most of the tail),
and no garbage collection inside the loop.
"""

import gc
import importlib.util
import itertools
import json
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from kept_rows import command

from keepout.core.control import profiles
from keepout.core.control.guidance import Straight
from keepout.core.control.profiles import Operation
from keepout.core.control.unit_program import Circulation, VelocityProgram
from keepout.core.control.velocity_program import solve
from keepout.core.fields import neural
from keepout.core.fields.continuation import RadialContinuation
from keepout.core.fields.neural import NeuralField
from keepout.core.fields.own import SphereField
from keepout.core.flight.setup import FlightSetup
from keepout.core.motion.chaser import Chaser
from keepout.core.motion.disturbance import NoDisturbance
from keepout.core.motion.orbit import Orbit
from keepout.core.motion.relative import RelativeMotion
from keepout.flights.on_board import OnBoard
from keepout.flights.pages.page import machine

CHASER = Chaser(mass=20.0, radius=0.5, force_limit=0.1, speed_limit=0.1)
WIDTH, DEPTH, BETA = 96, 4, 100.0
BATCH = 1024
PROGRAMS = {
    # gradient error, circulation, box, speed cone
    "default law with circulation": (False, True, False, True),
    "paper law": (False, True, True, False),
    "paper law with a gradient error": (True, True, True, False),
    "every row": (True, True, True, True),
}


def neural_field():
    """Make a network of the default size with random weights: its values mean nothing, its cost is the same."""
    rng = np.random.default_rng(0)
    sizes = [3, *[WIDTH] * DEPTH, 1]
    weights = tuple(
        jnp.asarray(rng.normal(size=(m, n)) / np.sqrt(n), jnp.float32) for n, m in itertools.pairwise(sizes)
    )
    biases = tuple(jnp.zeros(m, jnp.float32) for m in sizes[1:])
    numbers = (jnp.zeros(3), *(jnp.asarray(x) for x in (5.0, 12.0, 14.0, 0.1)))
    return NeuralField(neural.Layers(weights, biases), jnp.asarray(12.0), RadialContinuation(*numbers), BETA)


def default_law(field):
    return profiles.default(
        field,
        Operation(CHASER, RelativeMotion(Orbit(6_778_137.0)), error_bound=0.0, disturbance_bound=0.015),
        [0.0, -10.0, -4.0],
        guidance=Straight(),
    )


def quantiles(seconds):
    micro = 1e6 * np.asarray(seconds)
    return {"median_us": float(np.median(micro)), "p99_us": float(np.quantile(micro, 0.99)), "steps": len(micro)}


def time_step(law, points, velocities):
    """Fly the law on board: numbers of the estimate in, the force out."""
    motion = RelativeMotion(Orbit(6_778_137.0))
    setup = FlightSetup(motion, NoDisturbance(), CHASER.thrusters, law, law.goal, CHASER.mass)
    on_board = OnBoard(setup, motion.initial_state(points[0], velocities[0]))
    seconds = []
    gc.collect()
    gc.disable()
    for k, (point, velocity) in enumerate(zip(points, velocities)):
        begin = time.perf_counter()
        on_board.step(float(k), point, velocity)
        seconds.append(time.perf_counter() - begin)
    gc.enable()
    return seconds


def time_programs(kind):
    """Microseconds a solve in a batch, the median of 20 batches."""
    error, circulation, box, speed = PROGRAMS[kind]
    rng = np.random.default_rng(0)
    normal = rng.normal(size=(BATCH, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)

    def single(desired, normal, other, rate):
        ring = Circulation(jnp.cross(normal, other), 0.1 - rate / 0.08, jnp.asarray(1.0))
        return VelocityProgram(
            desired=desired,
            normal=normal,
            barrier_rate=rate,
            gradient_error=jnp.asarray(0.2) if error else None,
            circulation=ring if circulation else None,
            box=jnp.asarray(0.1) if box else None,
            speed=jnp.asarray(0.1) if speed else None,
        )

    vectors = (jnp.asarray(x) for x in (0.1 * rng.normal(size=(BATCH, 3)), normal, rng.normal(size=(BATCH, 3))))
    programs = jax.vmap(single)(*vectors, jnp.asarray(0.08 * rng.uniform(0.0, 1.0, BATCH)))
    many = jax.jit(jax.vmap(lambda program: solve(program).velocity))
    jax.block_until_ready(many(programs))
    seconds = []
    for _ in range(20):
        begin = time.perf_counter()
        jax.block_until_ready(many(programs))
        seconds.append(time.perf_counter() - begin)
    return {"median_us_per_solve": 1e6 * float(np.median(seconds)) / BATCH, "batch": BATCH}


def usual_way(points, velocities):
    """Field and gradient by PyTorch autograd, the cone program by CVXPY with Clarabel, built once with parameters."""
    import cvxpy
    import torch

    torch.set_num_threads(1)
    torch.manual_seed(0)
    layers = [torch.nn.Linear(3, WIDTH), torch.nn.Softplus(BETA)]
    for _ in range(DEPTH - 1):
        layers += [torch.nn.Linear(WIDTH, WIDTH), torch.nn.Softplus(BETA)]
    net = torch.nn.Sequential(*layers, torch.nn.Linear(WIDTH, 1))
    v, sigma = cvxpy.Variable(3), cvxpy.Variable()
    desired, normal, tangent = (cvxpy.Parameter(3) for _ in range(3))
    rate, circulation = cvxpy.Parameter(), cvxpy.Parameter()
    constraints = [
        normal @ v + rate >= 0.01 * cvxpy.norm(v),
        tangent @ v - circulation >= sigma,
        v <= 0.1,
        v >= -0.1,
    ]
    program = cvxpy.Problem(cvxpy.Minimize(0.5 * cvxpy.sum_squares(desired - v) + sigma**2), constraints)
    omega = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    seconds = []
    for k, (point, velocity) in enumerate(zip(points, velocities)):
        begin = time.perf_counter()
        p = torch.tensor(point, dtype=torch.float32, requires_grad=True)
        value = net(p)[0] + float(np.linalg.norm(point)) - 2.0
        (gradient,) = torch.autograd.grad(value, p)
        desired.value = -0.1 * np.tanh((point - np.array([0.0, -10.0, -4.0])) / 1.5)
        normal.value = gradient.numpy().astype(float) + point / np.linalg.norm(point)
        tangent.value = omega @ normal.value
        distance = float(value.detach())
        rate.value, circulation.value = 0.08 * distance, 0.1 - distance
        program.solve(solver=cvxpy.CLARABEL)
        np.clip(-20.0 * 0.5 * (velocity - v.value), -0.1, 0.1)
        if k >= 5:
            seconds.append(time.perf_counter() - begin)
    return seconds


def main():
    parser = command(__doc__)
    parser.add_argument("--steps", type=int, default=2000)
    arguments = parser.parse_args()
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(arguments.steps, 3))
    points = direction / np.linalg.norm(direction, axis=1, keepdims=True) * rng.uniform(3.0, 9.0, (arguments.steps, 1))
    velocities = rng.normal(size=(arguments.steps, 3)) * 0.03
    rows = []
    sphere = SphereField(jnp.zeros(3), jnp.asarray(2.0))
    rows.append({"law": "default, analytic sphere", **quantiles(time_step(default_law(sphere), points, velocities))})
    law = default_law(sphere)
    neural = neural_field()
    law = eqx.tree_at(lambda c: c.velocity.field, law, neural)
    rows.append({"law": f"default, neural field {DEPTH} x {WIDTH}", **quantiles(time_step(law, points, velocities))})
    missing = [name for name in ("cvxpy", "torch") if importlib.util.find_spec(name) is None]
    if missing:
        rows.append({"law": "usual way", "left_out": f"not installed: {', '.join(missing)} (extra `bench`)"})
    else:
        usual = quantiles(usual_way(points[:205], velocities[:205]))
        usual["ratio_to_default"] = usual["median_us"] / rows[1]["median_us"]
        rows.append({"law": "usual way: CVXPY + Clarabel + PyTorch", **usual})
    rows += [{"law": f"velocity program: {kind}", **time_programs(kind)} for kind in PROGRAMS]
    result = {"machine": machine(), "jax": jax.__version__, "rows": rows}
    if arguments.json:
        print(json.dumps(result, indent=2))
        return
    for row in rows:
        figures = {k: round(v, 1) if isinstance(v, float) else v for k, v in row.items() if k != "law"}
        print(row["law"], figures)


if __name__ == "__main__":
    main()
