"""What varies from run to run, and each run as drawn: a function of seed, name and run, whoever asks.

Every dispersed entry is a map from a few numbers between 0 and 1 to its value. Those numbers come from one of three
designs. `random` draws them from a generator of its own for each name, run and attempt (Philox, which counts), so that
run k is the same in a campaign of any length, and what one entry draws does not depend on which others vary.
`latin-hypercube` and `sobol` (scipy.stats.qmc, scrambled) lay out all runs together: run k then depends on the number
of runs too. A run as drawn is its scenario, where it starts and its mission, or why it cannot be flown.
"""

import difflib
import hashlib
import itertools
import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from pydantic import BaseModel
from scipy.special import ndtr, ndtri

from keepout.core.errors import KeepoutError, ScenarioError
from keepout.core.mission.build import Mission
from keepout.core.mission.scenario import COMPONENTS, Scenario, is_number, is_vector, with_entries
from keepout.core.mission.target import has_way_out, room_to_start
from keepout.core.mission.task_entries import DispersionEntry

ATTEMPTS = 100
"""How often a start is drawn before its run is refused."""

_FIXED = ("name", "seed", "campaign", "require")
"""Entries of the campaign as a whole: no run can have its own."""

Units = Float[np.ndarray, "runs dimensions"]
Kind = Literal["number", "vector", "other"]


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
    def _offsets(self) -> list[int]:
        """The place of each entry among the numbers of a design, and their number."""
        return list(itertools.accumulate((d.dimensions for d in self.dispersions), initial=0))

    @cached_property
    def _laid_out(self) -> Units:
        """The whole design: (runs, all dimensions)."""
        from scipy.stats import qmc  # takes long to import, and few campaigns need it

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
    if entry.sampling == "sobol":
        from scipy.stats import qmc

        if sum(d.dimensions for d in made) <= qmc.Sobol.MAXDIM:
            return Design(made, entry.sampling, scenario.seed, entry.runs)
        raise ScenarioError(f"campaign.sampling: sobol has at most {qmc.Sobol.MAXDIM} dimensions")
    return Design(made, entry.sampling, scenario.seed, entry.runs)


def refused_values(scenario: Scenario, design: Design) -> tuple[str, ...]:
    """Say which ends and choices of a campaign's dispersions no scenario can have, and why: runs with them are refused.

    Each is tried alone and as an entry: what the law or the mesh would refuse is not looked for.
    """
    said = []
    for one in design.dispersions:
        ends = np.repeat([[0.0], [1.0]], one.dimensions, axis=1)
        for value in map(_plain, one.values.of if isinstance(one.values, _Choice) else one.values(ends)):
            try:
                with_entries(scenario, {one.name: value})
            except KeepoutError as error:
                said.append(f"runs of the campaign with {one.name} = {value} are refused: {error}")
    return tuple(said)


def entry_kind(name: str) -> Kind:
    """Say what an entry holds: a `number`, a `vector` of three, or something `other`, such as a word.

    Args:
        name: dotted, as `chaser.mass`, `start.position`, `start.position.x` or `target.parameters.wing_angle`.

    Raises:
        ScenarioError: there is no such entry, or it is a whole table.

    """
    model: type[BaseModel] = Scenario
    parts = name.split(".")
    for place, part in enumerate(parts):
        field = model.model_fields.get(part)
        if field is None:
            near = difflib.get_close_matches(part, model.model_fields, n=1)
            hint = f"did you mean {near[0]}?" if near else f"valid: {', '.join(model.model_fields)}"
            raise ScenarioError(f"{name}: no such entry; {hint}")
        kind, rest = field.annotation, parts[place + 1 :]
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            model = kind
            continue
        if kind == dict[str, float] and len(rest) == 1:
            return "number"
        if is_vector(kind):
            if not rest:
                return "vector"
            if len(rest) == 1 and rest[0] in COMPONENTS:
                return "number"
            raise ScenarioError(f"{name}: no such entry; components of a vector are x, y and z")
        if rest:
            raise ScenarioError(f"{name}: no such entry; {'.'.join(parts[: place + 1])} is not a table")
        return "number" if is_number(kind) else "other"
    raise ScenarioError(
        f"{name}: a whole table; name one of {', '.join(f'{name}.{key}' for key in model.model_fields)}"
    )


def _dispersion(name: str, entry: DispersionEntry) -> Dispersion:
    try:
        kind = entry_kind(name)
    except ScenarioError as error:
        raise ScenarioError(f"campaign.dispersions: {error}") from None
    if entry.choice is not None:
        share = np.cumsum(entry.weights or [1.0] * len(entry.choice))
        # The last one with a weight takes all that rounding leaves.
        bounds = np.where(share >= share[-1], 1.0, share / share[-1])
        return Dispersion(name, 1, _Choice(entry.choice, tuple(bounds.tolist())))
    if kind == "other":
        raise ScenarioError(f"campaign.dispersions: {name}: not a number; only choice can vary it")
    if entry.sphere is not None:
        if kind != "vector":
            raise ScenarioError(f"campaign.dispersions: {name}: sphere is for vectors, and this is a number")
        least, largest = entry.sphere if isinstance(entry.sphere, tuple) else (entry.sphere, entry.sphere)
        return Dispersion(name, 2 if least == largest else 3, _Sphere(least, largest, entry.centre))
    ends = entry.uniform or entry.normal
    assert ends is not None
    # One standard deviation may be that of all components.
    told = ends[:1] if kind == "vector" and entry.normal is not None else ends
    if any(isinstance(end, tuple) != (kind == "vector") for end in told):
        needed = "two vectors of three" if kind == "vector" else "two numbers"
        raise ScenarioError(f"campaign.dispersions: {name}: {list(ends)}; needed are {needed}")
    first, second = np.asarray(ends[0], float), np.asarray(ends[1], float)
    law = _Uniform(first, second) if entry.normal is None else _Normal(first, second, entry.within)
    return Dispersion(name, max(first.size, 1), law)


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


@dataclass(frozen=True)
class Run:
    """One run as drawn.

    Attributes:
        number: its place among all runs.
        values: of what varies, by name.
        position: where it starts, m, body frame.
        velocity: likewise, m/s.
        drawn_again: how often its start was drawn again.
        mission: to be flown, made for the scenario's own start; None where it is refused.
        refusal: why it is refused, or empty.

    """

    number: int
    values: Mapping[str, Any]
    position: Float[np.ndarray, "3"]
    velocity: Float[np.ndarray, "3"]
    drawn_again: int
    mission: Mission | None
    refusal: str = ""

    @property
    def flown(self) -> Mission:
        """Its mission, of a run that is not refused."""
        assert self.mission is not None
        return self.mission

    @property
    def scenario(self) -> Scenario:
        """What is flown, the start as the law was made for."""
        return self.flown.scenario


def alike(runs: Sequence[Run], what: Callable[[Run], Hashable]) -> list[list[int]]:
    """Give the places of the runs that are flown, those that have the same of something together."""
    places: dict[Hashable, list[int]] = {}
    for place, run in enumerate(runs):
        if run.mission is not None:
            places.setdefault(what(run), []).append(place)
    return list(places.values())


def by_mission(runs: Sequence[Run]) -> list[list[int]]:
    """Give the places of the runs that are flown, those of one mission together."""
    return alike(runs, lambda run: id(run.mission))


def draw(
    scenario: Scenario, design: Design, prepared: Callable[[Scenario], Mission], first: int, last: int
) -> list[Run]:
    """Draw the runs from `first` up to `last`, each the same whichever others are drawn with it.

    Laws are made for the scenario's start; what is drawn for `start` says where the flight begins, no more. A drawn
    start that the chaser cannot begin at (too near the mesh, or no way out) is drawn again, or refused where the
    design is laid out over all runs.
    """
    drawn, runs = design.values(first, last), []
    for number in range(first, last):
        values = {name: _plain(of[number - first]) for name, of in drawn.items()}
        elsewhere = {name: value for name, value in values.items() if not name.startswith("start.")}
        mission, refusal = None, ""
        try:
            mission = prepared(with_entries(scenario, elsewhere) if elsewhere else scenario)
        except KeepoutError as error:
            refusal = str(error)
        runs.append(Run(number, values, *_start(scenario, values), 0, mission, refusal))
    if not any(dispersion.of_start for dispersion in design.dispersions):
        return runs
    for places in alike(runs, lambda run: id(run.flown.target)):
        distance = runs[places[0]].flown.target.distance
        away = distance.distance(np.stack([runs[place].position for place in places])).tolist()
        for place, far in zip(places, away):
            runs[place] = _that_can_start(scenario, design, runs[place], far)
    return runs


def _that_can_start(scenario: Scenario, design: Design, run: Run, away: float) -> Run:
    """Give a run whose start is so far (m) from the mesh, the start drawn again until it can be; or refused."""
    again = 0
    while reason := _unusable(run.flown, run.position, away):
        if not design.redraws or again >= ATTEMPTS:
            reason = f"start.position: {reason}" + (f" (draw {again + 1})" if again else "")
            return replace(run, mission=None, refusal=reason)
        again += 1
        fresh = design.start_values(run.number, again)
        values = {**run.values, **{name: _plain(value) for name, value in fresh.items()}}
        position, velocity = _start(scenario, values)
        away = float(run.flown.target.distance.distance(position[None])[0])
        run = replace(run, values=values, position=position, velocity=velocity, drawn_again=again)
    return run


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


def _start(scenario: Scenario, values: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    made = []
    for key in ("position", "velocity"):
        vector = np.array(values.get(f"start.{key}", getattr(scenario.start, key)), float)
        for axis, component in enumerate(COMPONENTS):
            vector[axis] = values.get(f"start.{key}.{component}", vector[axis])
        made.append(vector)
    return made[0], made[1]


def _unusable(mission: Mission, position: Float[np.ndarray, "3"], away: float) -> str:
    """Say why a chaser cannot start somewhere, `away` (m) from the mesh; or nothing."""
    room = room_to_start(mission.scenario)
    if not away > room:
        return f"{position.round(4).tolist()} m is {away:.3f} m from the mesh, and {room:.2f} m of room is needed"
    if not has_way_out(mission.scenario, mission.target, position, away):
        return f"{position.round(4).tolist()} m has no free way out of the target for the chaser"
    return ""
