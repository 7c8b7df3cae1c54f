"""Scenarios: one typed tree, one TOML file; and their entries by dotted name, as `chaser.mass`.

Every entry is in SI units. A value outside its range, an unknown key or a missing one is refused with the entry's name,
the value, and what would be valid; nothing is guessed.
"""

import difflib
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin

from pydantic import BaseModel, Field, ValidationError, model_validator
from pydantic.fields import FieldInfo

from keepout.core.errors import ScenarioError
from keepout.core.mission import entries, task_entries
from keepout.core.mission.entries import Entry, Epoch, Vector

COMPONENTS = ("x", "y", "z")
Keys = tuple[Any, ...]
"""Keys from the outermost table to an entry; places in an array are numbers."""
_SHOWN = 200
"""Characters shown of a value that is refused, and bits of a whole number."""

_ESTIMATE_FAULTS = tuple(f"{of}_{kind}" for kind in ("bias", "noise", "noise_std") for of in ("position", "velocity"))
"""Entries of `faults` that put errors on a state that no sensor measured."""


class _RefusedAsOthers(type(Entry)):
    """Makes `Scenario(chaser={"mass": -1})` the refusal that `Scenario.parse` gives.

    Not an `__init__`, which pydantic's own validation would call too.
    """

    def __call__(cls, *args, **entries):
        try:
            return super().__call__(*args, **entries)
        except ValidationError as error:
            raise _refusal(error, "scenario") from None


class Scenario(Entry, metaclass=_RefusedAsOthers):
    """One mission: target, chaser, law, environment, start and goal. The defaults are the source paper's Case 1.

    Attributes:
        name: Letters, digits, `_`, `.` and `-`; first a letter or digit.
        seed: Of all random numbers.
        duration: Time flown, s; at least one control period.
        epoch: UTC at the start, for exports and the sun.
        leg: Hold points in their order; the last one is the goal.
        zone: Room that nobody may enter.
        corridor: Ways out of ports, beside which nobody may be.

    """

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")] = "case1"
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    duration: Annotated[float, Field(gt=0.0, le=1e6, allow_inf_nan=False)] = 1500.0
    epoch: Epoch = "2026-01-01T00:00:00Z"
    target: entries.TargetEntry = entries.TargetEntry()
    field: entries.FieldEntry = entries.FieldEntry()
    chaser: entries.ChaserEntry = entries.ChaserEntry()
    thrusters: entries.ThrustersEntry = entries.ThrustersEntry()
    safety: entries.SafetyEntry = entries.SafetyEntry()
    guard: entries.GuardEntry = entries.GuardEntry()
    control: entries.ControlEntry = entries.ControlEntry()
    orbit: entries.OrbitEntry = entries.OrbitEntry()
    drag: entries.DragEntry = entries.DragEntry()
    sun: entries.SunEntry = entries.SunEntry()
    attitude: entries.AttitudeEntry = entries.AttitudeEntry()
    disturbance: entries.DisturbanceEntry = entries.DisturbanceEntry()
    navigation: entries.NavigationEntry = entries.NavigationEntry()
    faults: entries.FaultsEntry = entries.FaultsEntry()
    start: entries.StateEntry = entries.StateEntry()
    goal: entries.GoalEntry = entries.GoalEntry()
    leg: tuple[task_entries.LegEntry, ...] = ()
    zone: tuple[task_entries.ZoneEntry, ...] = ()
    corridor: tuple[task_entries.CorridorEntry, ...] = ()
    approach: task_entries.ApproachEntry = task_entries.ApproachEntry()
    campaign: task_entries.CampaignEntry = task_entries.CampaignEntry()
    require: task_entries.RequireEntry = task_entries.RequireEntry()
    rare: task_entries.RareEntry = task_entries.RareEntry()
    depth_sensor: task_entries.DepthSensorEntry = task_entries.DepthSensorEntry()
    map: task_entries.MapEntry = task_entries.MapEntry()
    explore: task_entries.ExploreEntry = task_entries.ExploreEntry()
    camera: task_entries.CameraEntry = task_entries.CameraEntry()
    light: task_entries.LightEntry = task_entries.LightEntry()
    inspect: task_entries.InspectEntry = task_entries.InspectEntry()

    @model_validator(mode="before")
    @classmethod
    def _last_leg_is_goal(cls, tree: Any) -> Any:
        """Let the goal follow from the legs where it is not given."""
        legs = tree.get("leg") if isinstance(tree, Mapping) else None
        if not legs or "goal" in tree or not isinstance(legs, list | tuple):
            return tree
        last = legs[-1].model_dump() if isinstance(legs[-1], Entry) else legs[-1]
        if not isinstance(last, Mapping) or "position" not in last:
            return tree
        tolerance = last.get("tolerance", task_entries.LegEntry.model_fields["tolerance"].default)
        return {**tree, "goal": {"position": last["position"], "tolerance": tolerance}}

    def _contradictions(self) -> Iterator[str]:
        yield from self._wrong_approach()
        if self.duration < self.control.period:
            yield f"duration {self.duration} s is shorter than one control period, {self.control.period} s"
        if self.faults.stuck_force > self.chaser.force_limit:
            yield (
                f"faults.stuck_force {self.faults.stuck_force} N is more than chaser.force_limit, "
                f"{self.chaser.force_limit} N; a stuck thruster gives from 0 to that"
            )
        ideal, period, shortest = self.thrusters.layout == "ideal", self.control.period, self.thrusters.least_on_time
        if not ideal and self.faults.stuck is not None:
            yield 'faults.stuck is for thrusters.layout = "ideal"; use faults.thruster, its number'
        if not ideal and shortest > period:
            yield (
                f"thrusters.least_on_time {shortest} s is longer than the control period, {period} s; no pulse fits in"
            )
        told = [f"guard.{key}" for key in ("position_error", "velocity_error") if getattr(self.guard, key)]
        told += [f"faults.{key}" for key in _ESTIMATE_FAULTS if getattr(self.faults, key)]
        if told and self.navigation.suite != "none":
            yield (
                f"{', '.join(told)}: of an estimate without sensors, and navigation.suite is "
                f'"{self.navigation.suite}", which has errors of its own; leave them out'
            )

    def _wrong_approach(self) -> Iterator[str]:
        """Say what in legs and zones goes together neither among them nor with the rest."""
        said = any(leg.until == "go" for leg in self.leg)
        for number, leg in enumerate(self.leg):
            if leg.axes not in ("body", self.attitude.kind):
                yield (
                    f'leg.{number}.axes: "{leg.axes}", and attitude.kind is "{self.attitude.kind}": the place would '
                    'move over the target; give it in "body" axes'
                )
            if leg.speed_limit is not None and leg.speed_limit > self.chaser.speed_limit:
                limit = self.chaser.speed_limit
                yield f"leg.{number}.speed_limit: {leg.speed_limit} m/s is more than chaser.speed_limit, {limit} m/s"
            if leg.drift_safe and self.approach.abort_time is None:
                yield f"leg.{number}.drift_safe: for how long a drift must be safe is approach.abort_time; it is unset"
            if leg.within is not None and leg.within[0] >= self.duration:
                yield f"leg.{number}.within: begins at {leg.within[0]} s, and the flight ends at {self.duration} s"
        if self.leg and self.leg[-1].until == "go":
            yield f"leg.{len(self.leg) - 1}.until: the last leg leads to the goal, and nothing is flown after it"
        for number, zone in enumerate(self.zone):
            if zone.until == "go" and not said:
                yield f'zone.{number}.until: "go", and no leg has until = "go"; give the zone a time, or leave it out'
        if self.leg and (self.goal.position, self.goal.tolerance) != (self.leg[-1].position, self.leg[-1].tolerance):
            yield (
                f"goal.position: {list(self.goal.position)} within {self.goal.tolerance} m, and the last leg leads to "
                f"{list(self.leg[-1].position)} within {self.leg[-1].tolerance} m; leave goal out"
            )

    @property
    def steps(self) -> int:
        """Whole control periods flown: the duration's, rounded to the nearest."""
        return round(self.duration / self.control.period)

    @classmethod
    def parse(cls, tree: dict[str, Any], *, where: str = "scenario", text: str | None = None) -> "Scenario":
        """Validate a nested dictionary.

        Args:
            tree: tables and entries.
            where: what a refusal begins with, such as the file's name.
            text: the TOML that the tree was read from; a refusal then names the lines.

        Raises:
            ScenarioError: an entry is unknown, missing or out of range; names all of them in one line.

        """
        try:
            return cls.model_validate(tree)
        except ValidationError as error:
            raise _refusal(error, where, {} if text is None else entry_lines(text)) from None

    @classmethod
    def of(cls, given: Any) -> "Scenario":
        """Give a scenario as it is, the one in a file, or the one of nested tables.

        Args:
            given: a `ScenarioLike`.

        Raises:
            ScenarioError: it is refused, or it is none of these.

        """
        if isinstance(given, cls):
            return given
        if isinstance(given, Mapping):
            return cls.parse(dict(given))
        if isinstance(given, str | Path):
            return cls.load(given)
        valid = "a Scenario, the path of its TOML file, or its tables as a dict"
        raise ScenarioError(f"scenario: {type(given).__name__}; it must be {valid}")

    @classmethod
    def load(cls, path: str | Path) -> "Scenario":
        """Read a TOML file; paths inside it are relative to it.

        Args:
            path: of the file.

        Raises:
            ScenarioError: the file is missing, not TOML, or has an invalid entry.

        """
        path = Path(path)
        try:
            text = path.read_text(encoding="utf-8")
            tree = tomllib.loads(text)
        except OSError as error:
            raise ScenarioError(f"{path}: cannot be read ({error.strerror}); give a scenario in TOML") from None
        except UnicodeDecodeError:
            raise ScenarioError(f"{path}: not a text file; give a scenario in TOML") from None
        except RecursionError:
            raise ScenarioError(f"{path}: not valid TOML: arrays or tables too deep within each other") from None
        except ValueError as error:  # of TOML, or of a number with more digits than Python reads
            raise ScenarioError(" ".join(f"{path}: not valid TOML: {error}".split())) from None
        return cls.parse(tree, where=str(path), text=text).resolved(path.parent)

    def replace(self, **entries: Any) -> "Scenario":
        """Return a copy with whole tables or single entries replaced, as in `replace(seed=1, goal={"position": …})`.

        Args:
            **entries: by name; of a table those entries that are given, the others stay.

        Raises:
            ScenarioError: a new value is invalid.

        """
        tree = self.model_dump()
        for key, value in entries.items():
            if isinstance(value, dict) and isinstance(tree.get(key), dict):
                tree[key] = tree[key] | value
            else:
                tree[key] = value
        return type(self).parse(tree)

    def resolved(self, folder: Path) -> "Scenario":
        """Make file names absolute, so that a scenario means the same wherever it is run from.

        Args:
            folder: that file names are relative to.

        """
        changes: dict[str, Any] = {}
        for table, key in (("target", "source"), ("field", "source"), ("map", "file"), ("explore", "expected")):
            source = getattr(getattr(self, table), key)
            if source and Path(source).suffix and not Path(source).is_absolute():
                changes[table] = {key: str((folder / source).resolve())}
        if any(zone.file for zone in self.zone):
            at = [{"file": str((folder / zone.file).resolve())} if zone.file else {} for zone in self.zone]
            changes["zone"] = [zone.model_dump() | file for zone, file in zip(self.zone, at, strict=True)]
        return self.replace(**changes) if changes else self


ScenarioLike = Scenario | str | Path | Mapping[str, Any]
"""What a scenario is taken from: itself, the path of its TOML file, or its tables as a dict."""


def _refusal(error: ValidationError, where: str, lines: Mapping[Keys, int] = {}) -> ScenarioError:
    """Say all that pydantic found in one line, whatever was given: a key may hold a line break."""
    found: dict[str, dict[str, None]] = {}
    for item in error.errors():
        given, valid = _reason(item)
        found.setdefault(f"{_line(item, lines)}{given}", {})[valid] = None
    reasons = "; ".join(given + " or ".join(valid) for given, valid in found.items())
    return ScenarioError(" ".join(f"{where}: {reasons}".split()))


def _reason(item: Any) -> tuple[str, str]:
    """Turn one pydantic finding into the entry's name with the value, and what would be valid."""
    path = [part for part in item["loc"] if not _BRANCH.search(str(part))]
    value, kind = item["input"], item["type"]
    if kind == "extra_forbidden":
        valid, key = _valid_keys(item["loc"][:-1]), str(item["loc"][-1])
        near = difflib.get_close_matches(key, valid, n=1) + _elsewhere(key, item["loc"])
        hint = f"did you mean {' or '.join(near)}?" if near else f"valid: {', '.join(valid)}"
        return f"{_dotted(path)}: no such entry; {hint}", ""
    if kind == "missing" and isinstance(path[-1], int):  # of a list
        return f"{_dotted(path[:-1])}: {_shown(value)} ", "has too few values"
    plain = item["msg"].removeprefix("Value error, ").removeprefix("Input ").replace("should be", "must be")
    message = _VALID[kind].format(**item.get("ctx", {})) if kind in _VALID else plain
    shown = "" if isinstance(value, dict | BaseModel) else f"{_shown(value)} "
    return (f"{_dotted(path)}: {shown}", message) if path else ("", message)


_VALID: Mapping[str, str] = {
    "missing": "must be given",
    **dict.fromkeys(("float_type", "float_parsing"), "must be a number"),
    **dict.fromkeys(("int_type", "int_from_float", "int_parsing"), "must be a whole number"),
    "bool_type": "must be true or false",
    "string_type": "must be text",
    "string_pattern_mismatch": "must be of letters, digits, _, . and -, a letter or digit first",
    "tuple_type": "must be a list",
    "too_long": "has too many values; at most {max_length}",
    "finite_number": "must be finite",
    "greater_than_equal": "must be at least {ge}",
    "less_than_equal": "must be at most {le}",
    **dict.fromkeys(("dict_type", "model_type", "model_attributes_type"), "must be a table"),
}
"""What would be valid, by the kind of pydantic's finding; other kinds say so themselves."""
_BRANCH = re.compile(r"^(constrained-)?(float|int|str|bool)$|^[a-z-]+\[")
"""What pydantic calls one of several kinds that an entry may have: no part of its name."""


def _dotted(path: Sequence[str | int]) -> str:
    return ".".join(map(str, path))


def _shown(value: Any) -> str:
    """Write a value that was refused, however large it is."""
    if isinstance(value, int) and value.bit_length() > _SHOWN:
        return f"an integer of {value.bit_length()} bits"
    text = repr(value)
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}…"


def _valid_keys(location: Keys) -> list[str]:
    """Name the entries of the table at a location in a scenario's tree; none where there is no table."""
    kind: Any = Scenario
    for part in location:
        if get_origin(kind) is tuple:  # a place in a list of tables
            kind = get_args(kind)[0]
        elif kind == dict[str, task_entries.DispersionEntry]:  # the name of what is dispersed
            kind = task_entries.DispersionEntry
        else:
            kind = kind.model_fields[str(part)].annotation
    return list(kind.model_fields) if is_table(kind) else []


def _elsewhere(key: str, location: Keys) -> list[str]:
    """Give the full names of entries of that very name in other tables, such as `safety.margin` for `chaser.margin`."""
    named = (name for name, _ in entries_and_tables() if name.count(".") < 2 and name.rpartition(".")[2] == key)
    return [name for name in named if name != key or len(location) > 1]


def _line(item: Any, lines: Mapping[Keys, int]) -> str:
    """Say on which line the entry of a finding, or the closest table around it, stands, where that is known."""
    path = item["loc"]
    if item["type"] == "value_error":  # of a whole table: its message begins with the entry, unless it is about several
        first = item["msg"].removeprefix("Value error, ").split()[0].rstrip(":,")
        path = (*path, *first.split(".")) if (*path, *first.split(".")) in lines else path
    found = next((lines[path[:length]] for length in range(len(path), 0, -1) if path[:length] in lines), None)
    return "" if found is None else f"line {found}: "


def entry_lines(text: str) -> dict[Keys, int]:
    """Give the line, counted from 1, on which each table and entry of a valid TOML text begins.

    TOML is made of statements of whole lines, a header or a `key = value`, and no part of one is a statement. So lines
    are gathered until the TOML reader itself takes them; there is no second grammar here.
    """
    lines: dict[Keys, int] = {}
    header: Keys = ()
    counts: dict[Keys, int] = {}
    gathered, first = "", 0
    for number, line in enumerate(text.replace("\r\n", "\n").split("\n"), start=1):
        if not gathered:
            first = number
        gathered = f"{gathered}\n{line}" if gathered else line
        try:
            tree = tomllib.loads(gathered)
        except tomllib.TOMLDecodeError:
            continue
        if tree and gathered.lstrip().startswith("["):
            header = _header(tree, counts)
            for length in range(1, len(header) + 1):  # a table is there from the first header that names it
                lines.setdefault(header[:length], first)
        else:
            _note_lines(tree, header, first, lines)
        gathered = ""
    return lines


def _header(tree: dict[str, Any], counts: dict[Keys, int]) -> Keys:
    """Give the path that a header opens; of an array of tables with the place of the table in it."""
    path: Keys = ()
    inner: Any = tree
    while inner:
        if isinstance(inner, list):
            counts[path] = counts.get(path, -1) + 1
            return (*path, counts[path])
        [(key, inner)] = inner.items()
        path = (*path, key)
    return path


def _note_lines(tree: Any, path: Keys, number: int, lines: dict[Keys, int]) -> None:
    for key, value in tree.items() if isinstance(tree, dict) else enumerate(tree):
        lines.setdefault((*path, key), number)
        if isinstance(value, dict | list):
            _note_lines(value, (*path, key), number, lines)


def is_table(kind: Any) -> bool:
    """Whether an entry of this annotation is a table of entries."""
    return isinstance(kind, type) and issubclass(kind, Entry)


def entries_and_tables(kind: type[Entry] = Scenario, within: str = "") -> Iterator[tuple[str, type[Entry] | FieldInfo]]:
    """Give every entry and every table of a scenario by dotted name, in the order in which a file holds them."""
    inner = []
    for key, field in kind.model_fields.items():
        if is_table(field.annotation):
            inner.append((f"{within}{key}", field.annotation))
        else:
            yield f"{within}{key}", field
    for name, table in inner:
        yield name, table
        yield from entries_and_tables(table, f"{name}.")


def with_entries(scenario: Scenario, values: Mapping[str, Any]) -> Scenario:
    """Give a scenario with the values of some entries, by dotted name, replaced.

    Raises:
        ScenarioError: a value is not valid for its entry; the message names it.

    """
    tree = scenario.model_dump()
    for name, value in values.items():
        *tables, last = name.split(".")
        within = tree
        for place, table in enumerate(tables):
            if isinstance(within[table], tuple | list):  # a component of a vector
                within[table] = list(within[table])
            elif within[table] is None:
                raise ScenarioError(f"{name}: {'.'.join(tables[: place + 1])} is not set, and has no components")
            within = within[table]
        if isinstance(within, list):
            within[COMPONENTS.index(last)] = value
        else:
            within[last] = value
    return Scenario.parse(tree)


def is_vector(kind: Any) -> bool:
    """Whether an entry of this annotation holds three numbers, or may."""
    vector = Vector.__origin__  # pyright: ignore[reportAttributeAccessIssue]
    return kind == vector or vector in getattr(kind, "__args__", ()) or Vector in getattr(kind, "__args__", ())


def is_number(kind: Any) -> bool:
    """Whether an entry of this annotation holds a number, or may."""
    return is_whole_number(kind) or float in _kinds(kind)


def is_whole_number(kind: Any) -> bool:
    """Whether an entry of this annotation holds a whole number, or may."""
    return int in _kinds(kind)


def _kinds(kind: Any) -> list[Any]:
    return [kind, *(getattr(part, "__origin__", part) for part in getattr(kind, "__args__", ()))]


def schema() -> dict[str, Any]:
    """Give the JSON Schema (draft 2020-12) of scenarios, by which editors complete, explain and check their files.

    It has every entry with its meaning, unit, default and bounds. What depends on several entries at once is not in it:
    `Scenario.load` says that.
    """
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$id": "keepout-scenario",
        **Scenario.model_json_schema(),
        "title": "Keepout scenario",
    }
