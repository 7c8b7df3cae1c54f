"""A scenario as commands take it: its file with entries that --set replaces, the folder of its results, its verdict."""

import json
import shutil
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from keepout.cli.options import AsJson, ScenarioSeed, answer, example, into
from keepout.core.errors import ScenarioError, UsageError
from keepout.core.whole_file import write_whole
from keepout.flights.pages import terminal
from keepout.flights.requirements import FAILED, failed, told

if TYPE_CHECKING:
    from keepout.core.mission.scenario import Scenario

Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="ENTRY=VALUE",
        help="Replaces an entry of the scenario, as chaser.mass=25; as often as wanted.",
    ),
]
Figures = Annotated[bool, typer.Option(help="Draw figures and the page.")]
Force = Annotated[bool, typer.Option("--force", help="Replace what another mission left in the folder.")]
_MISSION = "mission.json"
"""In a folder of results: what was flown into it, by which command, from which file."""
_OF_A_CAMPAIGN = ("campaign.json", "flights", "bands", "kept", "report", "bands.json", "summary.json")


def mission_of(path: Path, seed: int | None = None, settings: Sequence[str] | None = None) -> "Scenario":
    """Load a scenario, with entries and seed replaced where they are given.

    Args:
        path: of its TOML file.
        seed: instead of the scenario's own.
        settings: each `entry=value`; the value in TOML, a word that is none is text. File names are relative to the
            folder that the command is run in.

    Raises:
        ScenarioError: the file is not a scenario.
        UsageError: a setting is no `entry=value`, or not valid; names all that is wrong in one line.

    """
    from keepout.core.mission.scenario import Scenario

    mission = Scenario.load(path)
    if settings:
        tree = mission.model_dump()
        for setting in settings:
            _merge(tree, _read(setting), Scenario)
        try:
            mission = Scenario.parse(tree, where="--set").resolved(Path.cwd())
        except ScenarioError as error:
            raise UsageError(str(error)) from None
    return mission if seed is None else mission.replace(seed=seed)


def _read(setting: str) -> dict[str, Any]:
    """Read `entry=value` as TOML, in which a dotted name opens tables."""
    entry, equals, value = setting.partition("=")
    said = "give ENTRY=VALUE, the value in TOML, as chaser.mass=25"
    if not equals:
        raise UsageError(f"--set {setting}: no value; {said}")
    for text in (setting, f"{entry} = {json.dumps(value.strip())}"):
        try:
            return tomllib.loads(text)
        except ValueError:
            continue
    raise UsageError(f"--set {setting}: {entry.strip() or 'nothing'} is no name of an entry; {said}")


def _merge(tree: dict[str, Any], given: Mapping[str, Any], table: Any) -> None:
    """Put what was given into the tree of a table: tables entry by entry, vectors by component, all else whole."""
    from keepout.core.mission.scenario import COMPONENTS, is_table, is_vector

    for key, value in given.items():
        field, now = table.model_fields.get(key), tree.get(key)
        kind = None if field is None else field.annotation
        if isinstance(value, dict) and is_table(kind):
            _merge(tree[key], value, kind)
        elif isinstance(value, dict) and is_vector(kind) and now is not None and value.keys() <= set(COMPONENTS):
            tree[key] = [value.get(axis, old) for axis, old in zip(COMPONENTS, now)]
        else:
            tree[key] = now | value if isinstance(value, dict) and isinstance(now, dict) else value


@contextmanager
def results_of(command: str, scenario: Path, mission: "Scenario", out: Path, *, force: bool) -> Iterator[None]:
    """Make the folder that a mission's results go to; what is in it at the end is marked as this mission's.

    The same mission is the same command on the same scenario file, whatever stands in it by now, or on another file
    that says the same.

    Args:
        command: that flies.
        scenario: the file.
        mission: as it is flown.
        out: the folder.
        force: whether another mission's results may be replaced.

    Raises:
        ScenarioError: it holds results of another mission, or cannot be made.

    """
    from keepout.flights.pages.folder import results_in

    own = {"command": command, "file": str(scenario.resolve()), "scenario": json.loads(mission.model_dump_json())}
    there = _held(out)
    if there is not None and not _same(there, own):
        of = "" if there["file"] is None else f" ({there['file']})"
        if not force:
            raise ScenarioError(
                f"{out}: holds what `keepout {there['command']}` wrote of {there['scenario']['name']}{of}; "
                "give another folder with -o, or --force to replace it"
            )
        if there["command"] == "campaign":
            forget_campaign(out)
    with results_in(out):
        yield
        write_whole(out / _MISSION, json.dumps(own, indent=1) + "\n", refusal=ScenarioError)


def _same(there: Mapping[str, Any], own: Mapping[str, Any]) -> bool:
    """Whether two descriptions are of one mission; that of a campaign which was stopped names no file."""
    of_file = there["file"] in (None, own["file"])
    return there["command"] == own["command"] and (of_file or there["scenario"] == own["scenario"])


def _held(out: Path) -> dict[str, Any] | None:
    """Read whose results a folder holds; None where nobody says so.

    A campaign that was stopped has said what it is, but not of which file; what else is another campaign it knows.
    """
    for name, known in ((_MISSION, {}), ("campaign.json", {"command": "campaign", "file": None})):
        try:
            found = json.loads((out / name).read_text(encoding="utf-8")) | known
            if found["scenario"]["name"] and found["command"] and "file" in found:
                return found
        except (OSError, ValueError, TypeError, KeyError):
            continue
    return None


def forget_campaign(out: Path) -> None:
    """Take away what makes a folder that of a campaign, and its flights."""
    for name in _OF_A_CAMPAIGN:
        path = out / name
        shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)


def folder_of(out: Path | None, mission: "Scenario", within: str = "") -> Path:
    """Give the folder that results go to: as given, or `out/NAME` by the scenario's name, or a folder within that."""
    return Path("out") / mission.name / within if out is None else out


def conclude(summary: dict[str, Any], as_json: bool, *tables: Any, out: Path, page: bool = True) -> None:
    """Answer as every command that flies does: tables, requirements, the verdict, and the page to open.

    Args:
        summary: of what was flown.
        as_json: whether to print that instead.
        *tables: to print first.
        out: the folder.
        page: whether one was written.

    Raises:
        typer.Exit: with exit code 3, a requirement is not met.

    """
    rows = summary.get("requirements", [])
    judged = [terminal.entries_table("Requirements", told(rows))] if rows else []
    last = f"open {out / 'index.html'}" if page else f"written to {out}"
    answer(summary, as_json, *tables, *judged, terminal.verdict(summary), terminal.Line(last))
    for line in failed(rows):
        terminal.say(line)
    if failed(rows):
        raise typer.Exit(FAILED)


def add_mission_command(to: typer.Typer, name: str, of: terminal.MissionCommand) -> None:
    """Add a command that flies a scenario into a folder."""

    def command(
        scenario: Annotated[Path, typer.Argument(help=of.scenario)],
        out: Annotated[Path | None, into("Folder of the results, instead of out/NAME, by the scenario's name.")] = None,
        figures: Figures = True,
        seed: ScenarioSeed = None,
        settings: Settings = None,
        force: Force = False,
        as_json: AsJson = False,
    ) -> None:
        of.check(scenario)
        mission = mission_of(scenario, seed, settings)
        folder = folder_of(out, mission)
        own = results_of(name, scenario, mission, folder, force=force)
        with terminal.progress(f"{name} {mission.name}") as progress, own:
            summary = of.fly(mission, folder, figures=figures, progress=progress)
        conclude(summary, as_json, of.table(summary), out=folder, page=figures)

    command.__doc__ = f"{of.help}\n\nExit code 3: a requirement of the scenario's [require] is not met."
    to.command(name, epilog=example(of.example))(command)
