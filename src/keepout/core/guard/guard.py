"""The guard: the hard layer that accepts or replaces any commanded force, so that a free way to rest remains.

The theorem, its assumptions and its proof are in docs/guard.md. At every control step the guard asks what the command
leads to: one step under it, then the nominal braking motion to rest. If the field stays above its threshold over the
tube around that motion, the command is passed on and the motion is kept as the plan; if not, the plan of an earlier
step, which is still there to be followed, is followed. The field is the guard's own and need not be the control
law's.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from keepout.core.compiled.in_batches import where_needed
from keepout.core.errors import ControlError, require_finite
from keepout.core.fields.field import Field
from keepout.core.guard import braking, observer, watch
from keepout.core.guard.braking import BrakingDesign, GuardAssumptions, Number, design
from keepout.core.guard.safety_layer import GuardFlag, GuardStatus, SafetyLayer
from keepout.core.motion.arrays import Flag, Scalar, Vector, norm
from keepout.core.motion.relative import MotionState

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
        begun: whether a step was made.
        left_out: whether the state told at the last step was left out, as nothing explained it.
        contradicted: whether what the guard flies by (a map) was proved wrong. It is set from outside; while it is, no
            command is passed on.
        observed: memory of the guard's observer; None where the estimate has no errors.

    """

    plan_position: Vector
    plan_velocity: Vector
    certified: Flag
    pending: Float[Array, "delay 3"]
    expected_position: Vector
    expected_velocity: Vector
    unexplained: Float[Array, "windows 3"]
    counted: Int[Array, ""]
    begun: Flag
    left_out: Flag
    contradicted: Flag
    observed: observer.ObserverState | None = None


class Seen(eqx.Module):
    """What the guard goes by at a step: x̂, and how far it can be trusted (docs/guard.md, section 2).

    Attributes:
        told: whether a state was told that is gone by.
        told_position: y, or what was expected where none was told, m.
        told_velocity: likewise, m/s.
        position: x̂, m.
        velocity: likewise, m/s.
        spread: how far (m, m/s) y and the guard's own expectation are from x̂; 0 where they explain each other.
        sound: whether a candidate may rest on it: told, errors within the caps, nothing contradicted.
        narrow: whether the errors are within the caps.
        jumped: whether y, or a window of them, is beyond what the assumptions explain.
        left_out: whether a state was told and left out.
        contradicted: whether what is told, or flown by, contradicts itself.
        unexplained: for the next step's memory, as are the next two.
        counted: likewise.
        doubts: likewise.

    """

    told: Flag
    told_position: Vector
    told_velocity: Vector
    position: Vector
    velocity: Vector
    spread: Float[Array, "2"]
    sound: Flag
    narrow: Flag
    jumped: Flag
    left_out: Flag
    contradicted: Flag
    unexplained: Float[Array, "windows 3"]
    counted: Int[Array, ""]
    doubts: watch.Doubts | None


class Course(eqx.Module):
    """Where the commands under way lead from x̂, and how far that is from the plan.

    Attributes:
        path: predicted positions, now and after each command under way, m.
        velocities: likewise, m/s.
        drifted: position after them, less the plan's, m.
        off_plan: whether that is further than the theorem allows.
        planned: whether there is a certified plan to follow by what is told.

    """

    path: Float[Array, "points 3"]
    velocities: Float[Array, "points 3"]
    drifted: Vector
    off_plan: Flag
    planned: Flag


class Motion(eqx.Module):
    """An acceleration commanded, m/s², and the nominal state that it leads to a step later, m and m/s."""

    acceleration: Vector
    position: Vector
    velocity: Vector


class Guard(SafetyLayer):
    """Accepts or replaces commanded forces; see docs/guard.md for what it proves.

    Attributes:
        field: a lower bound on clearance in the sense of its certificate.
        threshold: e_h + chaser radius, m: no contact while field > threshold along the path.
        lipschitz: gradient bound L of a function that is within `evaluation_error` of the field everywhere.
        assumptions: what the theorem assumes of the flight.
        evaluation_error: see `lipschitz`, m; 0 for a field in closed form.
        braking: the braking law that follows from the assumptions.
        windows: lengths in steps over which `watch` watches, which follow from the assumptions too.
        parts: into which the stop segment is cut, where its ends alone do not decide; with the start and the steps of
            delay at most 20 field values a step, and only one of them far from the target.

    Raises:
        ControlError: a number out of range, or thrusters too weak for the assumptions.

    """

    field: Field
    threshold: float = eqx.field(static=True)
    lipschitz: float = eqx.field(static=True)
    assumptions: GuardAssumptions
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
        evaluation_error: float = 0.0,
    ) -> None:
        for name, value in (("threshold", threshold), ("lipschitz", lipschitz)):
            require_finite(value, f"guard: {name} is {value}", ControlError, positive=True)
        require_finite(evaluation_error, f"guard: evaluation_error is {evaluation_error} m", ControlError)
        self.field, self.threshold, self.lipschitz, self.assumptions = field, threshold, lipschitz, assumptions
        self.evaluation_error = evaluation_error
        self.parts = min(15, 18 - assumptions.delay)
        self.braking = design(assumptions)
        self.windows = watch.windows(assumptions)

    @property
    def delay(self) -> int:
        """Control steps between a command and its effect."""
        return self.assumptions.delay

    @property
    def least_value(self) -> Number:
        """Field value, in metres, below which no plan is ever certified: threshold plus the tube's radius.

        With f* the function within j = `evaluation_error` of the field f̃ whose gradient is at most L: contact needs
        f* ≤ threshold + j, and f̃ at a point says no more than f* ≥ f̃ - j there; so 2j is added once, whatever follows
        from f* by L.
        """
        return self.threshold + self.lipschitz * self.braking.position_radius + 2.0 * self.evaluation_error

    def initial_state(self, estimate: MotionState, under_way: Float[Array, "delay 3"] | None = None) -> GuardState:
        """Give the memory before the first step: the plan is to brake at once, certified if that is free.

        Args:
            estimate: of the motion.
            under_way: forces commanded that have not taken effect, N, body axes, the oldest first; none if left out.

        """
        self = self._at_time(estimate.time)
        pending = self._accelerations(under_way)
        path, velocities = braking.predict(self.assumptions, estimate.position, estimate.velocity, pending)
        unexplained, counted = watch.begin(self.windows)
        no = jnp.asarray(False)
        return GuardState(
            plan_position=path[-1],
            plan_velocity=velocities[-1],
            certified=self._braking_free(estimate, pending, jnp.zeros(()), 0.0),
            pending=pending,
            expected_position=estimate.position,
            expected_velocity=estimate.velocity,
            unexplained=unexplained,
            counted=counted,
            begun=no,
            left_out=no,
            contradicted=no,
            observed=None
            if self.braking.observer is None
            else observer.begin(estimate, self.assumptions, self.windows),
        )

    def begun_with(self, estimate: MotionState, under_way: Float[Array, "steps 3"]) -> GuardState:
        """Give the memory before the first step of a flight that has commands under way, N, body axes."""
        return self.initial_state(estimate, under_way[-self.assumptions.delay :] if self.assumptions.delay else None)

    def filter(
        self,
        guard_state: GuardState,
        estimate: MotionState,
        force: Vector,
        disturbance_estimate: Vector,
        errors: Float[Array, "2"] | None = None,
        contradicted: Flag | None = None,
    ) -> tuple[GuardState, Vector, Int[Array, ""]]:
        """Accept or replace a commanded force (N, body axes); the status is a `GuardStatus` plus `GuardFlag` bits.

        A command that is not finite is replaced; an estimate that is not finite leaves the plan to be followed blind.
        With `errors` (m, m/s) above those declared, or not finite, and where what is told is `contradicted`, no command
        is passed on. A state that the guard's own estimate cannot explain carries a command only if that is safe from
        both. The parts, in this order, are those of docs/guard.md, section 2.
        """
        self = self._at_time(estimate.time)
        a = self.assumptions
        errors = observer.caps(a) if errors is None else errors
        contradicted = jnp.asarray(False) if contradicted is None else contradicted
        seen = self._see(guard_state, estimate, errors, contradicted)
        here = self.field.value(seen.position)
        course = self._predict(guard_state, seen)
        finite = jnp.all(jnp.isfinite(force))
        candidate = self._candidate(force, finite, seen, course)
        accepted = self._accept(candidate, (finite | ~course.planned) & seen.sound, here, seen, course)
        plan, followed, rest = self._follow(guard_state, seen, course)
        follow = (course.planned | (guard_state.certified & ~seen.told)) & ~accepted
        chosen = jnp.where(follow, followed, candidate.acceleration)
        new = self._remember(guard_state, seen, follow, accepted, chosen, plan, candidate)
        done = jnp.where(
            accepted & course.planned,
            GuardStatus.CLEAR,
            jnp.where(follow, jnp.where(rest, GuardStatus.HOLDING, GuardStatus.BRAKING), GuardStatus.ESCAPING),
        )
        raised = {
            GuardFlag.STATE_JUMP: seen.jumped,
            GuardFlag.DISTURBANCE: watch.too_strong(a, disturbance_estimate),
            GuardFlag.FIELD: ~(here > self._seen_threshold),
            GuardFlag.REGION: watch.outside_region(a, seen.told_position, seen.told_velocity),
            GuardFlag.COMMAND: ~finite,
            GuardFlag.OFF_PLAN: course.off_plan & guard_state.certified,
            GuardFlag.ESTIMATE: ~(seen.told | seen.left_out),
            GuardFlag.WIDE: ~seen.narrow,
            GuardFlag.CONTRADICTED: seen.contradicted,
            GuardFlag.EXPIRED: estimate.time > a.valid_until,
        }
        flags = sum(jnp.where(yes, flag, 0) for flag, yes in raised.items())
        return new, a.mass * chosen, (done + flags).astype(jnp.int32)

    def _see(self, state: GuardState, estimate: MotionState, errors: Float[Array, "2"], contradicted: Flag) -> Seen:
        """Take what is told: x̂ of it, whether it is explained, and whether a candidate may rest on it."""
        a, observed = self.assumptions, state.observed
        own = state if observed is None else observed
        finite = jnp.all(jnp.isfinite(estimate.position)) & jnp.all(jnp.isfinite(estimate.velocity))
        position = jnp.where(finite, estimate.position, state.expected_position)
        velocity = jnp.where(finite, estimate.velocity, state.expected_velocity)
        known = jnp.where(finite, jnp.where(jnp.isnan(errors), jnp.inf, errors), jnp.inf)
        doubts = None if observed is None else watch.next_doubts(self.windows, state.counted, observed.doubts, known)

        # Is it explained, by the step before and by the steps of each window?
        moved = position - state.expected_position, velocity - state.expected_velocity
        both = None if observed is None or doubts is None else (observed.doubts, doubts)
        unexplained, counted, jumped = watch.watch(a, self.windows, state.unexplained, state.counted, *moved, both)
        beyond = jumped & finite
        if observed is not None and self.braking.observer is not None:
            off = position - own.expected_position, velocity - own.expected_velocity
            beyond = observer.beyond(a, self.braking.observer, *off, known)
            # After steps without a sound estimate the guard's own one is no evidence of a jump.
            jumped = jumped | (beyond & (observed.steady | state.left_out))

        # One state that nothing explains, and by which the plan could not be followed, is left out.
        lost = self._off_plan(state, own.expected_position, own.expected_velocity)
        strays = self._off_plan(state, position, velocity)
        left_out = beyond & state.begun & state.certified & strays & ~lost & ~state.left_out
        told = finite & ~left_out
        position = jnp.where(left_out, state.expected_position, position)
        velocity = jnp.where(left_out, state.expected_velocity, velocity)

        # x̂ of what is gone by.
        seen = position, velocity
        if observed is not None:
            known, first = jnp.where(told, known, jnp.inf), ~state.begun & ~beyond
            seen = observer.correct(a, self.braking, observed, position, velocity, known, first, beyond)
        apart = jnp.stack(
            [
                jnp.maximum(norm(seen[0] - position), norm(seen[0] - own.expected_position)),
                jnp.maximum(norm(seen[1] - velocity), norm(seen[1] - own.expected_velocity)),
            ]
        )
        narrow, wrong = jnp.all(errors <= observer.caps(a)), state.contradicted | contradicted
        return Seen(
            told=told,
            told_position=position,
            told_velocity=velocity,
            position=seen[0],
            velocity=seen[1],
            spread=jnp.where((jumped | beyond) & told, apart, 0.0),
            sound=told & ~wrong & narrow,
            narrow=narrow,
            jumped=jumped,
            left_out=left_out,
            contradicted=wrong,
            unexplained=unexplained,
            # What was told before and after a state left out is not compared.
            counted=jnp.where(left_out, 0, counted),
            doubts=doubts,
        )

    def _predict(self, state: GuardState, seen: Seen) -> Course:
        """Follow the commands under way from x̂, and say whether the plan can still be followed from there."""
        path, velocities = braking.predict(self.assumptions, seen.position, seen.velocity, state.pending)
        drifted = path[-1] - state.plan_position
        off_plan = jnp.linalg.norm(drifted) > self._plan_radius
        return Course(path, velocities, drifted, off_plan, state.certified & ~off_plan & seen.told)

    def _off_plan(self, state: GuardState, position: Vector, velocity: Vector) -> Flag:
        path, _ = braking.predict(self.assumptions, position, velocity, state.pending)
        return jnp.linalg.norm(path[-1] - state.plan_position) > self._plan_radius

    def _candidate(self, force: Vector, finite: Flag, seen: Seen, course: Course) -> Motion:
        """Give the command, cut to the box, or without a plan the way out; and where it leads."""
        a, T = self.assumptions, self.assumptions.period
        ahead, moving = course.path[-1], course.velocities[-1]
        asked = jnp.clip(jnp.where(finite, force, 0.0), -a.force_limit, a.force_limit) / a.mass
        outward = self._outward(seen.position, ~course.planned)
        way_out = braking.escape(a, self.braking, seen.position, moving, outward)
        candidate = jnp.where(course.planned, asked, way_out)
        return Motion(candidate, ahead + T * moving + 0.5 * T**2 * candidate, moving + T * candidate)

    def _accept(self, candidate: Motion, usable: Flag, here: Scalar, seen: Seen, course: Course) -> Flag:
        """Whether the candidate leaves a free plan, from x̂ and from all that is as far from it as `seen.spread`."""
        away, faster = seen.spread
        moved = away + faster * self._lever(norm(candidate.velocity) + faster, self.assumptions.delay + 1)
        path = jnp.concatenate([course.path[1:], candidate.position[None]])
        velocities = jnp.concatenate([course.velocities, candidate.velocity[None]])
        return usable & self._free(seen.position, here, path, velocities, usable, moved, faster)

    def _follow(self, state: GuardState, seen: Seen, course: Course) -> tuple[Motion, Vector, Flag]:
        """Give the plan's next state, the acceleration that follows it, m/s², and whether it is at rest."""
        a, T = self.assumptions, self.assumptions.period
        brake, rest = braking.brake(a, self.braking, state.plan_velocity)
        feedback = self.braking.position_gain * course.drifted + self.braking.velocity_gain * (
            course.velocities[-1] - state.plan_velocity
        )
        followed = jnp.clip(brake - jnp.where(seen.told, feedback, 0.0), -a.authority, a.authority)
        position = state.plan_position + T * state.plan_velocity + 0.5 * T**2 * brake
        return Motion(brake, position, state.plan_velocity + T * brake), followed, rest

    def _remember(
        self,
        state: GuardState,
        seen: Seen,
        follow: Flag,
        accepted: Flag,
        chosen: Vector,
        plan: Motion,
        candidate: Motion,
    ) -> GuardState:
        """Give the memory for the next step: the plan that is followed, or that of the candidate."""
        a, T = self.assumptions, self.assumptions.period
        acting = state.pending[0] if a.delay else chosen
        observed = state.observed
        if observed is not None and seen.doubts is not None:
            good = seen.told & seen.narrow
            steady = good & (accepted | (follow & observed.steady))
            observed = observer.advance(a, seen.position, seen.velocity, acting, steady, seen.doubts)
        return GuardState(
            plan_position=jnp.where(follow, plan.position, candidate.position),
            plan_velocity=jnp.where(follow, plan.velocity, candidate.velocity),
            certified=accepted | follow,
            pending=jnp.concatenate([state.pending, chosen[None]])[1:],
            expected_position=seen.told_position + T * seen.told_velocity + 0.5 * T**2 * acting,
            expected_velocity=seen.told_velocity + T * acting,
            unexplained=seen.unexplained,
            counted=seen.counted,
            begun=jnp.asarray(True),
            left_out=seen.left_out,
            contradicted=state.contradicted,
            observed=observed,
        )

    def _at_time(self, time: Scalar) -> "Guard":
        """Give the guard with its field as it is from a time (s) on: nowhere lower than before, so that plans last."""
        field = self.field.at_time(time)
        return self if field is self.field else eqx.tree_at(lambda guard: guard.field, self, field)

    def _lever(self, speed: Scalar, steps: int) -> Scalar:
        """Time, s, by which an error of the velocity moves the end of `steps` periods and the braking from `speed`."""
        return steps * self.assumptions.period + speed / self.braking.deceleration + 0.5 * self.assumptions.period

    def _accelerations(self, under_way: Float[Array, "delay 3"] | None) -> Float[Array, "delay 3"]:
        """Give the accelerations of the forces under way, m/s²."""
        shape = self.assumptions.delay, 3
        if under_way is None:
            return jnp.zeros(shape)
        if jnp.shape(under_way) != shape:
            raise ControlError(
                f"guard: under_way has the shape {jnp.shape(under_way)}; by the delay it must be {shape}"
            )
        return jnp.asarray(under_way) / self.assumptions.mass

    def certified(self, estimate: MotionState) -> Flag:
        """Whether braking at once from this estimate is certified free: then a guarded flight can start from it."""
        return self._braking_free(estimate, self._accelerations(None), jnp.zeros(()), 0.0)

    def certified_start(self, truth: MotionState) -> Flag:
        """Whether a true state is `certified` by every estimate of it that the assumed errors allow.

        Sufficient, not necessary: an estimate moves each point of the braking path by at most δ (docs/guard.md, section
        4), so the true path is asked for L δ more of the field, δ more of the range, ε_v more of the speed limit.
        """
        a = self.assumptions
        longer = self._lever(jnp.linalg.norm(truth.velocity) + a.velocity_error, a.delay)
        # What the field's joints lose between two values is as much as some way more.
        joints = 2.0 * self.evaluation_error / self.lipschitz
        moved = a.position_error + longer * a.velocity_error + joints + _ROUNDING
        return self._braking_free(truth, self._accelerations(None), moved, a.velocity_error)

    def _braking_free(
        self, state: MotionState, pending: Float[Array, "delay 3"], moved: Scalar, faster: Number
    ) -> Flag:
        self = self._at_time(state.time)
        path, velocities = braking.predict(self.assumptions, state.position, state.velocity, pending)
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

    def _free(
        self,
        position: Vector,
        value: Scalar,
        points: Float[Array, "points 3"],
        velocities: Float[Array, "states 3"],
        wanted: Flag,
        moved: float | Scalar = 0.0,
        faster: Number = 0.0,
    ) -> Flag:
        """Whether the tube around a path and the nominal braking from its end is free, within range and slow enough.

        The path leads from `position`, where the field is `value`, over `points`; `velocities` are the nominal ones
        from now to its end. A step under a constant force is within its sagitta T² √3 A/8 of its chord; ρ is added
        around everything. Where it is not `wanted`, the answer may be a mere no. With `moved` (m) and `faster` (m/s)
        the answer holds for a path whose points are that far off, and its velocities too.

        Three tests, each for what the one before leaves open: `_free_from_here`, `_free_at_corners`, `_free_along`.
        """
        # An answer of yes or no has no derivative, and what leads to it needs none.
        self, position, value, points, velocities, moved, faster = jax.lax.stop_gradient(
            (self, position, value, points, velocities, moved, faster)
        )
        a = self.assumptions
        rest = points[-1] + braking.stop(a, self.braking, velocities[-1])
        corners = jnp.concatenate([points, rest[None]])
        sagitta = 3.0**0.5 * a.authority * a.period**2 / 8.0
        least = jnp.asarray(self.least_value + self.lipschitz * (sagitta + moved))
        kept = self._within_limits(
            position, corners, velocities, sagitta + self.braking.position_radius + moved, faster
        )
        far = self._free_from_here(position, value, corners, least)
        no = jnp.asarray(False)
        path_free, stop_free, values = self._asked(
            self._free_at_corners, wanted & kept & ~far, (no, no, jnp.zeros(2)), position, value, corners, least
        )
        open_ = path_free & ~stop_free & jnp.all(values > least)
        stop_free = stop_free | self._asked(self._free_along, open_, no, corners[-2:], values, least)
        return kept & (far | (path_free & stop_free))

    def _within_limits(
        self,
        position: Vector,
        corners: Float[Array, "corners 3"],
        velocities: Float[Array, "states 3"],
        around: Number,
        faster: Number,
    ) -> Flag:
        """Whether a polyline from `position`, and what is `around` it (m), keeps within V̄ and R̄."""
        a = self.assumptions
        # Norms are convex, so that a polyline's largest is a corner's.
        range_ = jnp.maximum(jnp.max(jnp.linalg.norm(corners, axis=-1)), jnp.linalg.norm(position))
        # Until the path's end the commands under way may leave a speed above the limit that its end keeps.
        fastest = jnp.max(jnp.linalg.norm(velocities, axis=-1)) + self.braking.velocity_radius + faster
        return (fastest <= a.speed_limit) & (range_ + around <= a.range_limit)

    def _free_from_here(
        self, position: Vector, value: Scalar, corners: Float[Array, "corners 3"], least: Scalar
    ) -> Flag:
        """Test 1, from the field's value here alone: no point of the path is further away than its furthest corner."""
        return value - self.lipschitz * jnp.max(jnp.linalg.norm(corners - position, axis=-1)) > least

    def _free_at_corners(
        self, field: Field, position: Vector, value: Scalar, corners: Float[Array, "corners 3"], least: Scalar
    ) -> tuple[Flag, Flag, Float[Array, "2"]]:
        """Test 2, from the corners' values: of the path until its end, of the stop segment; and its ends' values."""
        values = jnp.concatenate([value[None], field.value(corners)])
        lowest = self._lowest(jnp.concatenate([position[None], corners]), values)
        proved = lowest > least
        return jnp.all(proved[:-1]), proved[-1], values[-2:]

    def _free_along(self, field: Field, ends: Float[Array, "2 3"], values: Float[Array, "2"], least: Scalar) -> Flag:
        """Test 3, from points along the stop segment."""
        points = ends[0] + jnp.linspace(0.0, 1.0, self.parts + 1)[:, None] * (ends[1] - ends[0])
        inside = field.value(points[1:-1])
        return jnp.all(self._lowest(points, jnp.concatenate([values[:1], inside, values[1:]])) > least)

    def _lowest(self, points: Float[Array, "points 3"], values: Float[Array, "points"]) -> Float[Array, "segments"]:
        """Lower bound of the field on each segment of a polyline: between two points Δ apart, (f₁ + f₂ − L Δ)/2."""
        length = jnp.linalg.norm(jnp.diff(points, axis=0), axis=-1)
        return 0.5 * (values[:-1] + values[1:] - self.lipschitz * length)

    def _outward(self, position: Vector, wanted: Flag) -> Vector:
        """Give the field's gradient where it is wanted, else zero."""
        return self._asked(lambda field, place: field.value_and_gradient(place)[1], wanted, jnp.zeros(3), position)

    def _asked(self, question: Callable[..., Any], wanted: Flag, otherwise: PyTree, *arguments: Array) -> Any:
        """Give what `question` finds of the field where it is wanted, else `otherwise`.

        The field's arrays and the arguments are handed on, not closed over: in a batch they may differ from flight to
        flight.
        """
        arrays, still = eqx.partition(self.field, eqx.is_array)

        def asked(arrays: Field, *given: Array) -> Any:
            return question(eqx.combine(arrays, still), *given)

        return where_needed(asked, wanted, otherwise, arrays, *arguments)
