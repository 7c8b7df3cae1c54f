"""Values of splines and of learned fields in 64 bits of mantissa, written apart from the code."""

import numpy as np

from keepout.core.fields.continuation import RadialContinuation
from keepout.core.fields.grid import BLOCK, STORED, GridField
from keepout.core.fields.neural import NeuralField

long = np.longdouble


def into_domain(cont: RadialContinuation, places: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Give the places asked, and r and ψ(r) or twice the same where a place is within the domain."""
    away = places.astype(long) - np.asarray(cont.centre, long)
    r = np.sqrt((away * away).sum(axis=1))
    inner, outer = long(float(cont.domain_radius)), long(float(cont.outer_radius))
    t = np.clip((r - inner) / (outer - inner), 0, 1)
    psi = np.where(r > inner, inner + (outer - inner) * (t - t**3 + t**4 / 2), r)
    return np.asarray(cont.centre, long) + away * (psi / r)[:, None], r, psi


def continued(cont: RadialContinuation, value: np.ndarray, r: np.ndarray, psi: np.ndarray) -> np.ndarray:
    target, inner = long(float(cont.target_radius)), long(float(cont.domain_radius))
    out = r > inner
    # F is 0 over 0 for a place within the target's ball, where it is not asked.
    (far, near) = (np.where(out, s, 2 * target) for s in (r, psi))
    risen = [np.sqrt(s * s - target**2) - target * np.arccos(target / s) for s in (far, near)]
    t = np.clip((r - target) / (inner - target), 0, 1)
    return value + (risen[0] - risen[1]) - long(float(cont.allowance)) * t**3 * (10 - 15 * t + 6 * t * t)


def spline(field: GridField, places: np.ndarray) -> np.ndarray:
    inside, r, psi = into_domain(field.continuation, places)
    blocks = np.asarray(field.coefficients).reshape(-1, STORED, STORED, STORED)
    u = (inside - np.asarray(field.origin, long)) / long(float(field.spacing))
    values = np.zeros(len(places), long)
    for row, place in enumerate(u):
        for level, table in enumerate(np.asarray(table) for table in field.tables):
            scaled = place / 2**level
            block = np.clip(np.floor(scaled / BLOCK).astype(int), 0, np.array(table.shape) - 1)
            if table[tuple(block)] >= 0:
                break
        local = scaled - BLOCK * block
        x, y, z = cell = np.clip(np.floor(local).astype(int), 0, BLOCK - 1)
        s = np.abs(np.arange(-1, 3) - (local - cell)[:, None])
        weights = np.where(s < 1, (4 - 6 * s**2 + 3 * s**3) / 6, np.clip(2 - s, 0, None) ** 3 / 6)
        some = blocks[table[tuple(block)], x : x + 4, y : y + 4, z : z + 4].astype(long)
        values[row] = (some * weights[0][:, None, None] * weights[1][:, None] * weights[2]).sum()
    return continued(field.continuation, values, r, psi)


def network(field: NeuralField, places: np.ndarray) -> np.ndarray:
    inside, r, psi = into_domain(field.continuation, places)
    a = (inside - np.asarray(field.continuation.centre, long)) / long(float(field.scale))
    *hidden, last = zip(field.layers.weights, field.layers.biases, strict=True)
    for weights, biases in hidden:
        z = field.beta * (a @ np.asarray(weights, long).T + np.asarray(biases, long))
        a = (np.maximum(z, 0) + np.log1p(np.exp(-np.abs(z)))) / field.beta
    value = a @ np.asarray(last[0], long)[0] + np.asarray(last[1], long)[0]
    return continued(field.continuation, value * long(float(field.scale)), r, psi)
