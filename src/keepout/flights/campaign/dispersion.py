"""What varies from run to run, and the values of each run: a function of seed, name and run, whoever asks.

Every dispersed entry is a map from a few numbers between 0 and 1 to its value. Those numbers come from one of three
designs. `random` draws them from a generator of its own for each name, run and attempt (Philox, which counts), so that
run k is the same in a campaign of any length, and what one entry draws does not depend on which others vary.
`latin-hypercube` and `sobol` (scipy.stats.qmc, scrambled) lay out all runs together: run k then depends on the number
of runs too.
"""

import hashlib
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.special import ndtr, ndtri
from scipy.stats import qmc

from keepout.core.errors import ScenarioError
from keepout.core.mission.scenario import COMPONENTS, Scenario, entry_kind
from keepout.core.mission.task_entries import DispersionEntry

_FIXED = ("name", "seed", "campaign")
"""Entries of the campaign as a whole: no run can have its own."""

Units = Float[np.ndarray, "runs dimensions"]


@dataclass(frozen=True)
class Dispersion:
    """One entry that varies.

    Attributes:
        name: of the entry, dotted.
        dimensions: how many numbers between 0 and 1 make a value.
        values: from such numbers (runs, dimensions) to one value a run: (runs,), (runs, 3), or a list.

    """

    name: str
    dimensions: int
    values: Callable[[Units], Any]

    @property
    def of_start(self) -> bool:
        """Whether it says where a flight starts, and so can be drawn again where nothing can start."""
        return self.name.startswith("start.position")


@dataclass(frozen=True)
class Design:
    """All that varies in a campaign, and how it is drawn.

    Attributes:
        dispersions: one an entry, sorted by name.
        sampling: "random", "latin-hypercube" or "sobol".
        seed: of all draws.
        runs: how many there are; only the last two designs depend on it.

    """

    dispersions: tuple[Dispersion, ...]
    sampling: str
    seed: int
    runs: int
    _offsets: tuple[int, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Give each entry its place among the numbers of a design."""
        sizes = [dispersion.dimensions for dispersion in self.dispersions]
        object.__setattr__(self, "_offsets", tuple(int(n) for n in np.cumsum([0, *sizes])))

    @property
    def redraws(self) -> bool:
        """Whether a start that cannot be is drawn again; in a design over all runs its place would then be missing."""
        return self.sampling == "random"

    def values(self, first: int, last: int, attempt: int = 0) -> dict[str, Any]:
        """Give what each entry is in the runs from `first` up to `last`: one value a run.

        Args:
            first: the first run.
            last: the run after the last one.
            attempt: 0, or how often the starts of these runs were drawn before.

        """
        return {d.name: d.values(self._units(i, first, last, attempt)) for i, d in enumerate(self.dispersions)}

    def start_values(self, run: int, attempt: int) -> dict[str, Any]:
        """Give what the entries of the start are in one run when drawn again for the `attempt`-th time."""
        chosen = [(i, d) for i, d in enumerate(self.dispersions) if d.of_start]
        return {d.name: d.values(self._units(i, run, run + 1, attempt))[0] for i, d in chosen}

    def _units(self, place: int, first: int, last: int, attempt: int) -> Units:
        dispersion = self.dispersions[place]
        if self.sampling != "random":
            return self._laid_out[first:last, self._offsets[place] : self._offsets[place + 1]]
        mark = int.from_bytes(hashlib.sha256(dispersion.name.encode()).digest()[:8], "little")
        key = np.array([self.seed, mark], np.uint64)
        units = np.empty((last - first, dispersion.dimensions))
        for run in range(first, last):
            source = np.random.Philox(key=key, counter=np.array([0, 0, attempt, run], np.uint64))
            units[run - first] = np.random.Generator(source).random(dispersion.dimensions)
        return units

    @cached_property
    def _laid_out(self) -> Units:
        """The whole design: (runs, all dimensions)."""
        dimensions = self._offsets[-1]
        source = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(1,)))
        if self.sampling == "latin-hypercube":
            return qmc.LatinHypercube(dimensions, rng=source).random(self.runs)
        # A power of two is drawn, for which the sequence is balanced, and its beginning used.
        return qmc.Sobol(dimensions, rng=source).random_base2(max(self.runs - 1, 1).bit_length())[: self.runs]


def design(scenario: Scenario) -> Design:
    """Read what a scenario's campaign varies; without dispersions, the start in its box.

    Raises:
        ScenarioError: a name that does not exist or cannot vary, or a dispersion that does not fit its entry.

    """
    entry = scenario.campaign
    given = entry.dispersions or {"start.position": DispersionEntry(uniform=(entry.lower, entry.upper))}
    for name in given:
        if name.split(".")[0] in _FIXED:
            raise ScenarioError(f"campaign.dispersions: {name}: one for the whole campaign; it cannot vary")
        parent = name.rpartition(".")[0]
        if parent in given:
            raise ScenarioError(f"campaign.dispersions: {name} and {parent} both; a vector or its components vary")
    made = tuple(_dispersion(name, given[name]) for name in sorted(given))
    if entry.sampling == "sobol" and sum(d.dimensions for d in made) > qmc.Sobol.MAXDIM:
        raise ScenarioError(f"campaign.sampling: sobol has at most {qmc.Sobol.MAXDIM} dimensions")
    return Design(made, entry.sampling, scenario.seed, entry.runs)


def _dispersion(name: str, entry: DispersionEntry) -> Dispersion:
    try:
        kind = entry_kind(name)
    except ScenarioError as error:
        raise ScenarioError(f"campaign.dispersions: {error}") from None
    if entry.choice is not None:
        return _choice(name, entry.choice, entry.weights)
    if kind == "other":
        raise ScenarioError(f"campaign.dispersions: {name}: not a number; only choice can vary it")
    if entry.sphere is not None:
        if kind != "vector":
            raise ScenarioError(f"campaign.dispersions: {name}: sphere is for vectors, and this is a number")
        return _sphere(name, entry.sphere, entry.centre)
    ends = entry.uniform or entry.normal
    assert ends is not None
    # One standard deviation may be that of all components.
    told = ends[:1] if kind == "vector" and entry.normal is not None else ends
    if any(isinstance(end, tuple) != (kind == "vector") for end in told):
        needed = "two vectors of three" if kind == "vector" else "two numbers"
        raise ScenarioError(f"campaign.dispersions: {name}: {list(ends)}; needed are {needed}")
    first, second = np.asarray(ends[0], float), np.asarray(ends[1], float)
    if entry.normal is not None:
        return _normal(name, first, second, entry.within)
    return _uniform(name, first, second)


@dataclass(frozen=True)
class _Uniform:
    low: np.ndarray
    high: np.ndarray

    def __call__(self, units: Units) -> np.ndarray:
        return _shaped(self.low + units * (self.high - self.low), self.low)


@dataclass(frozen=True)
class _Normal:
    mean: np.ndarray
    deviation: np.ndarray
    within: float

    def __call__(self, units: Units) -> np.ndarray:
        tail = float(ndtr(-self.within))
        sizes = np.clip(ndtri(tail + units * (1.0 - 2.0 * tail)), -self.within, self.within)
        return _shaped(self.mean + self.deviation * sizes, self.mean)


@dataclass(frozen=True)
class _Choice:
    of: tuple[Any, ...]
    up_to: tuple[float, ...]

    def __call__(self, units: Units) -> list[Any]:
        places = np.searchsorted(self.up_to, units[:, 0], side="right")
        return [self.of[place] for place in places]


@dataclass(frozen=True)
class _Sphere:
    least: float
    largest: float
    centre: tuple[float, float, float]

    def __call__(self, units: Units) -> np.ndarray:
        up, around = 2.0 * units[:, 0] - 1.0, 2.0 * math.pi * units[:, 1]
        flat = np.sqrt(np.maximum(1.0 - up**2, 0.0))
        direction = np.stack([flat * np.cos(around), flat * np.sin(around), up], axis=1)
        length = self.least + (units[:, 2] * (self.largest - self.least) if units.shape[1] > 2 else 0.0)
        return np.asarray(self.centre) + np.broadcast_to(length, len(units))[:, None] * direction


def _shaped(values: np.ndarray, like: np.ndarray) -> np.ndarray:
    return values if like.ndim else values[:, 0]


def _uniform(name: str, low: np.ndarray, high: np.ndarray) -> Dispersion:
    return Dispersion(name, max(low.size, 1), _Uniform(low, high))


def _normal(name: str, mean: np.ndarray, deviation: np.ndarray, within: float) -> Dispersion:
    return Dispersion(name, max(mean.size, 1), _Normal(mean, deviation, within))


def _choice(name: str, of: tuple[Any, ...], weights: tuple[float, ...] | None) -> Dispersion:
    share = np.cumsum(weights or [1.0] * len(of))
    # The last one with a weight takes all that rounding leaves.
    bounds = np.where(share >= share[-1], 1.0, share / share[-1])
    return Dispersion(name, 1, _Choice(of, tuple(bounds.tolist())))


def _sphere(name: str, sphere: float | tuple[float, float], centre: tuple[float, float, float]) -> Dispersion:
    least, largest = sphere if isinstance(sphere, tuple) else (sphere, sphere)
    return Dispersion(name, 2 if least == largest else 3, _Sphere(least, largest, centre))


def columns(dispersion: Dispersion, values: Any) -> dict[str, np.ndarray]:
    """Lay the values of one entry out as table columns: numbers, three columns for vectors, or text for the rest.

    Which of them does not depend on the values at hand, so that all parts of a table have the same columns.
    """
    name, like = dispersion.name, dispersion.values
    all_ = like.of if isinstance(like, _Choice) else values
    if all(isinstance(value, tuple | list | np.ndarray) and np.shape(value) == (3,) for value in all_):
        array = np.asarray(values, float).reshape(-1, 3)
        return {f"{name}.{axis}": array[:, k] for k, axis in enumerate(COMPONENTS)}
    if all(isinstance(value, int | float) and not isinstance(value, bool) for value in all_):
        return {name: np.asarray(values, float)}
    return {name: np.array([str(value) for value in values], object)}
