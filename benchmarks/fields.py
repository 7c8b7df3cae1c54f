"""Speed of value, gradient and Hessian: against this machine's own sgemm rate, `jax.hessian`, and for a single point.

Run: python benchmarks/fields.py (pin it to one core, with taskset or the like, for figures per core).
"""

import itertools
import time

import jax
import jax.numpy as jnp
import numpy as np

from keepout.fields import mlp
from keepout.fields.continuation import RadialContinuation
from keepout.fields.neural import NeuralField

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
    return NeuralField(mlp.Layers(weights, biases), jnp.asarray(14.0), continuation, 100.0)


def sgemm_rate() -> float:
    """Return the flops a second of a float32 product of 1024 × 1024 matrices."""
    a = np.random.default_rng(0).normal(size=(1024, 1024)).astype(np.float32)
    return 2 * 1024**3 / median_seconds(lambda: a @ a)


def main():
    rate = sgemm_rate()
    print(f"sgemm 1024: {rate / 1e9:.1f} Gflop/s")
    points = jax.random.normal(jax.random.key(0), (BATCH, 3)) * 4.0
    for width, depth in ((96, 4), (128, 4), (512, 10)):
        field = make(width, depth)
        ours = jax.jit(lambda p, f=field: f.value_gradient_hessian(p))
        seconds = median_seconds(lambda ours=ours: ours(points))
        flops = 2 * BATCH * ((depth - 1) * width**2 * 5 + width * (3 * 2 + 1) + 7 * width * depth)
        line = f"{depth} x {width}: {1e6 * seconds / BATCH:7.2f} us a point, {flops / seconds / rate:5.1%} of sgemm"
        if width < 512:
            nested = jax.jit(jax.vmap(lambda p, f=field: (*jax.value_and_grad(f.value)(p), jax.hessian(f.value)(p))))
            slow = median_seconds(lambda nested=nested: nested(points))
            line += f", {slow / seconds:.1f} times as fast as jax.hessian"
        single = median_seconds(lambda ours=ours: [ours(points[0]) for _ in range(100)]) / 100
        print(f"{line}; single point {1e6 * single:.0f} us")


if __name__ == "__main__":
    main()
