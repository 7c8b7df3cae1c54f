"""The audit's loops over all samples of all flights, compiled: each sample is read once, and other threads go on.

The arithmetic, its order and its rounding are those of the same formulas over whole arrays.
"""

from math import sqrt

import numpy as np

from keepout.core.kernel import kernel


@kernel(inline="always")
def _length(x, y, z):
    return sqrt(x * x + y * y + z * z)


@kernel()
def bound_steps(step, slack, turned, position, velocity, acceleration, disturbance, rate, kappa, offset, range_limit):
    """Give residual (m/s²), speed (m/s) and whether gravity may be unbounded, of each flight and step: `Tube.of`."""
    flights, steps = position.shape[0], len(step)
    residual, speed = np.empty((flights, steps)), np.empty((flights, steps))
    beyond = np.empty((flights, steps), np.bool_)
    for i in range(flights):
        for k in range(steps):
            away = _length(position[i, k, 0], position[i, k, 1], position[i, k, 2])
            start = _length(velocity[i, k, 0], velocity[i, k, 1], velocity[i, k, 2])
            thrust = _length(acceleration[i, k, 0], acceleration[i, k, 1], acceleration[i, k, 2])
            radius, unknown = away + offset, disturbance + turned[k] * thrust
            fastest = (start + step[k] * (thrust + unknown + kappa * radius)) / slack[k]
            speed[i, k] = fastest
            residual[i, k] = unknown + 2.0 * rate * fastest + kappa * (radius + fastest * step[k])
            beyond[i, k] = away + fastest * step[k] > range_limit
    return residual, speed, beyond


@kernel()
def excess_of_steps(step, position, velocity, acceleration, residual, excursion):
    """Give by how much (m) each step's end is beyond what its start and the bounds allow: `Tube.inconsistency`."""
    flights, steps = residual.shape
    excess = np.empty((flights, steps))
    for i in range(flights):
        for k in range(steps):
            forwards = backwards = kick = 0.0
            for axis in range(3):
                before, after = velocity[i, k, axis], velocity[i, k + 1, axis]
                held = acceleration[i, k, axis] * step[k]
                moved = position[i, k + 1, axis] - position[i, k, axis]
                ahead = moved - (before + 0.5 * held) * step[k]
                back = moved - (after - 0.5 * held) * step[k]
                change = after - before - held
                forwards += ahead * ahead
                backwards += back * back
                kick += change * change
            allowed = 0.5 * residual[i, k] * (step[k] * step[k]) + excursion
            kicked = (sqrt(kick) - residual[i, k] * step[k]) * step[k]
            excess[i, k] = max(max(sqrt(forwards), sqrt(backwards)) - allowed, kicked)
    return excess


@kernel()
def bound_blocks(time, position, speed, flight, first, length):
    """Put a ball about each block of `length` steps from a sample `first` on.

    Returns its centre (m), the sample nearest to it and its distance, that of the furthest (m), and how far (m) the
    path can be from the nearer sample of a step: half the step's travel.
    """
    blocks, last = len(first), position.shape[1] - 1
    centre, nearest = np.empty((blocks, 3)), np.empty(blocks, np.int64)
    least, most, excess = np.empty(blocks), np.empty(blocks), np.empty(blocks)
    for b in range(blocks):
        i, begin, end = flight[b], first[b], min(first[b] + length, last)
        for axis in range(3):
            low = high = position[i, begin, axis]
            for k in range(begin + 1, end + 1):
                low, high = min(low, position[i, k, axis]), max(high, position[i, k, axis])
            centre[b, axis] = 0.5 * (low + high)
        least[b], most[b], excess[b] = np.inf, 0.0, 0.0
        for k in range(begin, end + 1):
            away = _length(
                position[i, k, 0] - centre[b, 0], position[i, k, 1] - centre[b, 1], position[i, k, 2] - centre[b, 2]
            )
            if away < least[b]:
                least[b], nearest[b] = away, k
            most[b] = max(most[b], away)
        for k in range(begin, end):
            excess[b] = max(excess[b], 0.5 * (time[k + 1] - time[k]) * speed[i, k])
    return centre, nearest, least, most, excess
