"""The steepest places of a field, by search that shares nothing with the proofs of a bound: samples, then ascent."""

import numpy as np

from keepout.core.fields.field import values, values_and_gradients


def steepest(field, points, *, kept=300, rounds=(0.3, 0.1, 0.03, 0.01, 0.003, 0.001), seed=0):
    """Largest ‖∇f̃‖ from these points on, and the place (3,) where it was found."""
    generator = np.random.default_rng(seed)
    slope = np.linalg.norm(values_and_gradients(field, points)[1], axis=1)
    for step in rounds:
        best = np.argsort(-slope)[:kept]
        points, slope = points[best], slope[best]
        moved = (points[:, None, :] + step * generator.normal(size=(len(points), 12, 3))).reshape(-1, 3)
        points = np.concatenate([points, moved])
        slope = np.concatenate([slope, np.linalg.norm(values_and_gradients(field, moved)[1], axis=1)])
    return float(slope.max()), points[slope.argmax()]


def steepest_chord(field, first, second, error):
    """Largest (|f̃(p) - f̃(q)| - 2 error)/‖p - q‖ over pairs of points."""
    away = np.linalg.norm(first - second, axis=1)
    return float(((np.abs(values(field, first) - values(field, second)) - 2.0 * error) / away).max())


def places(field, distance, count, generator):
    """Points near the surface, in the domain, on its edge and beyond it, a quarter each."""
    continuation = field.continuation
    centre, target, domain, outer = (
        np.asarray(getattr(continuation, name)) for name in ("centre", "target_radius", "domain_radius", "outer_radius")
    )
    share = count // 4
    direction = generator.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    corners = distance.vertices[distance.faces[generator.integers(len(distance.faces), size=share)]]
    weights = generator.dirichlet([0.5, 0.5, 0.5], size=share)
    near = np.einsum("nk,nkc->nc", weights, corners) + generator.exponential(0.3, (share, 1)) * direction[:share]
    radius = np.concatenate(
        [
            domain * generator.uniform(size=share) ** (1 / 3),
            generator.uniform(target, outer, size=share),
            outer * generator.uniform(0.8, 4.0, size=count - 3 * share),
        ]
    )
    return np.concatenate([near, centre + radius[:, None] * direction[share:]])
