"""The guard: the hard layer that accepts or replaces any commanded force, so that a free way to rest remains.

The theorem, its assumptions and its proof are in docs/guard.md. At every control step the guard asks what the command
leads to: one step under it, then the nominal braking motion to rest. If the field stays above its threshold over the
tube around that motion, the command is passed on and the motion is kept as the plan; if not, the plan of an earlier
step, which is still there to be followed, is followed. The field is the guard's own and need not be the control
law's.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from keepout.compiled.on_demand import where_needed
from keepout.errors import ControlError
from keepout.fields.field import Field
from keepout.guard import nominal, observer, watch
from keepout.guard.braking import BrakingDesign, GuardAssumptions, Number, design
from keepout.guard.nominal import Vector
from keepout.guard.safety_layer import SafetyLayer
from keepout.guard.status import GuardFlag, GuardStatus
from keepout.motion.relative import MotionState

_ROUNDING = 1e-9
"""Metres: far more than float64 loses between two evaluations of the same field value."""


class GuardState(eqx.Module):
    """The guard's memory: its plan, and what it expects to be told next.

    Positions are in m, velocities in m/s, body axes.

    Attributes:
        plan_position: of the nominal braking motion when the next command takes effect.
        plan_velocity: likewise.
        certified: whether that motion's tube is known to be free.
        pending: commanded accelerations not yet in effect, m/s², the oldest first.
        expected_position: of the next estimate, were there no disturbance.
        expected_velocity: likewise.
        unexplained: the sums of velocity that `watch` keeps, one a window, m/s.
        counted: the steps that `watch` has counted.
        observed: memory of the guard's observer; None where the estimate has no errors.

    """

    plan_position: Vector
    plan_velocity: Vector
    certified: Bool[Array, ""]
    pending: Float[Array, "delay 3"]
    expected_position: Vector
    expected_velocity: Vector
    unexplained: Float[Array, "windows 3"]
    counted: Int[Array, ""]
    observed: observer.ObserverState | None = None


class Guard(SafetyLayer):
    """Accepts or replaces commanded forces; see docs/guard.md for what it proves.

    Attributes:
        field: a lower bound on clearance in the sense of its certificate.
        threshold: e_h + chaser radius, m: no contact while field > threshold along the path.
        lipschitz: gradient bound L of a function that is within `evaluation_error` of the field everywhere.
        assumptions: what the theorem assumes of the flight.
        samples: parts into which the stop segment is cut, where its ends alone do not decide; with the start and the
            steps of delay at most 20 field values a step, and only one of them far from the target. Unset: 15, or what
            the delay leaves of them.
        escape_speed: of the way out of the margin, m/s.
        evaluation_error: see `lipschitz`, m; 0 for a field in closed form.
        braking: the braking law that follows from the assumptions.
        windows: lengths in steps over which `watch` watches, which follow from the assumptions too.
        parts: `samples`, as used.

    Raises:
        ControlError: a number out of range, more than 20 field values, or thrusters too weak for the assumptions.

    """

    field: Field
    threshold: float = eqx.field(static=True)
    lipschitz: float = eqx.field(static=True)
    assumptions: GuardAssumptions
    samples: int | None = eqx.field(static=True)
    escape_speed: float = eqx.field(static=True)
    evaluation_error: float = eqx.field(static=True)
    braking: BrakingDesign
    windows: tuple[int, ...] = eqx.field(static=True)
    parts: int = eqx.field(static=True)

    def __init__(
        self,
        field: Field,
        threshold: float,
        lipschitz: float,
        assumptions: GuardAssumptions,
        samples: int | None = None,
        escape_speed: float = 0.02,
        evaluation_error: float = 0.0,
    ) -> None:
        for name, value in (("threshold", threshold), ("lipschitz", lipschitz), ("escape_speed", escape_speed)):
            if not (math.isfinite(value) and value > 0.0):
                raise ControlError(f"guard: {name} is {value}; it must be finite and greater than 0")
        if not (math.isfinite(evaluation_error) and evaluation_error >= 0.0):
            raise ControlError(f"guard: evaluation_error is {evaluation_error} m; it must be finite and at least 0")
        most = 18 - assumptions.delay
        parts = min(15, most) if samples is None else samples
        if not 1 <= parts <= most:
            raise ControlError(
                f"guard: samples is {samples}; with a delay of {assumptions.delay} steps it must be from 1 to {most}"
            )
        self.field, self.threshold, self.lipschitz, self.assumptions = field, threshold, lipschitz, assumptions
        self.samples, self.escape_speed, self.evaluation_error = samples, escape_speed, evaluation_error
        self.parts = parts
        self.braking = design(assumptions)
        self.windows = watch.windows(assumptions)

    @property
    def least_value(self) -> Number:
        """Field value, in metres, below which no plan is ever certified: threshold plus the tube's radius.

        With f* the function within j = `evaluation_error` of the field f̃ whose gradient is at most L: contact needs
        f* ≤ threshold + j, and f̃ at a point says no more than f* ≥ f̃ - j there; so 2j is added once, whatever follows
        from f* by L.
        """
        return self.threshold + self.lipschitz * self.braking.position_radius + 2.0 * self.evaluation_error

    def initial_state(self, estimate: MotionState) -> GuardState:
        """Give the memory before the first step: the plan is to brake at once, certified if that is free."""
        pending = jnp.zeros((self.assumptions.delay, 3))
        path, velocities = nominal.predict(self.assumptions, estimate.position, estimate.velocity, pending)
        unexplained, counted = watch.begin(self.windows)
        return GuardState(
            plan_position=path[-1],
            plan_velocity=velocities[-1],
            certified=self.certified(estimate),
            pending=pending,
            expected_position=estimate.position,
            expected_velocity=estimate.velocity,
            unexplained=unexplained,
            counted=counted,
            observed=None
            if self.braking.observer is None
            else observer.begin(estimate, self.assumptions, self.windows),
        )

    def filter(
        self,
        guard_state: GuardState,
        estimate: MotionState,
        force: Vector,
        disturbance_estimate: Vector,
        errors: Float[Array, "2"] | None = None,
    ) -> tuple[GuardState, Vector, Int[Array, ""]]:
        """Accept or replace a commanded force (N, body axes); the status is a `GuardStatus` plus `GuardFlag` bits.

        A command that is not finite is replaced; an estimate that is not finite leaves the plan to be followed blind.
        With `errors` (m, m/s) above those declared, or not finite, no command is passed on.
        """
        a, T = self.assumptions, self.assumptions.period
        told = jnp.all(jnp.isfinite(estimate.position)) & jnp.all(jnp.isfinite(estimate.velocity))
        told_position = jnp.where(told, estimate.position, guard_state.expected_position)
        told_velocity = jnp.where(told, estimate.velocity, guard_state.expected_velocity)
        narrow = None if errors is None else jnp.all(errors <= observer.caps(a))
        position, velocity, doubts = told_position, told_velocity, None
        if guard_state.observed is not None:
            known = observer.caps(a) if errors is None else jnp.where(jnp.isnan(errors), jnp.inf, errors)
            known = jnp.where(told, known, jnp.inf)
            before = guard_state.observed.doubts
            doubts = before, watch.next_doubts(self.windows, guard_state.counted, before, known)
            position, velocity = observer.correct(
                a, self.braking, guard_state.observed, told_position, told_velocity, known
            )
        path, velocities = nominal.predict(a, position, velocity, guard_state.pending)
        ahead, moving = path[-1], velocities[-1]
        here = self.field.value(position)

        drifted = ahead - guard_state.plan_position
        off_plan = jnp.linalg.norm(drifted) > self._plan_radius
        planned = guard_state.certified & ~off_plan & told
        finite = jnp.all(jnp.isfinite(force))
        asked = jnp.clip(jnp.where(finite, force, 0.0), -a.force_limit, a.force_limit) / a.mass
        candidate = jnp.where(
            planned,
            asked,
            nominal.escape(a, self.braking, self.escape_speed, position, moving, self._outward(position, ~planned)),
        )
        next_position = ahead + T * moving + 0.5 * T**2 * candidate
        next_velocity = moving + T * candidate
        usable = (finite | ~planned) & told
        if narrow is not None:
            usable = usable & narrow
        ahead_path = jnp.concatenate([path[1:], next_position[None]])
        velocities = jnp.concatenate([velocities, next_velocity[None]])
        accepted = usable & self._free(position, here, ahead_path, velocities, usable)

        brake, rest = nominal.brake(a, self.braking, guard_state.plan_velocity)
        feedback = self.braking.position_gain * drifted + self.braking.velocity_gain * (
            moving - guard_state.plan_velocity
        )
        followed = brake - jnp.where(told, feedback, 0.0)
        follow = (planned | (guard_state.certified & ~told)) & ~accepted
        chosen = jnp.where(follow, jnp.clip(followed, -a.authority, a.authority), candidate)
        unexplained, counted, jumped = watch.watch(
            a,
            self.windows,
            guard_state.unexplained,
            guard_state.counted,
            told_position - guard_state.expected_position,
            told_velocity - guard_state.expected_velocity,
            doubts,
        )
        in_effect, certified = self._in_effect(guard_state, chosen), accepted | follow
        new = GuardState(
            plan_position=jnp.where(
                follow, guard_state.plan_position + T * guard_state.plan_velocity + 0.5 * T**2 * brake, next_position
            ),
            plan_velocity=jnp.where(follow, guard_state.plan_velocity + T * brake, next_velocity),
            certified=certified,
            pending=jnp.concatenate([guard_state.pending, chosen[None]])[1:],
            expected_position=told_position + T * told_velocity + 0.5 * T**2 * in_effect,
            expected_velocity=told_velocity + T * in_effect,
            unexplained=unexplained,
            counted=counted,
            observed=None
            if guard_state.observed is None or doubts is None
            else observer.advance(
                a,
                position,
                velocity,
                in_effect,
                told & (True if narrow is None else narrow) & (accepted | (follow & guard_state.observed.steady)),
                doubts[1],
            ),
        )
        done = jnp.where(
            accepted & planned,
            GuardStatus.CLEAR,
            jnp.where(follow, jnp.where(rest, GuardStatus.HOLDING, GuardStatus.BRAKING), GuardStatus.ESCAPING),
        )
        flags = (
            jnp.where(jumped, GuardFlag.STATE_JUMP, 0)
            + jnp.where(watch.too_strong(a, disturbance_estimate), GuardFlag.DISTURBANCE, 0)
            + jnp.where(here > self._seen_threshold, 0, GuardFlag.FIELD)
            + jnp.where(watch.outside_region(a, told_position, told_velocity), GuardFlag.REGION, 0)
            + jnp.where(finite, 0, GuardFlag.COMMAND)
            + jnp.where(off_plan, GuardFlag.OFF_PLAN, 0)
            + jnp.where(told, 0, GuardFlag.ESTIMATE)
            + (0 if narrow is None else jnp.where(narrow, 0, GuardFlag.WIDE))
        )
        return new, a.mass * chosen, (done + flags).astype(jnp.int32)

    def certified(self, estimate: MotionState) -> Bool[Array, ""]:
        """Whether braking at once from this estimate is certified free: then a guarded flight can start from it."""
        return self._braking_free(estimate, jnp.zeros(()), 0.0)

    def certified_start(self, truth: MotionState) -> Bool[Array, ""]:
        """Whether a true state is `certified` by every estimate of it that the assumed errors allow.

        Sufficient, not necessary: an estimate moves each point of the braking path by at most δ (docs/guard.md, section
        4), so the true path is asked for L δ more of the field, δ more of the range, ε_v more of the speed limit.
        """
        a = self.assumptions
        fastest = jnp.linalg.norm(truth.velocity) + a.velocity_error
        longer = a.delay * a.period + fastest / self.braking.deceleration + 0.5 * a.period
        # What the field's joints lose between two values is as much as some way more.
        joints = 2.0 * self.evaluation_error / self.lipschitz
        moved = a.position_error + longer * a.velocity_error + joints + _ROUNDING
        return self._braking_free(truth, moved, a.velocity_error)

    def _braking_free(self, state: MotionState, moved: Float[Array, ""], faster: Number) -> Bool[Array, ""]:
        pending = jnp.zeros((self.assumptions.delay, 3))
        path, velocities = nominal.predict(self.assumptions, state.position, state.velocity, pending)
        value = self.field.value(state.position)
        points = path[1:] if self.assumptions.delay else path
        return self._free(state.position, value, points, velocities, jnp.asarray(True), moved, faster)

    @property
    def _seen_threshold(self) -> Number:
        """Above which the field is at x̂ as long as it is above the threshold at the true position, m."""
        gain = self.braking.observer
        return self.threshold if gain is None else self.threshold - self.lipschitz * gain.error_radius

    @property
    def _plan_radius(self) -> Number:
        """How far the predicted position can be from the plan while the assumptions hold, m."""
        if self.braking.observer is not None:
            return self.braking.observer.plan_radius
        late = self.assumptions.delay * self.assumptions.period
        unseen = self.assumptions.disturbance + self.assumptions.fault_push
        return self.braking.position_radius + 0.5 * unseen * late**2

    def _in_effect(self, guard_state: GuardState, chosen: Vector) -> Vector:
        return guard_state.pending[0] if self.assumptions.delay else chosen

    def _free(
        self,
        position: Vector,
        value: Float[Array, ""],
        points: Float[Array, "points 3"],
        velocities: Float[Array, "states 3"],
        wanted: Bool[Array, ""],
        moved: float | Float[Array, ""] = 0.0,
        faster: Number = 0.0,
    ) -> Bool[Array, ""]:
        """Whether the tube around a path and the nominal braking from its end is free, within range and slow enough.

        The path leads from `position`, where the field is `value`, over `points`; `velocities` are the nominal ones
        from now to its end. A step under a constant force is within its sagitta T² √3 A/8 of its chord; ρ is added
        around everything. Where it is not `wanted`, the answer may be a mere no. With `moved` (m) and `faster` (m/s)
        the answer holds for a path whose points are that far off, and its velocities too.

        Three tests, each for what the one before leaves open: from `value` alone, as no point is further away than the
        path's furthest corner; from the corners' values; from points along the stop segment.
        """
        # An answer of yes or no has no derivative, and what leads to it needs none.
        self, position, value, points, velocities, moved, faster = jax.lax.stop_gradient(
            (self, position, value, points, velocities, moved, faster)
        )
        a = self.assumptions
        rest = points[-1] + nominal.stop(a, self.braking, velocities[-1])
        corners = jnp.concatenate([points, rest[None]])
        sagitta = 3.0**0.5 * a.authority * a.period**2 / 8.0
        least = jnp.asarray(self.least_value + self.lipschitz * (sagitta + moved))
        # Both norms are convex, so that a polyline's largest is a corner's.
        furthest = jnp.max(jnp.linalg.norm(corners - position, axis=-1))
        range_ = jnp.maximum(jnp.max(jnp.linalg.norm(corners, axis=-1)), jnp.linalg.norm(position))
        # Until the path's end the commands under way may leave a speed above the limit that its end keeps.
        fastest = jnp.max(jnp.linalg.norm(velocities, axis=-1)) + self.braking.velocity_radius + faster
        within = range_ + sagitta + self.braking.position_radius + moved <= a.range_limit
        kept = (fastest <= a.speed_limit) & within
        far = value - self.lipschitz * furthest > least
        arrays, still = eqx.partition(self.field, eqx.is_array)

        # `least` is handed on, not closed over: in a batch it differs from flight to flight where `moved` does.
        def at_corners(
            arrays: Field,
            position: Vector,
            value: Float[Array, ""],
            corners: Float[Array, "corners 3"],
            least: Float[Array, ""],
        ):
            field = eqx.combine(arrays, still)
            values = jnp.concatenate([value[None], field.value(corners)])
            lowest = self._lowest(jnp.concatenate([position[None], corners]), values)
            proved = lowest > least
            return jnp.all(proved[:-1]), proved[-1], values[-2:]

        def along(
            arrays: Field, ends: Float[Array, "2 3"], values: Float[Array, "2"], least: Float[Array, ""]
        ) -> Bool[Array, ""]:
            field = eqx.combine(arrays, still)
            points = ends[0] + jnp.linspace(0.0, 1.0, self.parts + 1)[:, None] * (ends[1] - ends[0])
            inside = field.value(points[1:-1])
            return jnp.all(self._lowest(points, jnp.concatenate([values[:1], inside, values[1:]])) > least)

        no = jnp.asarray(False)
        path_free, stop_free, values = where_needed(
            at_corners, wanted & kept & ~far, (no, no, jnp.zeros(2)), arrays, position, value, corners, least
        )
        open_ = path_free & ~stop_free & jnp.all(values > least)
        stop_free = stop_free | where_needed(along, open_, no, arrays, corners[-2:], values, least)
        return kept & (far | (path_free & stop_free))

    def _lowest(self, points: Float[Array, "points 3"], values: Float[Array, "points"]) -> Float[Array, "segments"]:
        """Lower bound of the field on each segment of a polyline: between two points Δ apart, (f₁ + f₂ − L Δ)/2."""
        length = jnp.linalg.norm(jnp.diff(points, axis=0), axis=-1)
        return 0.5 * (values[:-1] + values[1:] - self.lipschitz * length)

    def _outward(self, position: Vector, wanted: Bool[Array, ""]) -> Vector:
        """Give the field's gradient where it is wanted, else zero."""
        arrays, still = eqx.partition(self.field, eqx.is_array)

        def gradient(arrays: Field, position: Vector) -> Vector:
            return eqx.combine(arrays, still).value_and_gradient(position)[1]

        return where_needed(gradient, wanted, jnp.zeros(3), arrays, position)
