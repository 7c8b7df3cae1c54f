"""CBF-QP of the acceleration with `cbfpy` (Morton & Pavone 2025): exponential barrier, relaxed, solved by `qpax`.

The barrier h = f̃ − e_h − radius − margin has relative degree 2; `cbfpy` forms ψ = ḣ + α₂(h) and asks ψ̇ ≥ −α(ψ)
(Ames et al. 2017, 2019; Nguyen & Sreenath 2016), with the nominal acceleration that tracks straight guidance. A second
barrier v_max² − ‖v‖² (relative degree 1) keeps the speed limit.

Tuning. Both slopes are p, a critically damped barrier. An approach along ψ = 0 has the speed p h at h and needs the
deceleration p² h: from v_max that is p v_max, within the authority for p ≤ 4 mm/s² / 0.1 m/s = 0.04/s. Around the
ellipsoid all `choices` do alike and p is 0.04/s; on the field 0.01/s does best, and p is that. A reading, not tested:
where the nearest surface changes, the barrier falls faster than any thrust can answer, whatever p, and the program is
relaxed.

`cbfpy`'s default `solver_tol` of 1e-3 is an absolute residual: as an acceleration in m/s² it is a quarter of what the
thrusters have. Here the control is in units of the authority and the barrier's rows are divided by it, so that all
numbers of the program are near one, and the tolerance is 1e-6. The Lie derivatives differentiate the barrier twice, so
fields hand out their own gradient and Hessian. The penalties on relaxation are `cbfpy`'s defaults.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from keepout.core.control.guidance import StraightGuidance
from keepout.core.fields.field import Field
from keepout.core.motion.relative import MotionState
from rivals_laws.envelopes import ellipsoid_field, envelope_law, refuse_inside
from rivals_laws.observed import ObservedLaw, Plant, tracking
from rivals_laws.rival import Rival
from rivals_laws.rival_case import Point, RivalCase

Vector = Float[Array, "3"]


def twice_differentiable(field: Field):
    """Give the field's value as a function of one point, whose derivatives are the field's own gradient and Hessian."""

    @jax.custom_jvp
    def gradient(point):
        return field.value_and_gradient(point)[1]

    @gradient.defjvp
    def _(primals, tangents):
        _, slope, hessian = field.value_gradient_hessian(*primals)
        return slope, hessian @ tangents[0]

    @jax.custom_jvp
    def value(point):
        return field.value(point)

    @value.defjvp
    def _(primals, tangents):
        return value(*primals), gradient(*primals) @ tangents[0]

    return value


def safety_filter(field: Field, offset: float, speed_limit: float, authority: float, rate: float, tolerance: float):
    """Make `cbfpy`'s filter of a control in units of the authority: state (r, v) in m and m/s, control (3,)."""
    from cbfpy import CBF, CBFConfig

    distance = twice_differentiable(field)

    class KeepOut(CBFConfig):
        def __init__(self):
            super().__init__(n=6, m=3, u_min=-jnp.ones(3), u_max=jnp.ones(3), solver_tol=tolerance)

        def f(self, z):
            return jnp.concatenate([z[3:], jnp.zeros(3)])

        def g(self, z):
            return jnp.concatenate([jnp.zeros((3, 3)), authority * jnp.eye(3)])

        def h_1(self, z):
            return (jnp.array([speed_limit**2]) - jnp.sum(z[3:] ** 2)) / (2.0 * speed_limit * authority)

        def h_2(self, z):
            return (distance(z[:3])[None] - offset) / authority

        def alpha(self, h):
            # The barrier's row comes after the speed's; the speed's may close at the tracking gain.
            return h * jnp.array([0.5, rate])[: h.shape[0]]

        def alpha_2(self, h_2):
            return rate * h_2

    return CBF.from_config(KeepOut())


class BarrierProgram(ObservedLaw):
    """Straight guidance, tracked, and filtered by a CBF-QP."""

    plant: Plant
    guidance: StraightGuidance
    filter: object = eqx.field(static=True)

    @property
    def goal(self) -> Vector:
        """Where the guidance leads, m."""
        return self.guidance.goal

    def acceleration(self, own: PyTree, estimate: MotionState) -> tuple[PyTree, Vector]:
        """Filter the nominal acceleration, m/s²."""
        wanted = self.guidance.desired_velocity(estimate.position)
        nominal = tracking(self.plant, wanted, estimate.velocity)
        state = jnp.concatenate([estimate.position, estimate.velocity])
        authority = self.plant.authority
        return own, authority * self.filter.safety_filter(state, nominal / authority)


@dataclasses.dataclass(frozen=True)
class BarrierOnField(Rival):
    """CBF-QP on Keepout's learned distance."""

    name = "CBF-QP on Keepout's field"
    packages = ("cbfpy",)
    choices = {"rate": (0.005, 0.01, 0.02, 0.03, 0.04)}  # noqa: RUF012
    rate: float = 0.01
    solver_tolerance: float = 1e-6

    def _made(self, case: RivalCase, field: Field, offset: float) -> BarrierProgram:
        plant, leader = Plant.of(case), case.default_law.velocity.guidance
        numbers = (float(plant.speed_limit), float(plant.authority), self.rate, self.solver_tolerance)
        make = lambda: BarrierProgram(plant, leader, safety_filter(field, offset, *numbers))  # noqa: E731
        return case.once(self.settings, make)

    def prototype(self, case: RivalCase, start: Point, goal: Point) -> BarrierProgram:
        """Give the law of the case, with another goal."""
        return self._made(case, case.model.field, case.offset)

    def law(self, case: RivalCase, start: Point, goal: Point) -> BarrierProgram:
        """Lead the law to its goal."""
        return eqx.tree_at(lambda law: law.guidance.goal, self.prototype(case, start, goal), jnp.asarray(goal))


@dataclasses.dataclass(frozen=True)
class BarrierOnEllipsoid(BarrierOnField):
    """CBF-QP on the smallest ellipsoid."""

    name = "CBF-QP on the ellipsoid"
    rate: float = 0.04

    def prototype(self, case: RivalCase, start: Point, goal: Point) -> BarrierProgram:
        """Give the law of the case; a pair with an end in the envelope is refused."""
        around = envelope_law(case, "ellipsoid CBF", ellipsoid_field)
        refuse_inside(around, start, goal)
        return self._made(case, around.velocity.field, case.operation.chaser.radius + case.operation.margin)


RIVALS = (BarrierOnEllipsoid(), BarrierOnField())
