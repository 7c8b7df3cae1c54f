"""Many flights at once: compiled once, flown in small batches on every core, summarised as they land.

A batch is large enough to hide what it costs to start one and small enough to spread over the cores, each of which
flies its own batch in its own thread: `benchmarks/campaign.py` times the choices.

What flights share keeps no axis of flights: where time and target are alike, the orbit, the attitude and their
Runge–Kutta stages are computed once a step for the whole batch.

The size of a batch is part of a campaign's identity. A flight is the same to the bit in whatever place of a batch, with
whatever flights beside it, and however many workers there are; but a processor adds up the products of a network in
another order for another size. So run k of a campaign is flown again alone, to the same bits, with the `batch` and
`alike` of the whole:

    fly_batches(setup, states[k : k + 1], steps, Batching(seed, [k], batch=batch, alike=alike))
"""

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, Key, PyTree
from numpy.typing import ArrayLike

from keepout.core.compiled.kept_executables import kept_jit
from keepout.core.cores import available_cores
from keepout.core.errors import ScenarioError
from keepout.core.flight.loop import FlightLog, FlightOutcome, outcome, trace
from keepout.core.flight.setup import FlightSetup
from keepout.core.motion.relative import MotionState, RelativeMotion
from keepout.core.progress import Progress, silent

SIZES = (8, 32, 64, 128)
"""Flights in a batch on a CPU: the least of which two take all, so that two cores have work and programs are few."""
BATCH = SIZES[-1]

TARGET = ("time", "attitude", "angular_velocity", "target_orbit")
"""Entries of a `MotionState` that tell where the target is and how it turns: what flights can have in common."""

Landed = Callable[[int, dict[str, np.ndarray]], None]
"""Called with the index of a batch's first flight and its log columns, each (flights in the batch, steps + 1, ...)."""


def states_at(motion: RelativeMotion, position: ArrayLike, velocity: ArrayLike | None = None) -> MotionState:
    """Give the initial states of many flights: a `MotionState` whose arrays have a leading axis of flights.

    Args:
        motion: of every flight.
        position: (flights, 3) m, body axes.
        velocity: (flights, 3) m/s, body axes; by default at rest.

    Raises:
        ScenarioError: no flights, or values that are not finite or not three a flight.

    """
    position = np.asarray(position, np.float64)
    velocity = np.zeros_like(position) if velocity is None else np.asarray(velocity, np.float64)
    flights = len(np.atleast_1d(position))
    if flights < 1:
        raise ScenarioError("flights: 0; there must be at least 1")
    for name, given in (("positions", position), ("velocities", velocity)):
        if given.shape != (flights, 3) or not np.all(np.isfinite(given)):
            raise ScenarioError(f"{name}: shape {given.shape}; they must be finite and of shape ({flights}, 3)")
    return eqx.filter_vmap(motion.initial_state)(jnp.asarray(position), jnp.asarray(velocity))


class Batching(NamedTuple):
    """How many flights are flown together.

    Attributes:
        seed: of the flights' own random keys, one each: the seed's key with the flight's place folded in, however many
            flights there are.
        places: of these flights among all that are flown from this seed; by default from 0 on. Flown in parts or alone,
            each flight keeps its key.
        vary: selects the parts of a setup that differ between flights, as for `equinox.tree_at`, or has the setup's
            structure and says it of each leaf; all arrays in them have a leading axis of flights.
        alike: which entries of `TARGET` are the same in all flights and computed once for all of them; the first
            flight's are taken. By default those that are the same in the flights given (`alike_among`). A campaign
            flown in parts names those of the whole: the last digits depend on what is shared.
        batch: flights in a batch, by which the program is compiled; on a CPU the least of `SIZES` of which two take
            all, or the largest, elsewhere all. A last batch that is not full is filled up.
        workers: batches in flight at once; by default the number of cores this process may use, elsewhere 1.

    """

    seed: int = 0
    places: Int[np.ndarray, "flights"] | Sequence[int] | None = None
    vary: Callable[[FlightSetup], Any] | PyTree[bool] | None = None
    alike: Sequence[str] | None = None
    batch: int | None = None
    workers: int | None = None


_BY_DEFAULT = Batching()


def fly_batches(
    setup: FlightSetup,
    initial: MotionState,
    steps: int,
    batching: Batching = _BY_DEFAULT,
    *,
    columns: Sequence[str] = (),
    landed: Landed | None = None,
    progress: Progress = silent,
) -> FlightOutcome:
    """Fly one setup from many initial states; a flight's bits depend on a batch's size, not on its place in it.

    Args:
        setup: of every flight.
        initial: states with a leading axis of flights, as `states_at` gives them.
        steps: control steps of each flight.
        batching: what differs between the flights, and how they are put together.
        columns: names of `FlightLog` columns to hand to `landed`; without any, logs never leave the compiled program.
        landed: gets each batch's columns, in the order of the flights, called from the calling thread.
        progress: told after each batch.

    Returns:
        The outcomes as NumPy arrays with a leading axis of flights, in the order of `initial`.

    Raises:
        ScenarioError: an unknown column or entry, or arrays without a common number of flights.

    """
    _refuse_unknown("columns", columns, FlightLog.__annotations__)
    _refuse_unknown("alike", batching.alike or (), TARGET)
    varied = _filter(setup, batching.vary)
    common = jax.tree.map(
        lambda own, leaf: leaf if own is None else None, varied, setup, is_leaf=lambda leaf: leaf is None
    )
    flights = _common_length((varied, initial))
    alike = alike_among(initial) if batching.alike is None else tuple(batching.alike)
    target, own_states = _shared(jax.tree.map(_on_host, initial), alike)
    places = np.arange(flights) if batching.places is None else batching.places
    cases = (jax.tree.map(_on_host, varied), own_states, np.asarray(places, np.int64))
    on_cpu = jax.default_backend() == "cpu"
    batch = batching.batch or (usual_batch(flights) if on_cpu else flights)
    workers = batching.workers or (available_cores() if on_cpu else 1)
    seed = jax.device_put(np.asarray(batching.seed, np.int64))

    def run(begin: int) -> tuple[FlightOutcome, dict[str, np.ndarray]]:
        # The last batch is filled up with its own first flight, so that only one shape is ever compiled.
        index = np.arange(begin, begin + batch)
        own = np.where(index < flights, index, begin)
        mine = jax.tree.map(lambda array: array[own], cases)
        result = _fly_batch(common, target, seed, mine, steps, tuple(columns))
        return jax.tree.map(lambda array: array[: flights - begin], jax.device_get(result))

    summaries: list[FlightOutcome] = []

    def land(begin: int, future: Future[tuple[FlightOutcome, dict[str, np.ndarray]]]) -> None:
        summary, log = future.result()
        summaries.append(summary)
        if landed is not None:
            landed(begin, log)
        done = min(begin + batch, flights)
        progress(done / flights, f"{done} of {flights} flights")

    under_way: deque[tuple[int, Future[tuple[FlightOutcome, dict[str, np.ndarray]]]]] = deque()
    pool = ThreadPoolExecutor(workers)
    try:
        for begin in range(0, flights, batch):
            under_way.append((begin, pool.submit(run, begin)))
            if len(under_way) > 2 * workers:  # no further ahead than this, so that logs do not fill the memory
                land(*under_way.popleft())
        while under_way:
            land(*under_way.popleft())
    finally:
        pool.shutdown(cancel_futures=True)
    return jax.tree.map(lambda *parts: np.concatenate(parts), *summaries)


def usual_batch(flights: int) -> int:
    """Give the size of the batches in which so many flights are flown on a CPU unless another is asked for."""
    return next((size for size in SIZES if flights <= 2 * size), BATCH)


def alike_among(initial: MotionState) -> tuple[str, ...]:
    """Name the entries of `TARGET` that are the same, to the bit, in all of these states (leading axis: flights)."""
    entries = {name: np.asarray(getattr(initial, name)) for name in TARGET if getattr(initial, name) is not None}
    return tuple(name for name, value in entries.items() if (value == value[:1]).all())


def _shared(initial: MotionState, alike: Sequence[str]) -> tuple[MotionState, MotionState]:
    """Split states into the entries that flights share, without an axis of flights, and their own; None elsewhere."""
    chosen = jax.tree_util.tree_map_with_path(lambda path, _: path[0].name in alike, initial)
    common, own = eqx.partition(initial, chosen)
    return jax.tree.map(lambda array: array[:1].reshape(array.shape[1:]), common), own


def _on_host(array: Any) -> Any:
    """Give an array as NumPy's, whose entries are taken without compiling a program for it; random keys stay JAX's."""
    return array if jnp.issubdtype(array.dtype, jax.dtypes.prng_key) else np.asarray(array)


def flight_key(seed: int | Int[Array, ""], place: int | Int[Array, ""]) -> Key[Array, ""]:
    """Give the random key of the flight at a place of those flown from a seed, however many they are."""
    return jax.random.fold_in(jax.random.key(seed), place)


@kept_jit
def _fly_batch(
    setup: FlightSetup, target: MotionState, seed: Int[Array, ""], cases: PyTree, steps: int, columns: tuple[str, ...]
) -> tuple[FlightOutcome, dict[str, jax.Array]]:
    def one(case: PyTree) -> tuple[FlightOutcome, dict[str, jax.Array]]:
        varied, state, place = case
        own = eqx.combine(varied, setup)
        log = trace(own, eqx.combine(state, target), steps, flight_key(seed, place))
        return outcome(own, log), {name: getattr(log, name) for name in columns}

    return eqx.filter_vmap(one)(cases)


def _refuse_unknown(what: str, names: Iterable[str], valid: Iterable[str]) -> None:
    unknown = sorted(set(names) - set(valid))
    if unknown:
        raise ScenarioError(f"{what}: {unknown[0]}; valid are {', '.join(valid)}")


def _filter(setup: FlightSetup, vary: Callable[[FlightSetup], Any] | PyTree[bool] | None) -> FlightSetup:
    """Only the arrays of the varying parts of a setup; None elsewhere."""
    chosen = jax.tree.map(lambda _: False, setup) if vary is None or callable(vary) else vary
    if callable(vary):
        chosen = eqx.tree_at(vary, chosen, replace_fn=lambda part: jax.tree.map(lambda _: True, part))
    return eqx.filter(setup, jax.tree.map(lambda flag, leaf: flag and eqx.is_array(leaf), chosen, setup))


def _common_length(cases: PyTree) -> int:
    lengths = {array.shape[:1] for array in jax.tree.leaves(cases)}
    if len(lengths) != 1 or lengths == {()}:
        raise ScenarioError(f"flights: leading axes {sorted(lengths)}; states and varied parts need one common length")
    return lengths.pop()[0]
