"""Quantiles over time of what all flights of a campaign do, without keeping the flights.

Each quantity is counted at common times into bins that never move: logarithmic in size, on both sides of zero. Counts
add up, in any order and exactly, so that what many parts of a campaign counted is what one would have. A quantile read
off lies within 1 % of the true one (`RELATIVE`), or within 1e-6 of it (`LEAST`) where that is more; the least and the
largest value are kept as they are.
"""

import io
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt

from keepout.core.errors import FlightError

Columns = Mapping[str, np.ndarray]
"""Columns of the log of some flights, each (flights, steps + 1, ...)."""

SERIES: dict[str, tuple[str, Callable[[np.ndarray, Float[np.ndarray, "flights 3"]], np.ndarray]]] = {
    "barrier": ("barrier", lambda barrier, _: barrier),
    "lyapunov": ("lyapunov", lambda lyapunov, _: lyapunov),
    "position_error": ("position", lambda position, goals: np.linalg.norm(position - goals[:, None], axis=-1)),
    "speed": ("velocity", lambda velocity, _: np.linalg.norm(velocity, axis=-1)),
    "axis_speed": ("velocity", lambda velocity, _: np.abs(velocity).max(axis=-1)),
}
"""The log column of each quantity over time, and how it is made of it and of the flights' goals.

h (m) and V₁ (m²) as the law gave them, ‖r − goal‖ (m), ‖v‖ and the largest |v_i| over the axes (m/s).
"""
QUANTITIES = ("barrier", "lyapunov", "position_error", "speed")
"""Those of `SERIES` that have bands."""
COLUMNS = tuple(SERIES[name][0] for name in QUANTITIES)

RELATIVE, LEAST, LARGEST = 0.01, 1e-6, 1e9
_GROWTH = math.log((1.0 + RELATIVE) / (1.0 - RELATIVE))
_SIDE = math.ceil(math.log(LARGEST / LEAST) / _GROWTH) + 1
BINS = 2 * _SIDE + 1
"""Bins of each quantity at each time: `_SIDE` of negative numbers, one about zero, `_SIDE` of positive ones."""
SAMPLES = 121
"""Times at most."""
SHARES = (0.0, 0.05, 0.25, 0.5, 0.75, 0.95, 1.0)
"""Quantiles that files and pages have."""


@dataclass(frozen=True, eq=False)
class Bands:
    """Counts of each of `QUANTITIES` (first axis) at each time, of all flights counted so far.

    Attributes:
        time: s after the start.
        counts: flights in each bin.
        lost: flights whose value was not a number.
        least: the smallest value; infinite without flights.
        largest: likewise.

    """

    time: Float[np.ndarray, "samples"]
    counts: Int[np.ndarray, "quantities samples bins"]
    lost: Int[np.ndarray, "quantities samples"]
    least: Float[np.ndarray, "quantities samples"]
    largest: Float[np.ndarray, "quantities samples"]

    @classmethod
    def empty(cls, duration: float, period: float) -> "Bands":
        """Begin with no flights: control times spread evenly over `duration` (s), with its end, `SAMPLES` at most."""
        steps = round(duration / period)
        rows = np.unique(np.rint(np.linspace(0, steps, min(steps + 1, SAMPLES))).astype(int))
        shape = (len(QUANTITIES), len(rows))
        return cls(
            rows * period,
            np.zeros((*shape, BINS), np.int64),
            np.zeros(shape, np.int64),
            np.full(shape, np.inf),
            np.full(shape, -np.inf),
        )

    def count(self, columns: Columns, goals: Float[np.ndarray, "flights 3"], period: float) -> None:
        """Count flights in, by their log columns (flights, steps + 1, ...) and goals (m).

        Each time takes the row nearest to it; a flight that has ended by then is not counted there.
        """
        rows = np.rint(self.time / period).astype(int)
        here = np.flatnonzero(rows < columns["position"].shape[1])
        rows = rows[here]
        for k, name in enumerate(QUANTITIES):
            of = quantity(name, columns, rows, goals)
            known = ~np.isnan(of)
            self.lost[k, here] += np.sum(~known, axis=0)
            self.least[k, here] = np.minimum(self.least[k, here], np.where(known, of, np.inf).min(axis=0))
            self.largest[k, here] = np.maximum(self.largest[k, here], np.where(known, of, -np.inf).max(axis=0))
            at = np.broadcast_to(here, of.shape)[known]
            np.add.at(self.counts[k], (at, _bin(of[known])), 1)

    def add_bytes(self, content: bytes) -> None:
        """Add what was counted elsewhere and `to_bytes` gave, touching only the bins that are in use there.

        Raises:
            FlightError: other times.

        """
        with np.load(io.BytesIO(content), allow_pickle=False) as kept:
            if not np.array_equal(self.time, kept["time"]):
                raise FlightError("bands: counted at other times; they belong to another campaign")
            used = np.cumsum(kept["gaps"], dtype=np.int64)
            self.counts.reshape(-1)[used] += kept["counts"]  # no bin stands there twice
            self.lost[...] += kept["lost"]
            np.minimum(self.least, kept["least"], out=self.least)
            np.maximum(self.largest, kept["largest"], out=self.largest)

    def quantiles(self, name: str, shares: Sequence[float]) -> Float[np.ndarray, "shares samples"]:
        """Give quantiles over time: of n values that of rank ⌈q n⌉, within the bounds that the module states.

        Args:
            name: one of `QUANTITIES`.
            shares: q, each from 0 (the least value) to 1 (the largest).

        Returns:
            Not a number at times without flights.

        """
        k = QUANTITIES.index(name)
        summed = np.cumsum(self.counts[k], axis=1)
        total = summed[:, -1]
        found = np.full((len(shares), len(self.time)), np.nan)
        for i, share in enumerate(shares):
            rank = np.clip(np.ceil(share * total), 1, None)
            place = np.argmax(summed >= rank[:, None], axis=1)
            found[i] = np.clip(_middle(place), self.least[k], self.largest[k])
            if share <= 0.0 or share >= 1.0:
                found[i] = self.least[k] if share <= 0.0 else self.largest[k]
        found[:, total == 0] = np.nan
        return found

    def figures(self) -> dict[str, Any]:
        """Give the quantiles over time of every quantity for JSON; see `quantiles` for what they are within."""
        over_time = {name: self.quantiles(name, SHARES) for name in QUANTITIES}
        return {
            "time_s": self.time.tolist(),
            "shares": list(SHARES),
            **{
                name: [[x if math.isfinite(x) else None for x in row.tolist()] for row in of]
                for name, of in over_time.items()
            },
        }

    def to_bytes(self) -> bytes:
        """Give the content of an `.npz` file; of the counts only the bins in use, and how far each is from the last."""
        counts = self.counts.reshape(-1)
        used = np.flatnonzero(counts)
        stream = io.BytesIO()
        np.savez_compressed(
            stream,
            allow_pickle=False,
            time=self.time,
            gaps=_small(np.diff(used, prepend=0)),
            counts=_small(counts[used]),
            lost=self.lost,
            least=self.least,
            largest=self.largest,
        )
        return stream.getvalue()


def quantity(
    name: str, columns: Columns, rows: Int[np.ndarray, "samples"], goals: Float[np.ndarray, "flights 3"]
) -> Float[np.ndarray, "flights samples"]:
    """Give one of `SERIES` of flights in some rows of their log, by their goals (m)."""
    column, make = SERIES[name]
    return make(columns[column][:, rows], goals)


def _small(numbers: Int[np.ndarray, "n"]) -> UInt[np.ndarray, "n"]:
    """Give numbers from 0 on in as few bytes each as hold them all."""
    return numbers.astype(np.min_scalar_type(numbers.max(initial=0)))


def _bin(values: Float[np.ndarray, "n"]) -> Int[np.ndarray, "n"]:
    """Bins of numbers; those beyond the last fall into it."""
    size = np.clip(np.abs(values), LEAST, LARGEST)
    steps = np.floor(np.log(size / LEAST) / _GROWTH).astype(int) + 1
    steps = np.where(np.abs(values) < LEAST, 0, np.minimum(steps, _SIDE))
    return _SIDE + np.where(values < 0.0, -steps, steps)


def _middle(bins: Int[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Give the number of each bin that no other in it is further from, relative to itself, than `RELATIVE`."""
    steps = np.abs(bins - _SIDE)
    size = LEAST * np.exp(_GROWTH * (steps - 1)) * (1.0 + RELATIVE)
    return np.where(steps == 0, 0.0, np.sign(bins - _SIDE) * size)
