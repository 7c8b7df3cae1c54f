"""Entries of a scenario by dotted name: which there are, what kind of value each holds, and scenarios with others."""

import difflib
from collections.abc import Mapping
from typing import Any, Literal

from pydantic import BaseModel

from keepout.core.errors import ScenarioError
from keepout.core.mission.entries import Vector
from keepout.core.mission.scenario import Scenario

COMPONENTS = ("x", "y", "z")

Kind = Literal["number", "vector", "other"]


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
