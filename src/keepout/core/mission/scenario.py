"""Scenarios: one typed tree, one TOML file.

Every entry is in SI units. A value outside its range, an unknown key or a missing one is refused with the entry's name,
the value, and what would be valid; nothing is guessed.
"""

import difflib
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin

from pydantic import BaseModel, Field, ValidationError, model_validator

from keepout.core.errors import ScenarioError
from keepout.core.mission.entries import (
    AttitudeEntry,
    CampaignEntry,
    ChaserEntry,
    ControlEntry,
    DispersionEntry,
    DisturbanceEntry,
    DragEntry,
    Entry,
    Epoch,
    FaultsEntry,
    FieldEntry,
    GoalEntry,
    GuardEntry,
    OrbitEntry,
    RareEntry,
    SafetyEntry,
    StateEntry,
    SunEntry,
    TargetEntry,
)
from keepout.core.mission.exploration_entries import DepthSensorEntry, ExploreEntry, MapEntry
from keepout.core.mission.inspection_entries import CameraEntry, InspectEntry, LightEntry
from keepout.core.mission.lines import entry_lines, line_of
from keepout.core.mission.navigation_entries import NavigationEntry
from keepout.core.mission.thruster_entries import ThrustersEntry

_SHOWN = 200
"""Characters shown of a value that is refused, and bits of a whole number."""

_ESTIMATE_FAULTS = (
    *("position_bias", "velocity_bias", "position_noise", "velocity_noise"),
    *("position_noise_std", "velocity_noise_std"),
)
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
    """One mission: target, chaser, law, environment, start and goal. The defaults are the source paper's Case 1."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")] = Field(
        default="case1", description="of the mission, for titles and files: letters, digits, `_`, `.` and `-`"
    )
    seed: Annotated[int, Field(ge=0, lt=2**32)] = Field(default=0, description="of everything that is random")
    duration: Annotated[float, Field(gt=0.0, le=1e6, allow_inf_nan=False)] = Field(default=1500.0, description="s")
    epoch: Epoch = Field(default="2026-01-01T00:00:00Z", description="UTC at the start: for exports and the sun")
    target: TargetEntry = TargetEntry()
    field: FieldEntry = FieldEntry()
    chaser: ChaserEntry = ChaserEntry()
    thrusters: ThrustersEntry = ThrustersEntry()
    safety: SafetyEntry = SafetyEntry()
    guard: GuardEntry = GuardEntry()
    control: ControlEntry = ControlEntry()
    orbit: OrbitEntry = OrbitEntry()
    drag: DragEntry = DragEntry()
    sun: SunEntry = SunEntry()
    attitude: AttitudeEntry = AttitudeEntry()
    disturbance: DisturbanceEntry = DisturbanceEntry()
    navigation: NavigationEntry = NavigationEntry()
    faults: FaultsEntry = FaultsEntry()
    start: StateEntry = StateEntry()
    goal: GoalEntry = GoalEntry()
    campaign: CampaignEntry = CampaignEntry()
    rare: RareEntry = RareEntry()
    depth_sensor: DepthSensorEntry = DepthSensorEntry()
    map: MapEntry = MapEntry()
    explore: ExploreEntry = ExploreEntry()
    camera: CameraEntry = CameraEntry()
    light: LightEntry = LightEntry()
    inspect: InspectEntry = InspectEntry()

    @model_validator(mode="after")
    def _at_least_a_step(self) -> "Scenario":
        if self.duration < self.control.period:
            raise ValueError(f"duration {self.duration} s is shorter than one control period, {self.control.period} s")
        return self

    @model_validator(mode="after")
    def _thrusters_give_no_more(self) -> "Scenario":
        if self.faults.stuck_force > self.chaser.force_limit:
            raise ValueError(
                f"faults.stuck_force {self.faults.stuck_force} N is more than chaser.force_limit, "
                f"{self.chaser.force_limit} N; a stuck thruster gives from 0 to that"
            )
        return self

    @model_validator(mode="after")
    def _thrusters_are_there(self) -> "Scenario":
        ideal, period, shortest = self.thrusters.layout == "ideal", self.control.period, self.thrusters.least_on_time
        if not ideal and self.faults.stuck is not None:
            raise ValueError('faults.stuck is for thrusters.layout = "ideal"; use faults.thruster, its number')
        if not ideal and shortest > period:
            raise ValueError(
                f"thrusters.least_on_time {shortest} s is longer than the control period, {period} s; no pulse fits in"
            )
        return self

    @model_validator(mode="after")
    def _errors_are_said_once(self) -> "Scenario":
        if self.navigation.suite == "none":
            return self
        told = [f"guard.{key}" for key in ("position_error", "velocity_error") if getattr(self.guard, key)]
        told += [f"faults.{key}" for key in _ESTIMATE_FAULTS if getattr(self.faults, key)]
        if told:
            raise ValueError(
                f"{', '.join(told)}: of an estimate without sensors, and navigation.suite is "
                f'"{self.navigation.suite}", which has errors of its own; leave them out'
            )
        return self

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
    def of(cls, given: "Scenario | str | Path") -> "Scenario":
        """Give a scenario as it is, or the one in a file.

        Raises:
            ScenarioError: the file is refused, or it is neither a scenario nor a path.

        """
        if isinstance(given, cls):
            return given
        if isinstance(given, str | Path):
            return cls.load(given)
        raise ScenarioError(f"scenario: {type(given).__name__}; it must be a Scenario or the path of its TOML file")

    @classmethod
    def load(cls, path: str | Path) -> "Scenario":
        """Read a TOML file; paths inside it are relative to it.

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
        return cls.parse(tree, where=str(path), text=text)._resolved(path.parent)

    def replace(self, **entries: Any) -> "Scenario":
        """Return a copy with whole tables or single entries replaced, as in `replace(seed=1, goal={"position": …})`.

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

    def _resolved(self, folder: Path) -> "Scenario":
        """Make file names absolute, so that a scenario means the same wherever it is run from."""
        changes: dict[str, dict[str, str]] = {}
        for table, key in (("target", "source"), ("field", "source"), ("map", "file"), ("explore", "expected")):
            source = getattr(getattr(self, table), key)
            if source and Path(source).suffix and not Path(source).is_absolute():
                changes[table] = {key: str((folder / source).resolve())}
        return self.replace(**changes) if changes else self


def _refusal(error: ValidationError, where: str, lines: Mapping[tuple[Any, ...], int] = {}) -> ScenarioError:
    """Say all that pydantic found in one line, whatever was given: a key may hold a line break."""
    reasons = "; ".join(f"{_line(item, lines)}{_reason(item, Scenario)}" for item in error.errors())
    return ScenarioError(" ".join(f"{where}: {reasons}".split()))


def _shown(value: Any) -> str:
    """Write a value that was refused, however large it is."""
    if isinstance(value, int) and value.bit_length() > _SHOWN:
        return f"an integer of {value.bit_length()} bits"
    text = repr(value)
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}…"


def _reason(item: Any, model: type[BaseModel]) -> str:
    """Turn one pydantic finding into the entry's name, the value and what would be valid."""
    name = ".".join(str(part) for part in item["loc"])
    value = item["input"]
    if item["type"] == "extra_forbidden":
        valid = _valid_keys(item["loc"][:-1], model)
        key = str(item["loc"][-1])
        near = difflib.get_close_matches(key, valid, n=1) + _elsewhere(key, item["loc"], model)
        hint = f"did you mean {' or '.join(near)}?" if near else f"valid: {', '.join(valid)}"
        return f"{name}: no such entry; {hint}"
    message = item["msg"].removeprefix("Value error, ").removeprefix("Input ").replace("should be", "must be")
    shown = "" if isinstance(value, dict | BaseModel) else f"{_shown(value)} "
    return f"{name}: {shown}{message}" if name else message


def _line(item: Any, lines: Mapping[tuple[Any, ...], int]) -> str:
    """Say on which line the entry of a pydantic finding stands, where that is known."""
    path = item["loc"]
    if item["type"] == "value_error":  # of a whole table: its message begins with the entry, unless it is about several
        first = item["msg"].removeprefix("Value error, ").split()[0].rstrip(":,")
        path = (*path, *first.split(".")) if (*path, *first.split(".")) in lines else path
    found = line_of(lines, path)
    return "" if found is None else f"line {found}: "


def _elsewhere(key: str, location: tuple[Any, ...], model: type[BaseModel]) -> list[str]:
    """Give the full names of entries of that very name in other tables, such as `safety.margin` for `chaser.margin`."""
    found = []
    for name, field in model.model_fields.items():
        kind = field.annotation
        if name == key and len(location) > 1:
            found.append(name)
        if isinstance(kind, type) and issubclass(kind, Entry) and key in kind.model_fields:
            found.append(f"{name}.{key}")
    return found


def _valid_keys(location: tuple[Any, ...], model: type[BaseModel]) -> list[str]:
    for part in location:
        if isinstance(part, int):  # a place in a list of tables
            continue
        annotation = model.model_fields[str(part)].annotation if str(part) in model.model_fields else None
        if model is CampaignEntry and str(part) not in model.model_fields:  # the name of what is dispersed
            annotation = DispersionEntry
        if annotation == dict[str, DispersionEntry]:
            continue
        if get_origin(annotation) is tuple:
            annotation = get_args(annotation)[0]
        if not (isinstance(annotation, type) and issubclass(annotation, BaseModel)):
            return []
        model = annotation
    return list(model.model_fields)


def reference() -> str:
    """Write the table of all entries as Markdown: name, default, what it means."""
    lines = ["# Scenario entries", "", "SI units. Every entry has a default; an empty file is valid.", ""]
    lines += [
        "Made by `python -m keepout.core.mission.scenario`.",
        "",
        "| entry | default | meaning |",
        "| --- | --- | --- |",
    ]
    for name, field in Scenario.model_fields.items():
        kind = field.annotation
        if not (isinstance(kind, type) and issubclass(kind, Entry)):
            lines.append(_row(name, field.default, field.description))
            continue
        lines += _table(name, kind)
    return "\n".join(lines) + "\n"


def _table(name: str, kind: type[Entry]) -> list[str]:
    """One line for the table itself, one for each entry, and then the tables within it."""
    lines, within = [_row(f"**[{name}]**", None, (kind.__doc__ or "").splitlines()[0])], []
    for key, entry in kind.model_fields.items():
        if isinstance(entry.annotation, type) and issubclass(entry.annotation, Entry):
            within += _table(f"{name}.{key}", entry.annotation)
        else:
            lines.append(_row(f"{name}.{key}", entry.get_default(call_default_factory=True), entry.description))
    return lines + within


def _row(name: str, default: Any, meaning: str | None) -> str:
    shown = "" if default is None else f"`{default}`"
    linked = re.sub(r"docs/([\w-]+)\.md", r"[\1](\1.md)", meaning or "")
    return f"| {name} | {shown} | {linked} |"


if __name__ == "__main__":
    print(reference(), end="")
