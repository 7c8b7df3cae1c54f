"""Error of one Runge–Kutta step a second, against steps 32 times finer, after 3000 s; and the time a step takes.

python benchmarks/motion.py --out benchmarks/results/motion.json
"""

import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from kept_rows import command, keep, tell

from keepout.core.motion.attitude import Tumbling, VVLHFixed
from keepout.core.motion.disturbance import NoDisturbance
from keepout.core.motion.orbit import Orbit
from keepout.core.motion.relative import RelativeMotion

INERTIA = np.array([[120.0, 8.0, -5.0], [8.0, 90.0, 4.0], [-5.0, 4.0, 60.0]])
STEPS = 3000


@eqx.filter_jit
def coast(motion, state):
    def body(state, _):
        return motion.step(state, jnp.zeros(3), NoDisturbance(), 1.0, 20.0), None

    return jax.lax.scan(body, state, length=STEPS)[0]


def seconds(motion, state):
    began = time.perf_counter()
    jax.block_until_ready(coast(motion, state))
    return time.perf_counter() - began


def main():
    parser = command(__doc__)
    parser.add_argument("--out", type=Path, help="also keep the rows in this file")
    given = parser.parse_args()
    position = np.array([6.0, -4.0, 7.0])
    cases = {"VVLH-fixed, e = 0": (0.0, VVLHFixed(), np.array([0.01, 0.0, -0.01]))}
    cases["VVLH-fixed, e = 0.1"] = (0.1, VVLHFixed(), np.array([0.01, 0.0, -0.01]))
    for rate in (0.1, 0.5, 1.0, 2.0, 5.0):
        omega = np.deg2rad(rate) * np.array([0.6, -0.48, 0.64])
        # at rest in inertial space, so that the chaser stays near whatever the tumbling
        cases[f"tumbling at {rate} deg/s"] = (0.0, Tumbling(omega, INERTIA), -np.cross(omega, position))
    rows = []
    for name, (eccentricity, law, velocity) in cases.items():
        ends = []
        for substeps in (1, 4, 32):
            motion = RelativeMotion(Orbit(7.5e6, eccentricity, 0.3), law, substeps=substeps)
            state = motion.initial_state(position, velocity)
            ends.append(coast(motion, state).position)
            if substeps == 1:
                microseconds = 1e6 * min(seconds(motion, state) for _ in range(5)) / STEPS
        one, four = (float(np.linalg.norm(end - ends[2])) for end in ends[:2])
        rows.append({"target": name, "error_1_substep_m": one, "error_4_substeps_m": four, "step_us": microseconds})
    tell(rows, given)
    keep(rows, given.out)


if __name__ == "__main__":
    main()
