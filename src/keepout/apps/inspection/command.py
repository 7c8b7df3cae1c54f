"""The command `inspect`; it imports what flies and draws when it is called."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.table import Table

from keepout.core.errors import ScenarioError
from keepout.core.progress import Progress, part_of, silent
from keepout.flights.pages.terminal import MissionCommand, result_table, with_zones

if TYPE_CHECKING:
    from keepout.core.mission.scenario import Scenario


def require_mission(path: Path) -> None:
    """Refuse a mesh or a field, which the commands `describe` and `measure` are for.

    Raises:
        ScenarioError: the file is no scenario by its name.

    """
    from keepout.core.geometry.mesh_files import READERS

    ending = path.suffix.lower()
    if ending == ".keepout":
        raise ScenarioError(
            f"{path}: a field, and `keepout inspect` flies a mission in TOML; `keepout measure {path}` measures it"
        )
    if ending in READERS or not (ending or path.exists()):
        raise ScenarioError(
            f"{path}: no mission in TOML, which `keepout inspect` flies; `keepout describe {path}` says what is wrong "
            "with a mesh, `keepout measure` measures a field"
        )


def inspect_to_folder(
    scenario: "Scenario", out: Path, *, figures: bool = True, progress: Progress = silent
) -> dict[str, Any]:
    """Inspect as a scenario says; write flight, frames, the unseen, pictures, page and `summary.json` into `out`."""
    from keepout.apps.inspection.inspect import inspect

    inspection = inspect(scenario, progress=part_of(progress, 0.0, 0.9))
    from keepout.apps.inspection.inspection_page import write_inspection  # what draws: not for a refusal

    return write_inspection(out, inspection, figures=figures, progress=part_of(progress, 0.9, 1.0))


def _table(summary: dict[str, Any]) -> Table:
    from keepout.apps.inspection.inspection_page import ROWS

    return result_table(f"Inspection {summary['name']}", *with_zones(summary, ROWS))


INSPECT = MissionCommand(
    help="See all of a target that can be seen and lit, without touching it; audit the flight on the exact mesh.",
    example="keepout inspect examples/inspect.toml -o out/inspect",
    scenario="A scenario file (TOML).",
    fly=inspect_to_folder,
    table=_table,
    check=require_mission,
)
