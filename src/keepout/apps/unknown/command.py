"""What exploring adds: the command `explore`, and maps as meshes; each imports what it needs when it is called."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.table import Table

from keepout.core.errors import MapError, MeshError
from keepout.core.progress import Progress, part_of, silent
from keepout.flights.pages.terminal import MissionCommand, result_table

if TYPE_CHECKING:
    from keepout.core.geometry.mesh_files.contents import MeshContents
    from keepout.core.mission.scenario import Scenario


def explore_to_folder(
    scenario: "Scenario", out: Path, *, figures: bool = True, progress: Progress = silent
) -> dict[str, Any]:
    """Explore as a scenario says; write map, flight file, pictures, page and `summary.json` into `out`."""
    from keepout.apps.unknown.explore import explore

    exploration = explore(scenario, progress=part_of(progress, 0.0, 0.9))
    from keepout.apps.unknown.exploration_page import write_exploration  # what draws: not for a refusal

    return write_exploration(out, exploration, figures=figures, progress=part_of(progress, 0.9, 1.0))


def _table(summary: dict[str, Any]) -> Table:
    from keepout.apps.unknown.exploration_page import ROWS

    return result_table(f"Exploration {summary['name']}", summary, ROWS)


EXPLORE = MissionCommand(
    help="Fly round a target without a model: map what is seen free, approach in it, audit on the true mesh.",
    example="keepout explore examples/explore.toml -o out/explore",
    scenario="A scenario file (TOML).",
    fly=explore_to_folder,
    table=_table,
)


def read_keepmap(path: Path) -> "MeshContents":
    """Read a `.keepmap` file as the skin of its obstacle, in metres and in the map's frame.

    Raises:
        MeshError: if it is damaged or no map file.

    """
    from keepout.apps.unknown.map_file import load
    from keepout.apps.unknown.skin import skin
    from keepout.core.geometry.mesh_files.contents import MeshContents

    try:
        known = load(path)
    except MapError as refusal:
        raise MeshError(str(refusal).removeprefix(f"{path}: ")) from refusal
    vertices, faces = skin(known)
    broken = known.assumptions_broken
    said = (f"took the skin of a map of {known.name} after {known.views} views", *broken)
    return MeshContents(vertices, faces, said, "meter", broken)
