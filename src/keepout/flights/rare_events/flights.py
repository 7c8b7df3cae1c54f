"""Flights by their tapes, and the least clearance of each: the performance that subset simulation drives down.

The clearance of a flight is the audit's lower bound on the least distance from the chaser's surface to the mesh at any
instant (`audit.tube`), at most a millimetre and b T²/8 below the truth; so a flight counted as without contact has
none. A flight whose states are not all numbers, or that may have left the range where gravity is bounded, has no such
bound and counts as −∞.
"""

from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from keepout.core.audit.tube import Tube, nearest
from keepout.core.cores import available_cores
from keepout.core.flight.batches import BATCH
from keepout.core.flight.loop import FlightLog, trace
from keepout.core.flight.setup import FlightSetup
from keepout.core.mission import environment
from keepout.core.mission.build import Mission
from keepout.core.mission.flight import Flight, judged
from keepout.flights.rare_events.tape import Tape

_TOLERANCE = 1e-3
"""How close to the truth the clearance bound is driven, m."""

_COLUMNS = ("time", "position", "velocity", "force")


class TapedFlights:
    """Flies tapes of one mission, in batches of one size, so that a flight's bits do not depend on its company.

    Args:
        mission: what to fly.
        workers: batches in flight at once; by default the number of cores this process may use.

    Raises:
        ScenarioError: the mission's scenario has no tape (`Tape.of`), or no bounds.

    """

    def __init__(self, mission: Mission, *, workers: int | None = None) -> None:
        self.mission = mission
        self.tape = Tape.of(mission.scenario)
        self._bounds = environment.flight_bounds(mission.scenario)
        self._workers = workers or available_cores()

    def clearance(self, tapes: Float[np.ndarray, "flights numbers"]) -> Float[np.ndarray, "flights"]:
        """Fly tapes; give the clearance of each, m."""
        begins = range(0, len(tapes), BATCH)
        with ThreadPoolExecutor(self._workers) as pool:
            return np.concatenate(list(pool.map(lambda begin: self._cleared(tapes[begin : begin + BATCH]), begins)))

    def _cleared(self, tapes: Float[np.ndarray, "flights numbers"]) -> Float[np.ndarray, "flights"]:
        filled = np.resize(tapes, (BATCH, tapes.shape[1]))
        columns = _flown(self.mission.setup, jnp.asarray(filled), self.tape, self.mission.steps)
        flown = {name: np.asarray(column)[: len(tapes)] for name, column in zip(_COLUMNS, columns)}
        finite = np.all([np.isfinite(flown[name]).all(axis=(1, 2)) for name in _COLUMNS[1:]], axis=0)
        known = {name: np.where(finite[:, None, None], flown[name], 0.0) for name in _COLUMNS[1:]}
        tube = Tube.of(flown["time"][0], known["position"], known["velocity"], known["force"], self._bounds)
        target, radius = self.mission.target, self.mission.scenario.chaser.radius
        lower = nearest(tube, target.distance.distance, tolerance=_TOLERANCE).lower - radius
        return np.where(finite & ~tube.beyond.any(axis=1), lower, -np.inf)

    def fly(self, tape: Float[np.ndarray, "numbers"]) -> Flight:
        """Fly one tape with everything recorded, and audit it."""
        log = _logged(self.mission.setup, jnp.asarray(tape), self.tape, self.mission.steps)
        return judged(self.mission, log)


def _log(setup: FlightSetup, numbers: Float[Array, "numbers"], tape: Tape, steps: int) -> FlightLog:
    # No key is asked for: everything random is on the tape.
    setup, initial = tape.flown(setup, numbers)
    return trace(setup, initial, steps, jax.random.key(0))


_logged = eqx.filter_jit(_log)


@eqx.filter_jit
def _flown(
    setup: FlightSetup, tapes: Float[Array, "flights numbers"], tape: Tape, steps: int
) -> tuple[Float[Array, "flights ..."], ...]:
    def one(numbers: Float[Array, "numbers"]) -> tuple[Float[Array, "..."], ...]:
        log = _log(setup, numbers, tape, steps)
        return tuple(getattr(log, name) for name in _COLUMNS)

    return jax.vmap(one)(tapes)
