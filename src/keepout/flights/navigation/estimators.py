"""The law's estimates: a filter of position, velocity and disturbance together, or the last samples as they are.

The filter is an extended Kalman filter over x = [r, v, ξ]. The model of r and v is the exact relative motion with the
force and the disturbance's mean held over each period; its covariance P moves with the linearised motion. See
docs/motion.md.
"""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy import stats

from keepout.core.errors import ScenarioError
from keepout.core.flight.navigation import Estimator, Sample, Sensor
from keepout.core.motion import rotation
from keepout.core.motion.arrays import Vector, as_float64
from keepout.core.motion.disturbance import NoDisturbance
from keepout.core.motion.relative import MotionState, RelativeMotion
from keepout.core.motion.rotation import Quaternion

_MOST_WIDENING = 100.0
"""Largest factor on the covariance for one sample left out."""
_WIDEST = np.array([100.0, 1.0])
"""Standard deviations of position (m) and velocity (m/s) beyond which no sample widens them."""
_WIDEST_DISTURBANCE = 10.0
"""Likewise of the disturbance's components, in those of the start."""
PATIENCE = 5
"""Samples of a sensor that are left out in a row before the covariance is widened."""
_ACCELERATION_NOISE = 5e-5
"""Velocity that nothing explains gathers this much a second, m/s/√s: forces off from the commanded ones."""
_ATTITUDE_SHARE = 0.1
"""Of the difference between a sampled attitude and the estimate's that is taken over."""
_ROUNDING = 1e-12
"""Added to a square matrix that is 0 for a sample that says nothing of the motion: it then moves nothing."""
Factor = list[list[Float[Array, ""]]]
"""The rows of a lower triangle."""


class DisturbanceModel(eqx.Module):
    """ξ̇ = A ξ, d = C ξ from one control period to the next, alike in every axis; build with `disturbance_model`.

    ξ is the constant, then for each frequency ω the sinusoid and its quarter period ahead, so that d is the sum of the
    constant and the sinusoids. All of it is in newtons and none of it grows: A turns each pair by ωT a period.

    Attributes:
        cosine: cos ωT of each frequency.
        sine: sin ωT.
        mean_output: C̄ = (1/T) ∫₀ᵀ C exp(A t) dt, the weights of ξ in the mean over the period that begins.

    """

    cosine: Float[Array, " k"]
    sine: Float[Array, " k"]
    mean_output: Float[Array, " q"]

    @property
    def size(self) -> int:
        """The number q of states an axis."""
        return self.mean_output.shape[0]

    def moved(self, state: Float[Array, "q *rest"]) -> Float[Array, "q *rest"]:
        """Give exp(A T) ξ."""
        rows = [state[0]]
        for k in range(self.cosine.shape[0]):
            a, b = state[1 + 2 * k], state[2 + 2 * k]
            rows += [self.cosine[k] * a + self.sine[k] * b, self.cosine[k] * b - self.sine[k] * a]
        return jnp.stack(rows)

    def mean(self, state: Float[Array, "q *rest"]) -> Float[Array, "*rest"]:
        """Give C̄ ξ, the mean over the period that begins, N."""
        return sum((self.mean_output[i] * state[i] for i in range(1, self.size)), self.mean_output[0] * state[0])


class Belief(eqx.Module):
    """What is believed of one moment.

    Attributes:
        motion: the mean of position and velocity, with attitude and rates.
        disturbance: the mean of ξ, N, axis by axis in the last index.
        covariance: P of [r, v, ξ], m, m/s, N; ξ as `disturbance` flattened.
        left_out: samples of each sensor that were left out in a row.

    """

    motion: MotionState
    disturbance: Float[Array, "q 3"]
    covariance: Float[Array, "n n"]
    left_out: Int[Array, " sensors"]


class FilterMemory(eqx.Module):
    """What the filter carries from step to step, ℓ being the longest latency of its sensors.

    Attributes:
        settled: the belief at the newest time of which every sample has come, ℓ + 1 periods before the next step.
        forces: held over the ℓ + 1 periods since then, N.
        samples: of each sensor, those that came since and are of later times.
        steps: how many of the forces are real, fewer than ℓ + 1 only at the start.

    """

    settled: Belief
    forces: Float[Array, "periods 3"]
    samples: tuple[Sample, ...]
    steps: Int[Array, ""]


class KalmanFilter(Estimator):
    """An extended Kalman filter with late, seldom and missing samples, and a gate for outliers.

    A sample is used at the time that it is of: the filter starts again from the newest time of which all samples have
    come and runs ahead to now. One further off than a chi-square threshold is left out. After `PATIENCE` samples of a
    sensor in a row were left out, each further one widens the covariance until the sensor is believed again.

    Attitude and rates are carried by the motion's model and taken as true; a sensor of the attitude pulls the attitude
    by a fixed share of the difference. Build with `kalman_filter`.

    Attributes:
        motion: the model of the relative motion.
        sensors: in the order of the samples.
        model: of the disturbance.
        mass: kg.
        period: between control steps, s.
        process_noise: covariance that a period adds.
        disturbance_variance: of each component of ξ at the start, N².
        gates: largest normalised innovation squared of each sensor's samples.
        attitude_share: of the difference between a sampled attitude and the estimate's.
        attitudes: which sensors give the attitude.

    """

    motion: RelativeMotion
    sensors: tuple[Sensor, ...]
    model: DisturbanceModel
    mass: Float[Array, ""]
    period: Float[Array, ""]
    process_noise: Float[Array, "n n"]
    disturbance_variance: Float[Array, ""]
    gates: Float[Array, " sensors"]
    attitude_share: Float[Array, ""]
    attitudes: tuple[bool, ...] = eqx.field(static=True)

    @property
    def latency(self) -> int:
        """The longest of the sensors', control periods."""
        return max(sensor.latency for sensor in self.sensors)

    def initial_state(self, estimate: MotionState, errors: Float[Array, "2"]) -> FilterMemory:
        """Start from an estimate: evenly in balls of radii `errors` (m, m/s), the disturbance likewise in its own."""
        q = self.model.size
        variances = [jnp.repeat(errors**2 / 5.0, 3), jnp.broadcast_to(self.disturbance_variance, (3 * q,))]
        none_left_out = jnp.zeros(len(self.sensors), jnp.int32)
        belief = Belief(estimate, jnp.zeros((q, 3)), jnp.diag(jnp.concatenate(variances)), none_left_out)

        def waiting(sensor: Sensor) -> Sample:
            nothing = Sample(jnp.zeros(jax.eval_shape(sensor.ideal, estimate).shape), jnp.asarray(False))
            return jax.tree.map(lambda x: jnp.repeat(x[None], self.latency - sensor.latency, axis=0), nothing)

        samples = tuple(waiting(sensor) for sensor in self.sensors)
        return FilterMemory(belief, jnp.zeros((self.latency + 1, 3)), samples, jnp.zeros((), jnp.int32))

    def correct(
        self, state: FilterMemory, samples: tuple[Sample, ...]
    ) -> tuple[FilterMemory, MotionState, Int[Array, ""]]:
        """Take the samples that arrived; see `Estimator.correct`. A sample is counted as left out when it arrives."""
        late = self.latency
        lines = jax.tree.map(lambda old, new: jnp.concatenate([old, new[None]]), state.samples, samples)

        def padded(line: Sample, sensor: Sensor) -> Sample:
            return jax.tree.map(lambda x: jnp.pad(x, [(0, sensor.latency)] + [(0, 0)] * (x.ndim - 1)), line)

        # Before the start there was nothing to believe, to move or to sample.
        since_start = jnp.arange(late + 1) + state.steps - late
        came = tuple(padded(line, sensor) for line, sensor in zip(lines, self.sensors, strict=True))
        came = eqx.tree_at(lambda c: [s.came for s in c], came, [s.came & (since_start >= 0) for s in came])

        def ahead(
            beliefs: tuple[Belief, Belief], given: tuple[Vector, tuple[Sample, ...], Int[Array, ""], Bool[Array, ""]]
        ) -> tuple[tuple[Belief, Belief], Bool[Array, " sensors"]]:
            belief, settled = beliefs
            force, sampled, number, oldest = given
            belief = _where(number > 0, self.predicted(belief, force), belief)
            belief, left_out = self.updated(belief, sampled)
            return (belief, _where(oldest, belief, settled)), left_out

        line = (state.forces, came, since_start, jnp.arange(late + 1) == 0)
        (belief, settled), left_out = jax.lax.scan(ahead, (state.settled, state.settled), line)
        newest = [left_out[late - sensor.latency, i] for i, sensor in enumerate(self.sensors)]
        waiting = jax.tree.map(lambda x: x[1:], lines)
        memory = FilterMemory(settled, state.forces, waiting, state.steps)
        estimate = eqx.tree_at(
            lambda m: m.disturbance, belief.motion, self.model.mean(belief.disturbance), is_leaf=lambda x: x is None
        )
        return memory, estimate, jnp.sum(jnp.stack(newest).astype(jnp.int32))

    def advance(self, state: FilterMemory, force: Vector) -> FilterMemory:
        """Move to the next control step; see `Estimator.advance`."""
        forces = jnp.concatenate([state.forces[1:], force[None]])
        steps = jnp.minimum(state.steps + 1, self.latency + 1)
        return eqx.tree_at(lambda s: (s.forces, s.steps), state, (forces, steps))

    def predicted(self, belief: Belief, force: Vector) -> Belief:
        """Give what is believed a period later of a chaser under a force (N, body axes), before samples of then."""
        push = self.model.mean(belief.disturbance)
        motion = self.motion.step(belief.motion, force + push, NoDisturbance(), self.period, self.mass)
        top = transition(self.motion, belief.motion, self.period)
        top = jnp.concatenate([top[:, :6], top[:, 6:] / self.mass], axis=1)

        def moved(P: Float[Array, "n n"]) -> Float[Array, "n n"]:
            n = P.shape[0]
            xi = P[6:].reshape(-1, 3, n)
            held = jnp.concatenate([P[:6], self.model.mean(xi)])
            return jnp.concatenate([top @ held, self.model.moved(xi).reshape(-1, n)])

        covariance = moved(moved(belief.covariance).T)  # F (F P)ᵀ = F P Fᵀ
        covariance = 0.5 * (covariance + covariance.T) + self.process_noise
        return Belief(motion, self.model.moved(belief.disturbance), covariance, belief.left_out)

    def updated(self, belief: Belief, samples: tuple[Sample, ...]) -> tuple[Belief, Bool[Array, " sensors"]]:
        """Take samples of the belief's own time, one a sensor; give which of those that came were left out too."""
        left_out = []
        for i, (sensor, sample) in enumerate(zip(self.sensors, samples, strict=True)):
            if self.attitudes[i]:
                attitude, out = turned(belief.motion.attitude, sample, self.attitude_share)
                belief = eqx.tree_at(lambda b: b.motion.attitude, belief, attitude)
            else:
                belief, out = self._corrected(belief, sensor, sample, i)
            left_out.append(out)
        return belief, jnp.stack(left_out)

    def _corrected(self, belief: Belief, sensor: Sensor, sample: Sample, number: int) -> tuple[Belief, Bool[Array, ""]]:
        """Update by one sensor's sample in Joseph's form, or leave it out."""
        P = belief.covariance
        expected, H = linearised(sensor, belief.motion)
        finite = jnp.all(jnp.isfinite(sample.value))
        value = jnp.where(sample.came & finite, sample.value, expected)
        R = sensor.covariance(value)
        innovation = value - expected
        PH = P[:, :6] @ H.T
        lower = factorised(H @ PH[:6] + R)
        whitened = solved(lower, innovation)
        square = jnp.sum(whitened**2)
        fits = finite & (square <= self.gates[number])
        use, out = sample.came & fits, sample.came & ~fits

        # K = 0 leaves everything as it was, to the bit; of a sample beyond 1e150 R and the square may be no numbers.
        K = jnp.where(use, solved_back(lower, solved(lower, PH.T)).T, 0.0)
        M = P - _product(K, PH)
        P = M - _product(M[:, :6] @ H.T - K @ jnp.where(use, R, 0.0), K)
        change = K @ innovation
        impatient = out & finite & (belief.left_out[number] >= PATIENCE)
        wider = jnp.fmin(2.0 * square / self.gates[number], _MOST_WIDENING)
        factors = jnp.where(impatient, self._widening(P, wider), 1.0)
        P = factors[:, None] * P * factors

        count = jnp.where(out, belief.left_out[number] + 1, jnp.where(use, 0, belief.left_out[number]))
        motion = eqx.tree_at(
            lambda m: (m.position, m.velocity),
            belief.motion,
            (belief.motion.position + change[:3], belief.motion.velocity + change[3:6]),
        )
        disturbance = belief.disturbance + change[6:].reshape(-1, 3)
        return Belief(motion, disturbance, P, belief.left_out.at[number].set(count)), out

    def _widening(self, P: Float[Array, "n n"], wanted: Float[Array, ""]) -> Float[Array, " n"]:
        """Give the factors on the state that make its variances as many times larger as is wanted and allowed."""
        push = _WIDEST_DISTURBANCE**2 * self.disturbance_variance
        widest = jnp.concatenate([jnp.repeat(_WIDEST**2, 3), jnp.broadcast_to(push, (P.shape[0] - 6,))])
        spread = jnp.diag(P)
        room = jnp.where(spread > 0.0, widest / jnp.where(spread > 0.0, spread, 1.0), 1.0)
        return jnp.sqrt(jnp.maximum(jnp.minimum(wanted, room), 1.0))


def transition(motion: RelativeMotion, state: MotionState, period: Float[Array, ""]) -> Float[Array, "6 9"]:
    """Give the Jacobian of one period's motion by (r, v) and a held acceleration.

    It is the series of the linear motion r̈ = G r + D ṙ + a, D = −2 [ω×], G = −[ω̇×] − [ω×]² − (μ/R³)(I − 3 z zᵀ), z to
    the nadir of the target: v⁺ by (r, v) to second order in the period, and what its integrals give of the rest. The
    gradient of perturbations is left out, that of gravity is taken at the target, and ω is that of the period's middle.
    """
    frame = motion.orbital_frame(state)
    omega, omega_dot = motion.attitude_motion.rates(state.attitude, state.angular_velocity, frame)
    omega = omega + 0.5 * period * omega_dot
    nadir = rotation.matrix(state.attitude)[:, 2]
    one, turn = jnp.eye(3), _cross(omega)
    tide = motion.orbit.gravitational_parameter / frame.radius**3 * (one - 3.0 * nadir[:, None] * nadir)
    D = -2.0 * turn
    G = -_cross(omega_dot) - turn @ turn - tide
    DG, E = D @ G, D @ D + G
    t, t2, t3, t4 = period, period**2 / 2.0, period**3 / 6.0, period**4 / 24.0
    by_velocity = t * one + t2 * D + t3 * E
    rows = [
        [one + t2 * G + t3 * DG, by_velocity, t2 * one + t3 * D + t4 * E],
        [t * G + t2 * DG, one + t * D + t2 * E, by_velocity],
    ]
    return jnp.concatenate([jnp.concatenate(row, axis=1) for row in rows])


def kalman_filter(
    motion: RelativeMotion,
    sensors: Sequence[Sensor],
    *,
    mass: float,
    period: float,
    disturbance_bound: float,
    frequencies: Sequence[float] = (),
    disturbance_walk: float | None = None,
    outlier_probability: float = 1e-6,
) -> KalmanFilter:
    """Build the filter.

    Args:
        motion: the model of the relative motion.
        sensors: whose samples it takes, in their order.
        mass: of the chaser, kg.
        period: between control steps, s.
        disturbance_bound: the norm of the push, N: each part of it may be as large at the start.
        frequencies: of sinusoids in the push, rad/s.
        disturbance_walk: what the push gathers a second beyond its model, N/√s; by default a tenth of the bound for a
            constant alone, which must follow whatever the push does, and a five-hundredth for sinusoids.
        outlier_probability: of a sample of the filter's own statistics to be left out.

    Raises:
        ScenarioError: no sensor of the chaser's motion, or a number outside its range.

    """
    if disturbance_walk is None:
        disturbance_walk = disturbance_bound / (500.0 if len(frequencies) else 10.0)
    numbers = {"mass": mass, "period": period, "disturbance_bound": disturbance_bound}
    for name, value in (numbers | {"disturbance_walk": disturbance_walk}).items():
        if not (np.isfinite(value) and (value > 0.0 or (value == 0.0 and name not in ("mass", "period")))):
            raise ScenarioError(f"filter {name}: {value}; it must be finite and positive, noises and bounds may be 0")
    if not 0.0 < outlier_probability < 1.0:
        raise ScenarioError(f"filter outlier_probability: {outlier_probability}; it must lie in (0, 1)")
    attitudes = attitude_sensors(motion, sensors)
    if all(attitudes):
        raise ScenarioError(f"filter sensors: {len(attitudes)}, none of the chaser's motion; at least one is needed")

    model = disturbance_model(frequencies, period)
    one, q = np.eye(3), model.size
    noise = np.zeros((6 + 3 * q, 6 + 3 * q))
    block = np.array([[period**2 / 3.0, period / 2.0], [period / 2.0, 1.0]]) * period * _ACCELERATION_NOISE**2
    noise[:6, :6] = np.kron(block, one)
    noise[6:, 6:] = np.eye(3 * q) * period * disturbance_walk**2
    sizes = [jax.eval_shape(sensor.ideal, probe(motion)).size for sensor in sensors]
    gates = stats.chi2.isf(outlier_probability, sizes)
    return KalmanFilter(
        motion=motion,
        sensors=tuple(sensors),
        model=model,
        mass=as_float64(mass),
        period=as_float64(period),
        process_noise=as_float64(noise),
        disturbance_variance=as_float64(disturbance_bound**2 / 5.0),
        gates=as_float64(gates),
        attitude_share=as_float64(_ATTITUDE_SHARE),
        attitudes=attitudes,
    )


def _where(condition: Bool[Array, ""], yes: Belief, no: Belief) -> Belief:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


def _cross(w: Vector) -> Float[Array, "3 3"]:
    zero = jnp.zeros(())
    return jnp.array([[zero, -w[2], w[1]], [w[2], zero, -w[0]], [-w[1], w[0], zero]])


def _product(left: Float[Array, "n m"], right: Float[Array, "n m"]) -> Float[Array, "n n"]:
    """Give left rightᵀ for few columns: as a sum of outer products it is one loop with whatever is added to it."""
    total = left[:, 0, None] * right[:, 0]
    for i in range(1, left.shape[1]):
        total = total + left[:, i, None] * right[:, i]
    return total


def disturbance_model(frequencies: Sequence[float], period: float) -> DisturbanceModel:
    """Build the model of a constant plus sinusoids of `frequencies` (rad/s; none: the constant alone) each axis.

    Raises:
        ScenarioError: a frequency that is not in (0, π/period) or that repeats.

    """
    omegas = np.asarray([float(w) for w in frequencies])
    if len(set(omegas.tolist())) != len(omegas) or not np.all((omegas > 0.0) & (omegas < np.pi / period)):
        raise ScenarioError(
            f"filter frequencies: {omegas.tolist()} rad/s; distinct values in (0, {np.pi / period:.3g}) are needed"
        )
    angle = omegas * period
    # 1 − cos without its cancellation at slow frequencies
    pairs = np.stack([np.sin(angle), 2.0 * np.sin(angle / 2.0) ** 2], axis=1) / angle[:, None]
    mean_output = np.concatenate([[1.0], pairs.reshape(-1)])
    return DisturbanceModel(as_float64(np.cos(angle)), as_float64(np.sin(angle)), as_float64(mean_output))


def factorised(matrix: Float[Array, "m m"]) -> Factor:
    """Give L of a positive definite S = L Lᵀ (Cholesky); only the lower triangle of S is looked at."""
    lower: Factor = []
    for i in range(matrix.shape[0]):
        row: list[Float[Array, ""]] = []
        for j in range(i + 1):
            rest = matrix[i, j]
            for k in range(j):
                rest = rest - row[k] * (lower[j][k] if j < i else row[k])
            row.append(jnp.sqrt(rest) if i == j else rest / lower[j][j])
        lower.append(row)
    return lower


def solved(lower: Factor, right: Float[Array, "m *rest"]) -> Float[Array, "m *rest"]:
    """Give L⁻¹ b."""
    rows: list[Array] = []
    for i, row in enumerate(lower):
        rest = right[i]
        for k in range(i):
            rest = rest - row[k] * rows[k]
        rows.append(rest / row[i])
    return jnp.stack(rows)


def solved_back(lower: Factor, right: Float[Array, "m *rest"]) -> Float[Array, "m *rest"]:
    """Give L⁻ᵀ b."""
    count = len(lower)
    rows: list[Array] = []
    for i in reversed(range(count)):
        rest = right[i]
        for k in range(i + 1, count):
            rest = rest - lower[k][i] * rows[count - 1 - k]
        rows.append(rest / lower[i][i])
    return jnp.stack(rows[::-1])


def linearised(sensor: Sensor, state: MotionState) -> tuple[Float[Array, " m"], Float[Array, "m 6"]]:
    """Give what a sensor would say of a state, and its Jacobian by position (m) and velocity (m/s)."""

    def said(x: Float[Array, "6"]) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
        value = sensor.ideal(eqx.tree_at(lambda m: (m.position, m.velocity), state, (x[:3], x[3:])))
        return value, value

    jacobian, value = jax.jacfwd(said, has_aux=True)(jnp.concatenate([state.position, state.velocity]))
    return value, jacobian


def probe(motion: RelativeMotion) -> MotionState:
    """Give a state in no special place, to ask sensors what they are."""
    state = motion.initial_state([20.0, -30.0, 10.0], [0.1, 0.2, -0.3])
    return eqx.tree_at(lambda m: m.attitude, state, rotation.normalise(jnp.array([0.8, 0.4, -0.2, 0.3])))


def attitude_sensors(motion: RelativeMotion, sensors: Sequence[Sensor]) -> tuple[bool, ...]:
    """Give for each sensor whether it says the target's attitude quaternion and nothing else."""
    state = probe(motion)
    said = [np.asarray(sensor.ideal(state)) for sensor in sensors]
    return tuple(v.shape == (4,) and np.allclose(v, state.attitude, rtol=0.0, atol=1e-12) for v in said)


def turned(attitude: Quaternion, sample: Sample, share: float | Float[Array, ""]) -> tuple[Quaternion, Bool[Array, ""]]:
    """Turn an attitude by a share of the way, the shorter one, to a sampled one; and say whether that was none."""
    length = jnp.sqrt(jnp.sum(sample.value**2))
    valid = jnp.isfinite(length) & (length > 0.0)
    new = jnp.where(valid, sample.value / jnp.where(valid, length, 1.0), attitude)
    new = jnp.where(jnp.sum(new * attitude) < 0.0, -new, new)
    pulled = rotation.normalise(attitude + share * (new - attitude))
    return jnp.where(sample.came & valid, pulled, attitude), sample.came & ~valid


class RawSamples(Estimator):
    """The last samples as they are, held until the next ones; the motion's model carries attitude and rates alone.

    A sample moves the estimate by the smallest change of position and velocity that explains it; one that gives the
    position takes its place. Samples count as of now, however late they are. No disturbance is estimated: an observer
    of the law's own does that, or nobody. Build with `RawSamples.build`.

    Attributes:
        motion: the model of the relative motion.
        sensors: in the order of the samples.
        mass: kg.
        period: between control steps, s.
        attitudes: which sensors give the attitude.

    """

    motion: RelativeMotion
    sensors: tuple[Sensor, ...]
    mass: Float[Array, ""]
    period: Float[Array, ""]
    attitudes: tuple[bool, ...] = eqx.field(static=True)

    @classmethod
    def build(cls, motion: RelativeMotion, sensors: Sequence[Sensor], *, mass: float, period: float) -> "RawSamples":
        """Build the estimator for sensors in the order of their samples, a mass in kg and a period in s."""
        attitudes = attitude_sensors(motion, sensors)
        return cls(motion, tuple(sensors), as_float64(mass), as_float64(period), attitudes)

    def initial_state(self, estimate: MotionState, errors: Float[Array, "2"]) -> MotionState:
        """Start from an estimate, taken for the truth."""
        return estimate

    def correct(
        self, state: MotionState, samples: tuple[Sample, ...]
    ) -> tuple[MotionState, MotionState, Int[Array, ""]]:
        """Take the samples that arrived; those that are not numbers are left out."""
        left_out = jnp.zeros((), jnp.int32)
        for sensor, sample, of_attitude in zip(self.sensors, samples, self.attitudes, strict=True):
            if of_attitude:
                attitude, out = turned(state.attitude, sample, 1.0)
                state = dataclasses.replace(state, attitude=attitude)
            else:
                finite = jnp.all(jnp.isfinite(sample.value))
                expected, H = linearised(sensor, state)
                lower = factorised(H @ H.T + _ROUNDING * jnp.eye(H.shape[0]))
                missing = jnp.where(sample.came & finite, sample.value - expected, 0.0)
                change = H.T @ solved_back(lower, solved(lower, missing))
                state = dataclasses.replace(
                    state, position=state.position + change[:3], velocity=state.velocity + change[3:]
                )
                out = sample.came & ~finite
            left_out = left_out + out
        return state, state, left_out

    def advance(self, state: MotionState, force: Vector) -> MotionState:
        """Move time and attitude to the next control step."""
        moved = self.motion.step(state, force, NoDisturbance(), self.period, self.mass)
        return dataclasses.replace(moved, position=state.position, velocity=state.velocity)
