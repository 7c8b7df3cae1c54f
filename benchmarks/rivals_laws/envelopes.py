"""CBFs on envelopes: the smallest ellipsoid (the paper's comparison), the smallest sphere and a small capsule.

Wang et al. 2025 keep a chaser out of an ellipsoid round the target; Shi et al. 2025 use capsules (both in the paper's
section I). Each envelope encloses every vertex, and is a field in closed form under the default law's own controller,
its gains and straight guidance: what differs from Keepout is the shape and the way to the goal, nothing else. The
field's error bound is zero, as the envelope holds the whole target. Its radius, margin and nominal offset are the
default law's. A start or goal in the envelope is refused: it holds every concave place. The slope of α at the
envelope, half the default law's, is the best of `choices`: it decides neither contacts nor arrivals, only the time.
"""

import dataclasses
from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from keepout.core.control.barrier_grid import require_free
from keepout.core.control.controller import Controller
from keepout.core.control.profiles import Operation
from keepout.core.fields.field import Field
from keepout.core.fields.own import SphereField
from keepout.flights.surface import smallest_ellipsoid
from rivals_laws.envelope_fields import CapsuleField, EllipsoidField
from rivals_laws.rival import Rival
from rivals_laws.rival_case import Point, RivalCase
from rivals_laws.round_bodies import small_capsule, smallest_ball


def ellipsoid_field(points: np.ndarray) -> EllipsoidField:
    """Give the distance to the smallest ellipsoid round points (n, 3) m."""
    found = smallest_ellipsoid(points, 1e-5)
    squares, axes = np.linalg.eigh(found.matrix)
    return EllipsoidField(*(jnp.asarray(part) for part in (found.centre, axes.T, 1.0 / np.sqrt(squares))))


def shape_to_keep_out_of(case: RivalCase, shape: str) -> tuple[Field, Operation]:
    """Give what a planner keeps out of, the learned `field` or the `ellipsoid`, and the operation with its error."""
    if shape == "ellipsoid":
        return ellipsoid_field(case.target.vertices), dataclasses.replace(case.operation, error_bound=0.0)
    return case.model.field, case.operation


def sphere_field(points: np.ndarray) -> SphereField:
    """Give the distance to the smallest ball round points (n, 3) m."""
    ball = smallest_ball(points)
    return SphereField(jnp.asarray(ball.centre), jnp.asarray(ball.radius))


def capsule_field(points: np.ndarray) -> CapsuleField:
    """Give the distance to a small capsule round points (n, 3) m."""
    found = small_capsule(points)
    return CapsuleField(jnp.asarray(found.start), jnp.asarray(found.end), jnp.asarray(found.radius))


def envelope_law(
    case: RivalCase, name: str, build: Callable[[np.ndarray], Field], rate: float | None = None
) -> Controller:
    """Give the default law round an envelope of a case's target, made once; `rate` in 1/s takes the place of its α₀."""

    def make() -> Controller:
        # A point cloud's balls or a mesh's triangles: the vertices' envelope is convex, so it holds the faces too.
        law = case.default_law_on(build(case.target.vertices), dataclasses.replace(case.operation, error_bound=0.0))
        return law if rate is None else eqx.tree_at(lambda law: law.velocity.class_k.rate, law, jnp.asarray(rate))

    return case.once((name, rate), make)


def refuse_inside(law: Controller, start: Point, goal: Point) -> None:
    """Refuse a pair with an end inside the envelope with its offset.

    Raises:
        KeepOutZoneError: it names the end.

    """
    for name, position in (("start", start), ("goal", goal)):
        require_free(law.velocity.field, float(law.velocity.offset), position, name)


@dataclasses.dataclass(frozen=True)
class Envelope(Rival):
    """The default law's controller with straight guidance round an envelope; `rate` is α₀, 1/s."""

    choices: ClassVar[dict[str, tuple[float, ...]]] = {"rate": (0.04, 0.08, 0.16)}
    build: ClassVar[Callable[[np.ndarray], Field]]
    rate: float = 0.04

    def law(self, case: RivalCase, start: Point, goal: Point) -> Controller:
        """Lead the law to its goal."""
        law = envelope_law(case, self.name, type(self).build, self.rate)
        refuse_inside(law, start, goal)
        return eqx.tree_at(lambda law: law.velocity.guidance.goal, law, jnp.asarray(goal))


@dataclasses.dataclass(frozen=True)
class EllipsoidCBF(Envelope):
    """The paper's comparison."""

    name = "ellipsoid CBF"
    build = staticmethod(ellipsoid_field)


@dataclasses.dataclass(frozen=True)
class SphereCBF(Envelope):
    """The simplest envelope."""

    name = "sphere CBF"
    build = staticmethod(sphere_field)


@dataclasses.dataclass(frozen=True)
class CapsuleCBF(Envelope):
    """A capsule."""

    name = "capsule CBF"
    build = staticmethod(capsule_field)


RIVALS = (EllipsoidCBF(), SphereCBF(), CapsuleCBF())
