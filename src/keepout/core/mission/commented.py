"""A scenario written as TOML that explains itself: every table and entry with its meaning, in SI units."""

import textwrap
import types
from collections.abc import Iterable, Mapping
from typing import Any, Literal, Union, get_args, get_origin

from pydantic.fields import FieldInfo

from keepout.core.mission.entries import Entry
from keepout.core.mission.entry_names import is_number, is_vector, is_whole_number
from keepout.core.mission.scenario import Scenario

_WIDTH = 34
"""Column at which explanations begin, where the entry is shorter."""
_LONGEST = 120
"""Characters in a line; a longer explanation stands above its entry."""
_DISPERSED = '# dispersions."chaser.mass" = {uniform = [18.0, 22.0]}'
_PARAMETERS = "# parameters.wing_angle = 0.5"


def commented(values: Mapping[str, Any], *, notes: Mapping[str, str] | None = None, head: Iterable[str] = ()) -> str:
    """Write a scenario file: the entries given in force, all others as comments that show their defaults.

    Args:
        values: by dotted name, such as `chaser.mass`.
        notes: more to say of an entry, by dotted name; said after its meaning.
        head: lines of comment at the top.

    Raises:
        ScenarioError: a value is not valid.

    """
    tree: dict[str, Any] = {}
    for name, value in values.items():
        *tables, last = name.split(".")
        within = tree
        for table in tables:
            within = within.setdefault(table, {})
        within[last] = value
    Scenario.parse(tree)
    lines = [f"# {line}".rstrip() for line in head]
    for name, field in Scenario.model_fields.items():
        if not _is_table(field):
            lines += _entry(name, name, field, values, notes or {})
    for name, field in Scenario.model_fields.items():
        if _is_table(field):
            lines += _table(name, field.annotation, values, notes or {})
    return "\n".join(lines) + "\n"


def _is_table(field: FieldInfo) -> bool:
    return isinstance(field.annotation, type) and issubclass(field.annotation, Entry)


def _table(name: str, kind: Any, values: Mapping[str, Any], notes: Mapping[str, str]) -> list[str]:
    lines, within = ["", f"[{name}]", f"# {(kind.__doc__ or '').splitlines()[0]}"], []
    for key, field in kind.model_fields.items():
        if _is_table(field):
            within += _table(f"{name}.{key}", field.annotation, values, notes)
        else:
            lines += _entry(f"{name}.{key}", key, field, values, notes)
    return lines + within


def _entry(name: str, key: str, field: FieldInfo, values: Mapping[str, Any], notes: Mapping[str, str]) -> Iterable[str]:
    said = field.description or ""
    if name in notes:
        said = f"{said}; {notes[name]}" if said else notes[name]
    words = _words(field.annotation)
    if words and not all(word in said for word in words):
        said = f"{said}; one of {', '.join(words)}" if said else f"one of {', '.join(words)}"
    if name in values:
        text = f"{key} = {_toml(values[name])}"
    elif name == "campaign.dispersions":
        text = _DISPERSED
    elif name == "target.parameters":
        text = _PARAMETERS
    else:
        default = field.get_default(call_default_factory=True)
        text = f"# {key} = {_toml(_example(field.annotation) if default is None else default)}"
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


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return '"' + "".join(_character(c) for c in value) + '"'
    if isinstance(value, tuple | list):
        return f"[{', '.join(_toml(part) for part in value)}]"
    return repr(value)


def _character(c: str) -> str:
    if c in '"\\':
        return f"\\{c}"
    return f"\\u{ord(c):04x}" if ord(c) < 32 or ord(c) == 127 else c
