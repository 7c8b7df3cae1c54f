"""The source paper's control step in plain NumPy, equation by equation, and Keepout's beside it: they agree.

    python examples/paper_step.py

`PaperStep` is the text of section V with the constants of section VI; docs/control.md says what is mended.
"""

import itertools
import warnings

import numpy as np

MASS, PERIOD, SPEED = 20.0, 1.0, 0.1  # kg, s, m/s
OMEGA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
GAIN, RATE, BETA_E, BETA_C, BETA, MU_H, MU_V, LAMBDA = 50.0, 0.08, 0.1, 10.0, 1.0, 2.0, 1e-4, 15.0


class PaperStep:
    """The paper's law: f̃ and ∇f̃ of a position, what h takes off f̃ (m), the goal (m), k_p (m), and the drift (m/s²)."""

    def __init__(self, distance, gradient, offset, goal, slowing_length, drift, force_limit=0.1):
        self.distance, self.gradient, self.offset, self.drift = distance, gradient, offset, drift
        self.force_limit = force_limit  # N
        self.goal, self.slowing_length, self.before = goal, slowing_length, None

    def safe_velocity(self, r):  # (23), with the best slack σ = min(0, T·v − Υ) put in: a quadratic program, solved by
        h, normal = self.distance(r) - self.offset, self.gradient(r)  # trying every set of rows that may hold equal
        desired = -SPEED * np.tanh((r - self.goal) / self.slowing_length)
        tangent, turn = OMEGA @ normal, 0.1 - h
        rows = np.vstack([normal, np.eye(3), -np.eye(3)])
        least = np.array([-RATE * h, *[-SPEED] * 6])
        found = [(np.inf, np.zeros(3))]
        for slack, count in itertools.product((0.0, 2.0), range(4)):
            for held in map(list, itertools.combinations(range(7), count)):
                upper = np.hstack([np.eye(3) + slack * np.outer(tangent, tangent), -rows[held].T])
                system = np.vstack([upper, np.hstack([rows[held], np.zeros((count, count))])])
                right = np.concatenate([desired + slack * turn * tangent, least[held]])
                if np.linalg.matrix_rank(system) == len(system):
                    v = np.linalg.solve(system, right)[:3]
                    if np.all(rows @ v >= least - 1e-12):
                        cost = np.sum((v - desired) ** 2) / 2.0 + min(0.0, tangent @ v - turn) ** 2
                        found.append((cost, v))
        return min(found, key=lambda one: one[0])[1]

    def force(self, r, v):
        drift, k = self.drift(r, v), 1.0 - GAIN / MASS  # (28): ż = k z + L (k v − drift − F/m), d̂ = z + L v
        if self.before is None:
            self.z = -GAIN * v
        else:
            v0, drift0, force0 = self.before
            grown, constant = np.exp(k * PERIOD), GAIN * (k * v0 - (drift0 + drift) / 2.0 - force0 / MASS)
            ramp = (grown - 1.0 - k * PERIOD) / (k * k * PERIOD) * GAIN * k * (v - v0)
            self.z = grown * self.z + (grown - 1.0) / k * constant + ramp
        safe, s = self.safe_velocity(r), 1e-3  # ∂v_s/∂r v, by differences along v
        ahead = [weight * self.safe_velocity(r + step * s * v) for step, weight in ((1, 8), (-1, -8), (2, -1), (-2, 1))]
        error = v - safe
        feedback = -MU_V * (r - self.goal) - LAMBDA / 2.0 * error  # (31)
        reference = MASS * (sum(ahead) / (12.0 * s) - drift + feedback)
        p = -error / (MASS * MU_H)  # (36) to (38)
        b = p @ p
        h1 = self.distance(r) - self.offset - error @ error / (2.0 * MU_H)
        a = -error @ feedback / MU_H + self.gradient(r) @ v + BETA_C * h1 - b / (2.0 * BETA * (2.0 * BETA_E - BETA_C))
        filtered = reference + (np.logaddexp(0.0, -a / b) * p if b > 0.0 else 0.0)
        force = np.clip(filtered - (self.z + GAIN * v), -self.force_limit, self.force_limit)  # (30), (35)
        self.before = v, drift, force
        return force


def drift_in_orbit(radius):
    """Give the acceleration (m/s²) without force in a circular orbit of a radius (m): (4), by position and velocity."""
    mu = 3.986004418e14
    spin, target = np.array([0.0, -np.sqrt(mu / radius**3), 0.0]), np.array([0.0, 0.0, -radius])

    def drift(r, v):
        g = mu * ((target + r) / np.linalg.norm(target + r) ** 3 - target / radius**3)
        return -2.0 * np.cross(spin, v) - np.cross(spin, np.cross(spin, r)) - g

    return drift


def compare(force_limit, steps=120):
    """Fly round a ball by Keepout's law of the paper, and give both laws' forces (steps, 3) N at each state."""
    import jax
    import jax.numpy as jnp

    from keepout.core.control import profiles
    from keepout.core.control.profiles import Operation
    from keepout.core.fields.own import SphereField
    from keepout.core.motion.chaser import Chaser
    from keepout.core.motion.orbit import Orbit
    from keepout.core.motion.relative import RelativeMotion

    chaser = Chaser(mass=MASS, radius=0.5, force_limit=force_limit, speed_limit=SPEED)
    motion, goal = RelativeMotion(Orbit(42_164_000.0)), np.array([0.0, -9.0, 1.0])
    told = Operation(chaser=chaser, motion=motion, error_bound=0.0, disturbance_bound=0.015, period=PERIOD)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the conditions that the printed constants break
        law = profiles.paper(SphereField(jnp.zeros(3), jnp.asarray(4.0)), told, goal, slowing_length=10.0)
    plain = PaperStep(
        lambda r: np.linalg.norm(r) - 4.0,
        lambda r: r / np.linalg.norm(r),
        float(law.velocity.offset),
        goal,
        10.0,
        drift_in_orbit(42_164_000.0),
        force_limit,
    )
    r, v = np.array([0.5, 6.0, -0.7]), np.array([0.0, -0.02, 0.01])
    state = motion.initial_state(r, v)
    memory, step, found = law.initial_state(state), jax.jit(lambda memory, state: law.step(memory, state)), []
    for second in range(steps):
        memory, command = step(memory, state)
        found.append((np.asarray(command.force), plain.force(r, v)))
        push = 0.01 * np.array([np.sin(0.02 * second), np.cos(0.02 * second), np.sin(0.01 * second)])
        acceleration = plain.drift(r, v) + (found[-1][0] + push) / MASS
        r, v = r + v + acceleration / 2.0, v + acceleration
        state = motion.initial_state(r, v)
    return tuple(np.array(forces) for forces in zip(*found, strict=True))


if __name__ == "__main__":
    for limit in (0.1, 100.0):
        ours, plain = compare(limit)
        print(f"thrusters of {limit:g} N: largest difference of {len(ours)} forces {np.abs(ours - plain).max():.1e} N")
