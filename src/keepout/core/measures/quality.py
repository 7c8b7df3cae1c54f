"""How good a field is, measured: on the surface as the paper's Table I, off it, in curvature and in margin."""

import dataclasses

import numpy as np
from jaxtyping import Float

from keepout.core.fields.field import Field, values, values_and_gradients, values_gradients_hessians
from keepout.core.geometry.distance import ExactDistance, Points
from keepout.core.geometry.level_set import level_points, random_directions, surface_points
from keepout.core.geometry.offset_solid import OffsetSolid
from keepout.core.geometry.target import Target


@dataclasses.dataclass(frozen=True)
class SurfaceErrors:
    """f̃ on uniform surface points, metres (Zhou et al. Table I).

    Attributes:
        epsilon: mean |f̃|.
        epsilon_plus: mean of f̃ where positive; 0 where it is nowhere so.
        maximum: the largest f̃ sampled, which is no bound.
        count: number of points.

    """

    epsilon: float
    epsilon_plus: float
    maximum: float
    count: int


@dataclasses.dataclass(frozen=True)
class DistanceErrors:
    """f̃ - g against the exact signed distance g of the offset solid, metres, and ‖∇f̃‖ against 1, in one band of d.

    Attributes:
        mean_absolute: mean |f̃ - g|.
        root_mean_square: RMS of f̃ - g.
        over_999: 99.9th percentile of f̃ - g: over-statement.
        absolute_999: 99.9th percentile of |f̃ - g|.
        eikonal: mean |‖∇f̃‖ - 1|.

    """

    mean_absolute: float
    root_mean_square: float
    over_999: float
    absolute_999: float
    eikonal: float


@dataclasses.dataclass(frozen=True)
class Curvature:
    """‖∇²f̃‖ (spectral norm, 1/m) on the points where d equals `level` metres."""

    level: float
    median: float
    percentile_99: float
    maximum: float


def surface_errors(field: Field, target: Target, *, count: int = 100_000, seed: int = 0) -> SurfaceErrors:
    """Measure f̃ on points uniform over the surface."""
    return summarised(values(field, surface_points(target.distance, count, np.random.default_rng(seed))))


def summarised(value: Float[np.ndarray, "n"]) -> SurfaceErrors:
    """Summarise f̃ (n,), metres, on n > 0 points of the surface, where the exact distance is zero."""
    over = value[value > 0.0]
    mean_over = float(over.mean()) if len(over) else 0.0
    return SurfaceErrors(float(np.abs(value).mean()), mean_over, float(value.max()), len(value))


def distance_errors(
    field: Field, solid: OffsetSolid, *, nearest: float, farthest: float, count: int = 50_000, seed: int = 0
) -> DistanceErrors:
    """Measure f̃ - g on exterior points whose distance d from the surface is between `nearest` and `farthest` metres."""
    points, _, _ = exterior_band(solid, nearest, farthest, count, np.random.default_rng(seed))
    value, gradient = values_and_gradients(field, points)
    error = value - solid.signed_distance(points)
    return DistanceErrors(
        float(np.abs(error).mean()),
        float(np.sqrt((error**2).mean())),
        float(np.quantile(error, 0.999)),
        float(np.quantile(np.abs(error), 0.999)),
        float(np.abs(np.linalg.norm(gradient, axis=1) - 1.0).mean()),
    )


def exterior_band(
    solid: OffsetSolid, nearest: float, farthest: float, count: int, generator: np.random.Generator
) -> tuple[Points, Float[np.ndarray, "n"], Points]:
    """Return up to `count` exterior points (n, 3), metres, body axes, with d between the limits; d (n,); ∇d (n, 3)."""
    start = surface_points(solid.distance, count, generator)
    direction = random_directions(generator, count)
    points = start + generator.uniform(nearest, farthest, size=(count, 1)) * direction
    d, gradient = solid.distance.distance_and_gradient(points)
    chosen = (d >= nearest) & (d <= farthest) & solid.is_exterior(points)
    return points[chosen], d[chosen], gradient[chosen]


def curvature(field: Field, solid: OffsetSolid, level: float, *, count: int = 10_000, seed: int = 0) -> Curvature:
    """Measure the Hessian's norm on exterior points at distance `level` metres from the surface."""
    points = _exterior_level(solid, level, count, np.random.default_rng(seed))
    norm = np.abs(np.linalg.eigvalsh(values_gradients_hessians(field, points)[2])).max(axis=1)
    return Curvature(level, float(np.median(norm)), float(np.quantile(norm, 0.99)), float(norm.max()))


@dataclasses.dataclass(frozen=True)
class MarginCost:
    """Exact distance d, metres, from points of the level set {f̃ = level} outside to the true surface, less the radius.

    Attributes:
        mean: over the points.
        percentile_95: likewise.
        count: points that arrived on the level set.

    """

    mean: float
    percentile_95: float
    count: int


def margin_cost(
    field: Field,
    solid: OffsetSolid,
    *,
    error_bound: float,
    chaser_radius: float = 0.0,
    count: int = 20_000,
    seed: int = 0,
) -> MarginCost:
    """Measure how far outside the true contact surface the certified level f̃ = R + e_h lies.

    Exterior points near contact are moved onto the level by Newton steps along ∇f̃.
    """
    level = chaser_radius + error_bound
    start = chaser_radius + max(2.0 * solid.offset, 1.1 * solid.envelope)
    points = _exterior_level(solid, start, count, np.random.default_rng(seed))
    for _ in range(25):
        value, gradient = values_and_gradients(field, points)
        step = (level - value) / np.maximum((gradient**2).sum(axis=1), 0.25)
        points = points + np.clip(step, -0.2, 0.2)[:, None] * gradient
    arrived = np.abs(values(field, points) - level) < 1e-3
    excess = solid.distance.distance(points[arrived]) - chaser_radius
    return MarginCost(float(excess.mean()), float(np.quantile(excess, 0.95)), int(arrived.sum()))


def _exterior_level(solid: OffsetSolid, level: float, count: int, generator: np.random.Generator) -> Points:
    distance = solid.distance
    if not isinstance(distance, ExactDistance):
        raise TypeError("level sets are measured against a mesh")
    points = level_points(distance, level, 2 * count, generator, uniform=True)
    return points[solid.is_exterior(points)][:count]
