"""Many flights at once: compiled once, flown in small batches on every core, summarised as they land.

A batch is large enough to hide what it costs to start one and small enough to spread over the cores, each of which
flies its own batch in its own thread: `benchmarks/campaign.py` times the choices.
"""

import os
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from keepout.errors import ScenarioError
from keepout.flight.loop import FlightLog, trace
from keepout.flight.outcome import FlightOutcome, outcome
from keepout.flight.setup import FlightSetup
from keepout.motion.relative import MotionState, RelativeMotion
from keepout.progress import Progress, silent

BATCH = 128
"""Flights in a batch on a CPU."""

Sampler = Callable[[np.random.Generator, int], tuple[np.ndarray, np.ndarray]]
"""Draws a number of starts: positions (m) and velocities (m/s), both (flights, 3), in body axes."""

Landed = Callable[[int, dict[str, np.ndarray]], None]
"""Called with the index of a batch's first flight and its log columns, each (flights in the batch, steps + 1, ...)."""


def initial_states(motion: RelativeMotion, sampler: Sampler, flights: int, *, seed: int) -> MotionState:
    """Draw the initial states of a campaign: a `MotionState` whose arrays have a leading axis of `flights`.

    Raises:
        ScenarioError: fewer than one flight, or a sampler that returns other shapes or values that are not finite.

    """
    if flights < 1:
        raise ScenarioError(f"flights: {flights}; it must be at least 1")
    position, velocity = (np.asarray(draw, np.float64) for draw in sampler(np.random.default_rng(seed), flights))
    for name, draw in (("positions", position), ("velocities", velocity)):
        if draw.shape != (flights, 3) or not np.all(np.isfinite(draw)):
            raise ScenarioError(f"sampled {name}: shape {draw.shape}; they must be finite and of shape ({flights}, 3)")
    return eqx.filter_vmap(motion.initial_state)(jnp.asarray(position), jnp.asarray(velocity))


def fly_batches(
    setup: FlightSetup,
    initial: MotionState,
    steps: int,
    *,
    seed: int = 0,
    first: int = 0,
    vary: Callable[[FlightSetup], Any] | None = None,
    columns: Sequence[str] = (),
    landed: Landed | None = None,
    batch: int | None = None,
    workers: int | None = None,
    progress: Progress = silent,
) -> FlightOutcome:
    """Fly one setup from many initial states; the outcome of each flight does not depend on batches and workers.

    Args:
        setup: of every flight.
        initial: states with a leading axis of flights, as `initial_states` draws them.
        steps: control steps of each flight.
        seed: of the flights' own random keys, one each.
        first: place of the first of these flights among all that are flown from this seed: flown in parts, each
            flight keeps its key.
        vary: selects the parts of `setup` that differ between flights, as for `equinox.tree_at`; all arrays in them
            have a leading axis of flights.
        columns: names of `FlightLog` columns to hand to `landed`; without any, logs never leave the compiled program.
        landed: gets each batch's columns, in the order of the flights, called from the calling thread.
        batch: flights in a batch, by which the program is compiled; on a CPU 128 or all if fewer, elsewhere all. A last
            batch that is not full is filled up.
        workers: batches in flight at once; by default the number of cores this process may use, elsewhere 1.
        progress: told after each batch.

    Returns:
        The outcomes as NumPy arrays with a leading axis of flights, in the order of `initial`.

    Raises:
        ScenarioError: an unknown column, or arrays without a common number of flights.

    """
    unknown = sorted(set(columns) - set(FlightLog.__annotations__))
    if unknown:
        raise ScenarioError(f"columns: {unknown[0]}; valid are {', '.join(FlightLog.__annotations__)}")
    varied = _filter(setup, vary)
    keys = jax.random.split(jax.random.key(seed), first + initial.time.shape[0])[first:]
    cases = (varied, initial, keys)
    flights = _common_length(cases)
    on_cpu = jax.default_backend() == "cpu"
    batch = batch or min(flights, BATCH if on_cpu else flights)
    workers = workers or (available_cores() if on_cpu else 1)

    def run(begin: int) -> tuple[FlightOutcome, dict[str, np.ndarray]]:
        # The last batch is filled up with its own first flight, so that only one shape is ever compiled.
        index = np.arange(begin, begin + batch)
        own = np.where(index < flights, index, begin)
        result = _fly_batch(setup, jax.tree.map(lambda array: array[own], cases), steps, tuple(columns))
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


@eqx.filter_jit
def _fly_batch(
    setup: FlightSetup, cases: PyTree, steps: int, columns: tuple[str, ...]
) -> tuple[FlightOutcome, dict[str, jax.Array]]:
    def one(case: PyTree) -> tuple[FlightOutcome, dict[str, jax.Array]]:
        varied, state, key = case
        own = eqx.combine(varied, setup)
        log = trace(own, state, steps, key)
        return outcome(own, log), {name: getattr(log, name) for name in columns}

    return eqx.filter_vmap(one)(cases)


def _filter(setup: FlightSetup, vary: Callable[[FlightSetup], Any] | None) -> FlightSetup:
    """Only the arrays of the varying parts of a setup; None elsewhere."""
    nothing = jax.tree.map(lambda _: False, setup)
    chosen = nothing if vary is None else eqx.tree_at(vary, nothing, replace_fn=lambda part: jax.tree.map(_true, part))
    return eqx.filter(setup, jax.tree.map(lambda flag, leaf: flag and eqx.is_array(leaf), chosen, setup))


def _true(_: Any) -> bool:
    return True


def _common_length(cases: PyTree) -> int:
    lengths = {array.shape[:1] for array in jax.tree.leaves(cases)}
    if len(lengths) != 1 or lengths == {()}:
        raise ScenarioError(f"flights: leading axes {sorted(lengths)}; states and varied parts need one common length")
    return lengths.pop()[0]


def available_cores() -> int:
    """Count the cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
