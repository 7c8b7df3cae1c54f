"""What rooms of `flights` and `apps` add to what stands below them, by name: nothing below names a room above it.

A room adds by a file `plug_in.toml` in its folder, a table for each group: the name under which an object is asked for,
and the module and the object in it, as entry points are written.

    [mesh_readers]
    ".keepmap" = "keepout.apps.unknown.command:read_keepmap"

What asks (a reader of meshes by suffix, a page for its parts) says `names("mesh_readers")` to know what there is, which
imports nothing, and `load("mesh_readers", ".keepmap")` to get one, which imports that one module. The names of a group
stand in the order of the files' paths, `apps` before `flights`, and within a file as written.

A new group is a line in `GROUPS`, and a call of `load` where it is used; a new object is a line in a room's
`plug_in.toml`. `tests/core/test_plug_ins.py` loads all that is added.
"""

import functools
import tomllib
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import Any

GROUPS: Mapping[str, str] = MappingProxyType(
    {
        "mission_commands": "by name: a `MissionCommand` (flights/pages/terminal), for the command line",
        "mission_exports": "by format: a function of a scenario and a folder that writes it there (verbs/files)",
        "mesh_readers": "by suffix: a function of a path that gives its `MeshContents` (core/geometry/mesh_files)",
        "thrusters": "require, errors, flown: functions of a scenario with a layout of thrusters (core/mission)",
        "flight": "replay, export, plot, drifts: what a `Flight` can do, given itself and more (core/mission/flight)",
        "notebook": "flight, target, certificate: how one shows itself in a notebook, as HTML (core)",
        "navigation": "suite, certain, flown: functions that build these of a scenario with a suite (core/mission)",
    }
)
"""What is added in each group, and where that is used."""


def names(group: str) -> tuple[str, ...]:
    """Give the names of all that rooms add to a group; nothing is imported for it."""
    return tuple(_added()[group])


def load(group: str, name: str) -> Any:
    """Import what a room adds to a group under a name.

    Raises:
        KeyError: no room adds that.

    """
    module, _, attribute = _added()[group][name].partition(":")
    return getattr(import_module(module), attribute)


@functools.cache
def _added() -> dict[str, dict[str, str]]:
    found: dict[str, dict[str, str]] = {group: {} for group in GROUPS}
    for path in sorted(Path(__file__).parents[1].glob("*/*/plug_in.toml")):
        for group, added in tomllib.loads(path.read_text(encoding="utf-8")).items():
            if twice := found[group].keys() & added:
                raise ImportError(f"{path}: {group} {', '.join(sorted(twice))} are added by another room as well")
            found[group] |= added
    return found
