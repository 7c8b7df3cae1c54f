"""Motion of the chaser relative to the target, in the target's turning body frame, exact in the point-mass field."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from keepout.core.compiled.kept_executables import kept_jit
from keepout.core.errors import ScenarioError
from keepout.core.motion import rotation
from keepout.core.motion.arrays import NumbersLike, Scalar, T, Vector, as_float64
from keepout.core.motion.attitude import AttitudeMotion, VVLHFixed
from keepout.core.motion.chaser import Departure, Pulses
from keepout.core.motion.disturbance import Disturbance, NoDisturbance
from keepout.core.motion.orbit import Orbit, OrbitalFrame, Perturbation, perturbed_frame, target_acceleration
from keepout.core.motion.rotation import Quaternion, vvlh_axes


class MotionState(eqx.Module):
    """Where the chaser is and how the target turns, at one moment.

    Attributes:
        time: s since the orbit's epoch.
        position: of the chaser in the body frame, m.
        velocity: of the chaser relative to the target, as seen by one who turns with the body, m/s.
        attitude: unit quaternion body ← VVLH, scalar first.
        angular_velocity: the body's inertial angular velocity, rad/s, in body axes.
        target_orbit: the target's ECI position (m) and velocity (m/s), carried only where perturbations bend its orbit.
        disturbance: only in an estimate by a filter that models it: the mean force that nobody commanded over the
            period that begins, N, body axes. The true motion carries none.

    """

    time: Scalar
    position: Vector
    velocity: Vector
    attitude: Quaternion
    angular_velocity: Vector
    target_orbit: Float[Array, "6"] | None = None
    disturbance: Vector | None = None

    def moved(self, position: Vector, velocity: Vector) -> "MotionState":
        """Give the state with its position (m) and its velocity (m/s) changed by these.

        Args:
            position: (3,) m, body frame, to be added.
            velocity: (3,) m/s, body frame, to be added.

        """
        changed = self.position + position, self.velocity + velocity
        return eqx.tree_at(lambda s: (s.position, s.velocity), self, changed)


Pushed = tuple[MotionState, Vector | None]
"""A state, and the force (N, body axes) that is held in inertial axes, where one is."""


class RelativeMotion(eqx.Module):
    """The relative dynamics (paper, section II, with the sign of g corrected).

        r̈ = −2 ω×ṙ − ω̇×r − ω×(ω×r) − g + (F + d)/m,    g = μ (r_S/‖r_S‖³ − r_T/‖r_T‖³)

    There r is measured from the target's centre of mass, which is at `centre_of_mass` (m, body axes) in the body frame;
    `MotionState.position` is measured from the frame's origin. `substeps` Runge–Kutta steps are taken for each control
    step; one a second is enough below 0.5 °/s of tumbling. A force is held in the body frame's axes; with
    `held_inertially` it keeps the direction that it has at the step's beginning in inertial ones, so that Ḟ = −ω×F.
    """

    orbit: Orbit
    attitude_motion: AttitudeMotion = eqx.field(default_factory=VVLHFixed)
    perturbations: tuple[Perturbation, ...] = ()
    substeps: int = eqx.field(static=True, default=1)
    centre_of_mass: Vector = eqx.field(converter=as_float64, default=(0.0, 0.0, 0.0))
    held_inertially: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        if self.substeps < 1:
            raise ScenarioError(f"substeps: {self.substeps}; it must be at least 1")

    def initial_state(self, position: NumbersLike, velocity: NumbersLike, time: float | Scalar = 0.0) -> MotionState:
        """Give the state at `time` (s) of a chaser at a body-frame position (3,) m and velocity (3,) m/s.

        The attitude and the tumbling rate given at construction are those at this time.
        """
        return _initial_state(self, *map(as_float64, (position, velocity, time)))

    def drift_acceleration(self, state: MotionState) -> Vector:
        """Acceleration in body axes without force and disturbance, m/s²."""
        frame = self.orbital_frame(state)
        omega, omega_dot = self.attitude_motion.rates(state.attitude, state.angular_velocity, frame)
        return self._drift(state, frame, omega, omega_dot)

    def orbital_frame(self, state: MotionState) -> OrbitalFrame:
        """Give the VVLH frame at the state's time: radius and rates, in VVLH axes."""
        return self._frame(state.time, state.target_orbit)

    def step(
        self,
        state: MotionState,
        force: Vector,
        disturbance: Disturbance,
        duration: float | Scalar,
        mass: float | Scalar,
        pulses: Pulses | None = None,
    ) -> MotionState:
        """Advance by `duration` seconds: classical Runge–Kutta, the force (N, body axes) held, the disturbance not.

        Where the force is the mean of `pulses` over these seconds, what they add between is added in closed form.

        The disturbance is evaluated at the times of the Runge–Kutta stages. At its jumps the steps are split, and a
        piece sees the force of its own middle: a force that is constant between jumps acts with its full strength.

        Raises:
            ScenarioError: pulses, and forces are held inertially.

        """
        if self.held_inertially and pulses is not None:
            raise ScenarioError("pulses: their forces turn with the target; they cannot be held in inertial axes")
        h = duration / self.substeps
        departure = None if pulses is None else self._departure(state, pulses, mass)

        def substep(pushed: Pushed) -> Pushed:
            at = pushed[0]
            switches = disturbance.switches(at.time, h)
            if switches.size == 0:
                return self._runge_kutta(pushed, force, disturbance, h, mass, state.time, departure)

            def piece(now: Pushed, ends: Float[Array, "2"]) -> tuple[Pushed, None]:
                smooth = disturbance.between_switches(at.time + 0.5 * (ends[0] + ends[1]))
                return self._runge_kutta(now, force, smooth, ends[1] - ends[0], mass, state.time, departure), None

            ends = jnp.concatenate([jnp.zeros(1), switches, jnp.full(1, h)])
            end, _ = jax.lax.scan(piece, pushed, jnp.stack([ends[:-1], ends[1:]], axis=1))
            return eqx.tree_at(lambda pushed: pushed[0].time, end, at.time + h)

        begun = (state, as_float64(force) if self.held_inertially else None)
        if self.substeps == 1:
            end, _ = substep(begun)
        else:
            end, _ = jax.lax.fori_loop(0, self.substeps, lambda _, at: substep(at), begun)
        if departure is None:
            return end
        position, velocity, _ = departure.at(jnp.asarray(duration, jnp.float64))
        return end.moved(position, velocity)

    def of_target(self, look: Callable[[MotionState], T], start: MotionState, period: float | Scalar, steps: int) -> T:
        """Give what `look` sees of a state's target at the start and after each of some steps of `period` s.

        The chaser is put back to where it was: its own way is nobody's concern here.
        """

        def advance(state: MotionState, _: None) -> tuple[MotionState, T]:
            after = self.step(state, jnp.zeros(3), NoDisturbance(), period, 1.0)
            held = eqx.tree_at(lambda s: (s.position, s.velocity), after, (state.position, state.velocity))
            return held, look(state)

        return jax.lax.scan(advance, start, length=steps + 1)[1]

    def _departure(self, state: MotionState, pulses: Pulses, mass: float | Scalar) -> Departure:
        frame = self.orbital_frame(state)
        omega, omega_dot = self.attitude_motion.rates(state.attitude, state.angular_velocity, frame)
        return Departure(pulses, jnp.asarray(mass, jnp.float64), omega, omega_dot)

    def _runge_kutta(
        self,
        start: Pushed,
        force: Vector,
        disturbance: Disturbance,
        h: float | Scalar,
        mass: float | Scalar,
        since: Scalar,
        departure: Departure | None,
    ) -> Pushed:
        """Take one step of `h` seconds under a disturbance without jumps; a departure began at `since`."""

        def derivative(now: Pushed) -> Pushed:
            at, held = now
            frame = self.orbital_frame(at)
            omega, omega_dot = self.attitude_motion.rates(at.attitude, at.angular_velocity, frame)
            push = ((force if held is None else held) + disturbance.force(at.time)) / mass
            there = at
            if departure is not None:
                position, velocity, counted = departure.at(at.time - since)
                push = push - counted
                there = at.moved(position, velocity)
            relative_rate = omega - rotation.matrix(at.attitude) @ frame.angular_velocity
            change = MotionState(
                time=jnp.ones(()),
                position=at.velocity,
                velocity=self._drift(there, frame, omega, omega_dot) + push,
                attitude=rotation.rate(at.attitude, relative_rate),
                angular_velocity=omega_dot,
                target_orbit=None if at.target_orbit is None else self._target_derivative(at.target_orbit),
            )
            return change, None if held is None else -jnp.cross(omega, held)

        # As a loop, the stages compile in half the time that they take written out, and run as fast.
        def stage(slopes: tuple[Pushed, Pushed], weights: Float[Array, "2"]) -> Any:
            last, total = slopes
            slope = derivative(_advance(start, last, weights[0] * h))
            return (slope, _advance(total, slope, weights[1])), None

        rest = jax.tree.map(jnp.zeros_like, start)
        stages = jnp.array([[0.0, 1 / 6], [1 / 2, 1 / 3], [1 / 2, 1 / 3], [1.0, 1 / 6]])
        (_, mean), _ = jax.lax.scan(stage, (rest, rest), stages)
        end, held = _advance(start, mean, h)
        time = start[0].time + h  # whole periods stay whole numbers
        attitude = rotation.normalise(end.attitude)
        frame = self._frame(time, end.target_orbit)
        omega, _ = self.attitude_motion.rates(attitude, end.angular_velocity, frame)
        return MotionState(time, end.position, end.velocity, attitude, omega, end.target_orbit), held

    def _frame(self, time: Scalar, target_orbit: Float[Array, "6"] | None) -> OrbitalFrame:
        if target_orbit is None:
            return self.orbit.frame(time)
        mu = self.orbit.gravitational_parameter
        return perturbed_frame(target_orbit[:3], target_orbit[3:], mu, self.perturbations)

    def _target_derivative(self, target_orbit: Float[Array, "6"]) -> Float[Array, "6"]:
        position, velocity = target_orbit[:3], target_orbit[3:]
        mu = self.orbit.gravitational_parameter
        return jnp.concatenate([velocity, target_acceleration(position, velocity, mu, self.perturbations)])

    def _drift(self, state: MotionState, frame: OrbitalFrame, omega: Vector, omega_dot: Vector) -> Vector:
        r, v = state.position - self.centre_of_mass, state.velocity
        body_from_vvlh = rotation.matrix(state.attitude)
        target = body_from_vvlh @ jnp.array([0.0, 0.0, -1.0]) * frame.radius
        drift = (
            -2 * jnp.cross(omega, v)
            - jnp.cross(omega_dot, r)
            - jnp.cross(omega, jnp.cross(omega, r))
            - self.orbit.gravitational_parameter * gravity_difference(r, target)
        )
        if state.target_orbit is None:
            return drift
        target_position, target_velocity = state.target_orbit[:3], state.target_orbit[3:]
        inertial_from_body = vvlh_axes(target_position, target_velocity).T @ body_from_vvlh.T
        position = target_position + inertial_from_body @ r
        velocity = target_velocity + inertial_from_body @ (v + jnp.cross(omega, r))
        difference = jnp.zeros(3)
        for perturbation in self.perturbations:
            chaser = perturbation.of_chaser(position, velocity)
            difference = difference + chaser - perturbation.of_target(target_position, target_velocity)
        return drift + inertial_from_body.T @ difference


@kept_jit  # operation by operation, it would compile dozens of them before a first flight
def _initial_state(motion: RelativeMotion, position: Vector, velocity: Vector, time: Scalar) -> MotionState:
    target_orbit = jnp.concatenate(motion.orbit.inertial_state(time)) if motion.perturbations else None
    law = motion.attitude_motion
    angular_velocity = law.initial_angular_velocity(motion._frame(time, target_orbit))
    return MotionState(time, position, velocity, law.attitude, angular_velocity, target_orbit)


def gravity_difference(relative: Vector, target: Vector) -> Vector:
    """(r_T + r)/‖r_T + r‖³ − r_T/‖r_T‖³ in 1/m², without the cancellation of the direct difference (Encke's form).

    With q = r·(r + 2 r_T)/‖r_T‖², the cube of the chaser's distance is ‖r_T‖³ (1 + q)^{3/2}, and (1 + q)^{−3/2} − 1
    is formed without loss.
    """
    radius_squared = target @ target
    q = relative @ (relative + 2 * target) / radius_squared
    shrink = jnp.expm1(-1.5 * jnp.log1p(q))
    return (relative * (1 + shrink) + target * shrink) / radius_squared**1.5


def _advance(state: Pushed, derivative: Pushed, duration: float | Scalar) -> Pushed:
    return jax.tree.map(lambda value, slope: value + duration * slope, state, derivative)
