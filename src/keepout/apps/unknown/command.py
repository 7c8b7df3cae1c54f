"""The command `explore`; it imports what flies and draws when it is called."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.table import Table

from keepout.core.progress import Progress, part_of, silent
from keepout.flights.pages.terminal import MissionCommand, result_table

if TYPE_CHECKING:
    from keepout.core.mission.scenario import Scenario


def explore_to_folder(
    scenario: "Scenario", out: Path, *, figures: bool = True, progress: Progress = silent
) -> dict[str, Any]:
    """Explore as a scenario says; write map, flight file, pictures, page and `summary.json` into `out`.

    Nothing is written where the scenario is refused.
    """
    from keepout.apps.unknown import equipment

    camera = equipment.depth_camera(scenario)
    equipment.require_explorable(scenario, camera)
    from keepout.apps.unknown.exploration_page import write_exploration
    from keepout.apps.unknown.explore import explore
    from keepout.flights.pages.folder import results_in

    with results_in(out):
        exploration = explore(scenario, progress=part_of(progress, 0.0, 0.9))
        return write_exploration(out, exploration, figures=figures, progress=part_of(progress, 0.9, 1.0))


def _table(summary: dict[str, Any]) -> Table:
    from keepout.apps.unknown.exploration_page import ROWS

    return result_table(f"Exploration {summary['name']}", summary, ROWS)


EXPLORE = MissionCommand(
    help="Fly round a target that nobody has a model of: map what is seen free, approach in it, audit on the true "
    "mesh.",
    example="keepout explore examples/explore.toml -o out/explore",
    scenario="A scenario file (TOML) with [map], and [depth_sensor], [explore] as needed.",
    fly=explore_to_folder,
    table=_table,
)
