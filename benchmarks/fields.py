"""Speed of value, gradient and Hessian: against sgemm, `jax.hessian` and `torch.func`, and for a single point.

The field is part of the compiled program, as it is on board, and compiled with `keepout.core.compiled.xla.WIDE`.

Run: python benchmarks/fields.py (pin it to one core, with taskset or the like, for figures per core). The ratio to
`torch.func` needs PyTorch (extra `bench`) and is left out without it.
"""

import importlib.util
import itertools
import time

import jax
import jax.numpy as jnp
import numpy as np

from keepout.core.compiled.xla import WIDE
from keepout.core.fields import neural
from keepout.core.fields.continuation import RadialContinuation
from keepout.core.fields.neural import NeuralField

BATCH, REPEATS = 1000, 7


def median_seconds(function):
    jax.block_until_ready(function())
    seconds = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        jax.block_until_ready(function())
        seconds.append(time.perf_counter() - start)
    return float(np.median(seconds))


def make(width, depth):
    rng = np.random.default_rng(0)
    sizes = [3] + [width] * depth + [1]
    weights = tuple(
        jnp.asarray(rng.normal(size=(o, i)) * np.sqrt(2 / i), jnp.float32) for i, o in itertools.pairwise(sizes)
    )
    biases = tuple(jnp.zeros(o, jnp.float32) for o in sizes[1:])
    lengths = (jnp.asarray(length) for length in (10.0, 12.5, 15.0, 0.0))
    continuation = RadialContinuation(jnp.zeros(3), *lengths)
    return NeuralField(neural.Layers(weights, biases), jnp.asarray(14.0), continuation, 100.0)


def sgemm_rate() -> float:
    """Return the flops a second of a float32 product of 1024 × 1024 matrices."""
    a = np.random.default_rng(0).normal(size=(1024, 1024)).astype(np.float32)
    return 2 * 1024**3 / median_seconds(lambda: a @ a)


def paired(function, reference, repeats=15):
    """Median seconds of a function, and the median ratio to a reference timed right beside it each time."""
    jax.block_until_ready((function(), reference()))
    seconds, ratios = [], []
    for _ in range(repeats):
        one = time.perf_counter()
        jax.block_until_ready(function())
        two = time.perf_counter()
        jax.block_until_ready(reference())
        seconds.append(two - one)
        ratios.append((time.perf_counter() - two) / (two - one))
    return float(np.median(seconds)), float(np.median(ratios))


def with_torch(field, points):
    """Value, gradient and Hessian of the same network by torch.func, or None where PyTorch is not installed."""
    if importlib.util.find_spec("torch") is None:
        return None
    import torch
    from torch.func import grad_and_value, hessian, vmap

    torch.set_num_threads(1)
    layers = [
        tuple(torch.tensor(np.asarray(a)) for a in pair) for pair in zip(field.layers.weights, field.layers.biases)
    ]

    def value(x):
        for W, b in layers[:-1]:
            x = torch.nn.functional.softplus(W @ x + b, beta=field.beta, threshold=1e9)
        return (layers[-1][0] @ x + layers[-1][1])[0]

    x = torch.tensor(np.asarray(points, np.float32)) / float(field.scale)
    first, second = vmap(grad_and_value(value)), vmap(hessian(value))

    def run():
        first(x)
        second(x)
        return 0

    return run


def main():
    a = np.random.default_rng(0).normal(size=(1024, 1024)).astype(np.float32)
    print(f"sgemm 1024: {sgemm_rate() / 1e9:.0f} Gflop/s; it is timed anew beside every repeat below")
    points = jax.random.normal(jax.random.key(0), (BATCH, 3)) * 4.0
    point = jnp.array(points[0])
    for width, depth in ((96, 4), (128, 4), (512, 10)):
        field = make(width, depth)
        ours = jax.jit(lambda p, f=field: f.value_gradient_hessian(p), compiler_options=WIDE)
        seconds, ratio = paired(lambda ours=ours: ours(points), lambda: a @ a)
        flops = 2 * BATCH * ((depth - 1) * width**2 * 5 + width * (3 * 2 + 1) + 7 * width * depth)
        share = ratio * flops / (2 * 1024**3)
        line = f"{depth} x {width}: {1e6 * seconds / BATCH:7.2f} us a point, {share:5.1%} of sgemm"
        if width < 512:
            nested = jax.jit(jax.vmap(lambda p, f=field: (*jax.value_and_grad(f.value)(p), jax.hessian(f.value)(p))))
            times = paired(lambda ours=ours: ours(points), lambda nested=nested: nested(points))[1]
            line += f", {times:.1f} times as fast as jax.hessian"
            other = with_torch(field, points)
            if other is not None:
                line += f", {paired(lambda ours=ours: ours(points), other)[1]:.1f} times as fast as torch.func"
        single = np.median([median_seconds(lambda ours=ours: ours(point)) for _ in range(50)])
        print(f"{line}; single point {1e6 * single:.0f} us", flush=True)


if __name__ == "__main__":
    main()
