"""A scenario drafted for a target, in TOML that explains itself.

Drafted are sizes, a free start and goal, a speed that the thrusters honour, and enough time. Every table and entry
stands in the file with its meaning; those that are not in force are comments that show their defaults. An approach has
hold points on a line to a port, a keep-out sphere, a corridor and speeds too.
"""

import functools
import itertools
import math
import os
import textwrap
import tomllib
import types
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Union, get_args, get_origin

from pydantic.fields import FieldInfo

from keepout.core.errors import KeepoutError, ScenarioError
from keepout.core.mission.entries import ChaserEntry
from keepout.core.mission.scenario import Scenario, entries_and_tables, is_number, is_vector, is_whole_number
from keepout.core.progress import Progress, silent
from keepout.flights.pages.page import toml

if TYPE_CHECKING:
    import numpy as np

    from keepout.core.geometry.target import Target

_STAND_OFF = 3.0
"""Metres from the target's bounding box, beside chaser and margin, at which a drafted flight begins and ends."""
_SLOWEST = 0.005
"""Metres a second below which no speed limit is drafted."""
_SHARE = 0.8
"""Of the largest speed that the thrusters honour, the most that is drafted."""
_WIDTH = 34
"""Column at which explanations begin, where the entry is shorter."""
_LONGEST = 120
"""Characters in a line; a longer explanation stands above its entry."""
_IN_FORCE = (
    "duration",
    *(f"chaser.{key}" for key in ChaserEntry.model_fields),
    *("safety.margin", "guard.enabled", "control.profile", "control.period"),
    *("orbit.semi_major_axis", "orbit.eccentricity", "attitude.kind", "disturbance.kind"),
    *("start.position", "start.velocity", "goal.position", "goal.tolerance"),
)
"""Entries that stand in every draft."""
_DISPERSED = '# dispersions."chaser.mass" = {uniform = [18.0, 22.0]}'
_PARAMETERS = "# parameters.wing_angle = 0.5"


@dataclass(frozen=True)
class Draft:
    """A drafted scenario.

    Attributes:
        scenario: as it would be flown.
        text: its TOML.
        honoured_speed: the largest speed limit that the thrusters honour, m/s; None where no target was given.
        extents: of the target's bounding box, m; None likewise.
        remarks: what is to be done before it can be flown.

    """

    scenario: Scenario
    text: str
    honoured_speed: float | None = None
    extents: tuple[float, float, float] | None = None
    remarks: tuple[str, ...] = field(default=())


def _tree_of(values: Mapping[str, Any]) -> dict[str, Any]:
    """Nest values by dotted name, such as `chaser.mass`, as `Scenario.parse` takes them."""
    tree: dict[str, Any] = {}
    for name, value in values.items():
        *tables, last = name.split(".")
        within = tree
        for table in tables:
            within = within.setdefault(table, {})
        within[last] = value
    return tree


def draft(
    source: str | None = None,
    *,
    name: str = "mission",
    folder: Path = Path(),
    profile: str = "default",
    approach: bool = False,
    progress: Progress = silent,
    **read: Any,
) -> Draft:
    """Draft a scenario for a target, or the built-in one where none is given.

    Args:
        source: a mesh file, or a built-in target's name.
        name: of the mission.
        folder: where the file is going to be; file names in it are relative to that.
        profile: of the control law, "default" or "paper".
        approach: whether it leads from hold point to hold point, with a keep-out sphere and a corridor.
        progress: called as the work goes on.
        **read: how the mesh file is read: `units`, `scale` (m a unit), `drop_stray` (without parts far from the rest).

    Raises:
        KeepoutError: the mesh cannot be used, or no speed limit can be flown around it.

    """
    values: dict[str, Any] = {"name": name, "seed": 0, "control.profile": profile}
    if source is None:
        if approach:
            raise ScenarioError("approach: only for a target; name a mesh file, or a built-in target")
        defaults = Scenario.parse(_tree_of(values))
        values |= _numbers(defaults)
        values |= {"target.source": defaults.target.source, "field.source": defaults.field.source}
        return Draft(defaults, _written(values, {}, (), source))
    from keepout.core.mission.target import load_target

    progress(0.0, "target")
    given = {"source": source, **read}
    target = load_target(Scenario.parse({"target": given}).target)
    field_source, remarks = _field_of(target, given, folder)
    is_file = Path(source).exists() and target.name != source
    named = given | {"source": _relative(Path(source), folder)} if is_file else given
    values |= {f"target.{key}": value for key, value in named.items()} | {"field.source": field_source}
    progress(0.3, "start and goal")
    start, goal, way = _places(target)
    values |= {"start.position": start, "goal.position": goal}
    progress(0.5, "speed")
    scenario, honoured = _honoured(Scenario.parse(_tree_of(values | {"target.source": source})), target)
    speed = scenario.chaser.speed_limit
    # Half as long again as the way round the bounding box takes, and time to come to rest.
    scenario = scenario.replace(duration=100.0 * math.ceil((1.5 * way / speed + 200.0) / 100.0))
    values = _numbers(scenario) | values
    tables = ""
    if approach:
        led, tables = approach_to(target, scenario.chaser.radius, scenario.safety.margin, speed)
        values |= led
        scenario = Scenario.parse(_tree_of(values | {"target.source": source}) | tomllib.loads(tables))
    width, depth, height = (target.vertices.max(axis=0) - target.vertices.min(axis=0)).tolist()
    notes = {
        "target.source": f"its box is {width:.3g} x {depth:.3g} x {height:.3g} m",
        "chaser.speed_limit": f"the thrusters honour up to {honoured:.3g}",
        "start.position": "free, with room",
        "goal.position": "free, with room",
        "duration": f"a way of {way:.3g} m round the target at the speed limit takes {way / speed:.3g} s",
    }
    if approach:
        notes = {name: said for name, said in notes.items() if name not in ("goal.position", "duration")}
    text = _written(values, notes, remarks, source) + tables
    return Draft(scenario, text, honoured, (width, depth, height), remarks)


def _field_of(target: "Target", mesh: dict[str, Any], folder: Path) -> tuple[str, tuple[str, ...]]:
    """Name the field of a target whose entries are given, and the command that makes it where it is not there."""
    from keepout.core.fields import shipped_names

    if mesh["source"] in shipped_names():
        return "shipped", ()
    learned = Path(folder) / f"{target.name}.keepout"
    if learned.exists():
        return learned.name, ()
    options = "".join(
        f" --{key.replace('_', '-')}" + ("" if value is True else f" {value}")
        for key, value in mesh.items()
        if key != "source"
    )
    radius = Scenario().chaser.radius
    return learned.name, (f"keepout fit {mesh['source']}{options} --chaser-radius {radius:g} --certify -o {learned}",)


def _written(values: dict[str, Any], notes: dict[str, str], remarks: tuple[str, ...], source: str | None) -> str:
    head = [
        f"A scenario of Keepout{f' around {Path(source).name}' if source else ''}. All entries are in SI units.",
        "What stands behind `#` is not in force: it shows an entry's default, or an example where there is none.",
        "`keepout scenario check` says what will be flown; `keepout fly` flies it.",
    ]
    if remarks:
        head += ["Its field is to be learned first:", *(f"  {remark}" for remark in remarks)]
    return commented(values, notes=notes, head=head)


def _numbers(scenario: Scenario) -> dict[str, Any]:
    """Give the entries that every flight is about."""
    return {name: functools.reduce(getattr, name.split("."), scenario) for name in _IN_FORCE}


def _relative(source: Path, folder: Path) -> str:
    """Name a file as seen from a folder, with forward slashes."""
    try:
        return Path(os.path.relpath(source.resolve(), Path(folder).resolve())).as_posix()
    except ValueError:  # on another drive
        return source.resolve().as_posix()


def _places(target: "Target") -> tuple[tuple[float, float, float], tuple[float, float, float], float]:
    """Give a start and a goal on two sides of the target, m, and the length of a way round it between them, m.

    They lie across the second longest side of its bounding box, and the way leads over the shortest.

    Raises:
        ScenarioError: one of them is not proved to be outside the target.

    """
    import numpy as np

    from keepout.core.mission.target import has_way_out, room_to_start

    chaser = Scenario()
    room = room_to_start(chaser)
    lower, upper = target.distance.lower, target.distance.upper
    centre, half = 0.5 * (lower + upper), 0.5 * (upper - lower)
    over, across, _ = np.argsort(half, kind="stable")
    away = float(half[across]) + room + _STAND_OFF
    places: list[tuple[float, float, float]] = []
    for side, rise in ((1.0, 0.6), (-1.0, -0.4)):
        place = centre.copy()
        place[across] += side * away
        place[over] += rise * (float(half[over]) + room)
        place = np.round(place, 1)
        if float(target.distance.distance(place[None])[0]) < room or not has_way_out(chaser, target, place):
            raise ScenarioError(f"{target.name}: {place.tolist()} m is not free; give start and goal by hand")
        x, y, z = place.tolist()
        places.append((x, y, z))
    rise = 2.0 * (float(half[over]) + room)
    return places[0], places[1], 2.0 * away + rise


def _honoured(scenario: Scenario, target: "Target") -> tuple[Scenario, float]:
    """Give the scenario with a speed limit that law and guard honour, and the largest one that they do, m/s.

    Raises:
        KeepoutError: they honour none.

    """
    from keepout.verbs.check import nearest_number, number_refusal

    def at(speed: float) -> Scenario:
        return scenario.replace(chaser={"speed_limit": speed})

    def refused(speed: float) -> KeepoutError | None:
        return number_refusal(at(speed), target)

    fastest = 1.0
    honoured = fastest if refused(fastest) is None else nearest_number(refused, fastest, _SLOWEST)
    if honoured is None:
        refusal = refused(_SLOWEST)
        assert refusal is not None
        raise refusal
    wanted = min(scenario.chaser.speed_limit, math.floor(_SHARE * honoured * 1000.0) / 1000.0)
    return at(max(wanted, _SLOWEST)), honoured


def commented(values: Mapping[str, Any], *, notes: Mapping[str, str] | None = None, head: Iterable[str] = ()) -> str:
    """Write a scenario file: the entries given in force, all others as comments that show their defaults.

    Args:
        values: by dotted name, such as `chaser.mass`.
        notes: more to say of an entry, by dotted name; said after its meaning.
        head: lines of comment at the top.

    Raises:
        ScenarioError: a value is not valid.

    """
    Scenario.parse(_tree_of(values))
    lines = [f"# {line}".rstrip() for line in head]
    for name, told in entries_and_tables():
        if isinstance(told, FieldInfo):
            lines += _entry(name, told, values, notes or {})
        else:
            lines += ["", f"[{name}]", f"# {(told.__doc__ or '').splitlines()[0]}"]
    return "\n".join(lines) + "\n"


def _entry(name: str, field: FieldInfo, values: Mapping[str, Any], notes: Mapping[str, str]) -> Iterable[str]:
    """Write one entry in force, or as a comment that shows its default, with its meaning beside or above it."""
    key, said = name.rpartition(".")[2], field.description or ""
    if name in notes:
        said = f"{said}; {notes[name]}" if said else notes[name]
    words = _words(field.annotation)
    if words and not all(word in said for word in words):
        said = f"{said}; one of {', '.join(words)}" if said else f"one of {', '.join(words)}"
    if name in values:
        text = f"{key} = {toml(values[name])}"
    elif name == "campaign.dispersions":
        text = _DISPERSED
    elif name == "target.parameters":
        text = _PARAMETERS
    else:
        default = field.get_default(call_default_factory=True)
        text = f"# {key} = {toml(_example(field.annotation) if default is None else default)}"
    line = f"{text:<{_WIDTH}} # {said}" if said else text
    if len(line) <= _LONGEST:
        return [line]
    return [*(f"# {part}" for part in textwrap.wrap(said, _LONGEST - 2)), text]


def _words(kind: Any) -> tuple[str, ...]:
    """Give the words that an entry may be, if it is one of several."""
    if get_origin(kind) is Literal:
        return tuple(word for word in get_args(kind) if isinstance(word, str))
    if get_origin(kind) in (Union, types.UnionType):
        return tuple(word for part in get_args(kind) for word in _words(part))
    return ()


def _example(kind: Any) -> Any:
    """Give a valid value of an entry that is unset by default."""
    words = _words(kind)
    if words:
        return words[0]
    if is_vector(kind):
        return (1.0, 0.0, 0.0)
    if is_number(kind):
        return 1 if is_whole_number(kind) else 0.5
    if str in get_args(kind):
        return "FILE"
    return ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


_AWAY = (2.0, 10.0, 40.0)
"""Of the hold points from the port, beside the chaser's radius and the margin, m; the last outside the sphere."""
_DWELL = 60.0
_HALF_ANGLE, _MOUTH = 0.17, 0.8
"""Of the corridor's cone, rad, and its radius at the port, m."""
_TOUCHES = 1e-3


def approach_to(target: "Target", chaser_radius: float, margin: float, speed: float) -> tuple[dict[str, Any], str]:
    """Draft an approach along the axis of the body frame that leads most freely to the target.

    Args:
        target: the mesh.
        chaser_radius: m.
        margin: the operator's, m.
        speed: the chaser's limit, m/s.

    Returns:
        Entries by dotted name, and the tables of legs, zones and corridors as TOML.

    Raises:
        ScenarioError: no axis leads to the target with room beside it.

    """
    import numpy as np

    lower, upper = target.distance.lower, target.distance.upper
    centre, half = 0.5 * (lower + upper), 0.5 * float(np.linalg.norm(upper - lower))
    away = [chaser_radius + margin + more for more in _AWAY]
    sphere = math.ceil(half + 10.0)
    port, axis = _freest(target, centre, away)
    # Where the line to the port leaves the sphere, with room.
    along = float((port - centre) @ axis)
    across = float(np.linalg.norm(port - centre - along * axis))
    away[-1] = max(away[-1], math.sqrt(sphere**2 - across**2) - along + chaser_radius + 5.0)
    places = [np.round(port + distance * axis, 2).tolist() for distance in reversed(away)]
    start = np.round(port + (away[-1] + 10.0) * axis + 4.0 * np.roll(axis, 1), 2).tolist()
    slowest = 0.2 * speed
    rule = [[round(away[-1], 1), speed], [round(away[1], 1), 0.5 * speed], [round(away[0], 1), slowest]]
    times = [10.0 / speed, (away[-1] - away[1]) / (0.6 * speed), (away[1] - away[0]) / (0.3 * speed)]
    go = 10.0 * math.ceil((times[0] + _DWELL + 60.0) / 10.0)
    duration = 100.0 * math.ceil((go + 1.4 * sum(times) + 3.0 * _DWELL + 200.0) / 100.0)
    names = [f"{distance:.0f} m" for distance in reversed(away[1:])] + ["capture"]
    legs: list[dict[str, Any]] = [
        {"name": name, "position": place, "tolerance": tolerance, "dwell": _DWELL}
        for name, place, tolerance in zip(names, places, (0.5, 0.4, 0.2), strict=True)
    ]
    legs[0] |= {"until": "go", "go_at": go}
    zone = {"name": "keep-out sphere", "shape": "sphere", "centre": np.round(centre, 2).tolist(), "radius": sphere}
    corridor = {"name": "port", "port": np.round(port, 3).tolist(), "axis": (axis + 0.0).tolist()}
    corridor |= {"length": round(2.0 * away[1], 1), "half_angle": _HALF_ANGLE, "radius": _MOUTH}
    values = {
        "start.position": tuple(start),
        "goal.position": tuple(places[-1]),
        "goal.tolerance": legs[-1]["tolerance"],
        "duration": duration,
        "approach.speed_by_distance": rule,
        "approach.distance_to": tuple(corridor["port"]),
    }
    parts = ["# Hold points; the last is the goal.", *(_table("leg", leg) for leg in legs)]
    parts += ['# Nobody enters before "go".', _table("zone", zone | {"until": "go"})]
    parts += ["# Near the port the chaser's centre stays in this cone.", _table("corridor", corridor)]
    return values, "\n" + "\n".join(parts)


def _freest(target: "Target", centre: "np.ndarray", away: list[float]) -> "tuple[np.ndarray, np.ndarray]":
    """Give the port, m, and the unit vector outwards, of the axis with most room beside the hold points."""
    import numpy as np

    found: tuple[float, np.ndarray, np.ndarray] | None = None
    far = float(np.linalg.norm(target.distance.upper - target.distance.lower)) + 1.0
    for axis in (sign * one for sign, one in itertools.product((1.0, -1.0), np.eye(3))):
        along = far
        while along > -far:
            step = float(target.distance.distance((centre + along * axis)[None])[0])
            if step < _TOUCHES:
                break
            along -= step
        else:
            continue
        port = centre + along * axis
        points = port + np.array(away)[:, None] * axis
        room = float(np.min(target.distance.distance(points) / np.array(away)))
        if found is None or room > found[0]:
            found = room, port, axis
    if found is None or found[0] < 0.6:
        raise ScenarioError(
            f"{target.name}: no axis of its body frame leads to its surface with room beside it; write legs and "
            "corridor by hand, as in examples/approach.toml"
        )
    return found[1], found[2]


def _table(name: str, entries: Mapping[str, Any]) -> str:
    return "\n".join([f"[[{name}]]", *(f"{key} = {toml(value)}" for key, value in entries.items()), ""])
