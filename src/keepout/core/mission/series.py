"""What a campaign keeps of every flight over time: barrier, Lyapunov function, distance to the goal, speeds."""

import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from keepout.core.errors import ScenarioError
from keepout.core.whole_file import write_whole

Columns = Mapping[str, np.ndarray]


def _distance_to(columns: Columns, goal: Float[np.ndarray, "3"]) -> np.ndarray:
    return np.linalg.norm(columns["position"] - goal, axis=-1)


SERIES: dict[str, tuple[str, Callable[[Columns, Float[np.ndarray, "3"]], np.ndarray]]] = {
    "barrier": ("barrier", lambda columns, _: columns["barrier"]),
    "lyapunov": ("lyapunov", lambda columns, _: columns["lyapunov"]),
    "position_error": ("position", _distance_to),
    "speed": ("velocity", lambda columns, _: np.linalg.norm(columns["velocity"], axis=-1)),
    "axis_speed": ("velocity", lambda columns, _: np.abs(columns["velocity"]).max(axis=-1)),
}
"""The log column of each quantity, and how it is made of it.

h (m) and V₁ (m²) as the law gave them, ‖r − goal‖ (m), ‖v‖ and the largest |v_i| over the axes (m/s).
"""

MOST_NUMBERS = 32_000_000
"""A campaign's series hold at most about so many (128 MB as float32), unless a stride is given."""


@dataclass(frozen=True)
class FlightSeries:
    """Chosen quantities of every flight at common times.

    Attributes:
        time: s after the start: every `stride`-th control step, and the end.
        values: by name as in `SERIES`, (flights, samples) each, float32.
        stride: control steps from sample to sample.

    """

    time: Float[np.ndarray, "samples"]
    values: dict[str, Float[np.ndarray, "flights samples"]]
    stride: int

    def save(self, path: Path) -> None:
        """Write `time` and each quantity as an array of its name into an `.npz` file."""
        stream = io.BytesIO()
        np.savez_compressed(stream, allow_pickle=False, time=self.time, **self.values)
        write_whole(path, stream.getvalue())


class SeriesKeeper:
    """Collects the series of a campaign's flights as they land.

    Raises:
        ScenarioError: an unknown quantity, or a stride below 1.

    """

    def __init__(
        self,
        names: Sequence[str],
        *,
        flights: int,
        steps: int,
        period: float,
        goal: Sequence[float],
        stride: int | None = None,
    ) -> None:
        unknown = [name for name in names if name not in SERIES]
        if unknown:
            raise ScenarioError(f"series: {unknown[0]!r} is not known; valid: {', '.join(SERIES)}")
        if stride is not None and stride < 1:
            raise ScenarioError(f"series: a stride of {stride} control steps; it must be at least 1")
        self._stride = stride or max(1, -(-flights * (steps + 1) * len(names) // MOST_NUMBERS))
        rows = np.arange(0, steps + 1, self._stride)
        self._rows = rows if rows[-1] == steps else np.append(rows, steps)
        self._time = self._rows * period
        self._goal = np.asarray(goal, float)
        self._values = {name: np.full((flights, len(self._rows)), np.nan, np.float32) for name in names}

    @property
    def columns(self) -> tuple[str, ...]:
        """Log columns that it needs."""
        return tuple(dict.fromkeys(SERIES[name][0] for name in self._values))

    def land(self, first: int, columns: Columns) -> None:
        """Take what it keeps from the columns of flights that landed, (flights, steps + 1, ...) each."""
        taken = {name: columns[name][:, self._rows] for name in self.columns}
        for name, kept in self._values.items():
            values = SERIES[name][1](taken, self._goal)
            kept[first : first + len(values)] = values

    def kept(self) -> FlightSeries:
        """Give what was collected; flights that did not land are not numbers."""
        return FlightSeries(self._time, self._values, self._stride)
