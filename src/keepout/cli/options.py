"""What commands share: the application, options, targets, scenarios with their folders of results, answers.

Each command imports what it needs when it is called, and one that an application adds is loaded when it is asked for:
who lists targets does not wait for what flies and draws. Each tries where its results are to go before it works, and
leaves nothing behind where it refuses.
"""

import functools
import inspect
import json
import math
import shutil
import sys
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from keepout.core import plug_ins
from keepout.core.errors import KeepoutError, ScenarioError, UsageError
from keepout.core.whole_file import require_place, write_whole
from keepout.flights.pages import terminal
from keepout.flights.requirements import FAILED, failed, told

if TYPE_CHECKING:
    from keepout.core.mission.entries import TargetEntry
    from keepout.core.mission.scenario import Scenario


def at_least(
    least: int | float, most: int | float = math.inf, *, multiple_of: int | None = None
) -> Callable[[int | float | None], int | float | None]:
    """Refuse another number, and one that is not finite, with the value and what would be valid."""
    valid = "finite" if least == -math.inf else f"at least {least:g}"
    valid += "" if most == math.inf else f" and at most {most:.10g}"
    valid += "" if multiple_of is None else f" and a multiple of {multiple_of}"

    def check(value: int | float | None) -> int | float | None:
        right = value is None or (math.isfinite(value) and least <= value <= most)
        if not right or (value is not None and multiple_of is not None and value % multiple_of):
            raise typer.BadParameter(f"{value} is not valid; it must be {valid}")
        return value

    return check


def from_zero(help: str) -> Any:
    """Give an option for a number that is not negative."""
    return typer.Option(callback=at_least(0.0), help=help)


def into(help: str) -> Any:
    """Give the option for where results go."""
    return typer.Option("--out", "-o", help=help)


_SEED = at_least(0, 2**32 - 1)
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object; all else goes to standard error.")]
Seed = Annotated[int, typer.Option(callback=_SEED, help="Of every random choice.")]
ScenarioSeed = Annotated[int | None, typer.Option(callback=_SEED, help="Instead of the scenario's seed.")]
Units = Annotated[str | None, typer.Option(help="Of a mesh file: m, cm, mm, in or ft.")]
ChaserRadius = Annotated[float, from_zero("Of the ball that holds the chaser, m.")]


def _taking(of: Callable[..., None], options: Iterable[inspect.Parameter]) -> Callable[..., None]:
    """Give a function that says it takes these options, by name: as typer asks."""
    options = [option.replace(kind=inspect.Parameter.KEYWORD_ONLY) for option in options]
    of.__signature__ = inspect.Signature(options)  # pyright: ignore[reportFunctionMemberAccess]
    of.__annotations__ = {option.name: option.annotation for option in options}
    return of


def grouped(command: Callable[..., None]) -> Callable[..., None]:
    """Let options that belong together be one parameter: one that is a dataclass stands for an option each field."""
    parameters = inspect.signature(command, eval_str=True).parameters
    groups: dict[str, Any] = {name: one.annotation for name, one in parameters.items() if is_dataclass(one.annotation)}

    @functools.wraps(command)
    def of_options(**given: Any) -> None:
        made = {name: of(**{one.name: given.pop(one.name) for one in fields(of)}) for name, of in groups.items()}
        command(**given, **made)

    options: list[inspect.Parameter] = []
    for name, one in parameters.items():
        options += inspect.signature(groups[name]).parameters.values() if name in groups else [one]
    return _taking(of_options, options)


@dataclass(frozen=True)
class MeshFile:
    """Options on how a mesh file is read."""

    units: Units = None
    scale: Annotated[float | None, typer.Option(help="Metres per unit, instead of --units.")] = None
    drop_stray: Annotated[bool, typer.Option("--drop-stray", help="Leave out parts far from the rest.")] = False

    def entry(self, mesh: str) -> "TargetEntry":
        """Make the entry `[target]` of a mesh, as `target_entry` does."""
        return target_entry({"source": mesh, **vars(self)})


def example(*lines: str) -> str:
    """Format the example shown at the end of a command's help."""
    return "**Example**\n\n" + "\n\n".join(f"`{line}`" for line in lines)


def answer(summary: Any, as_json: bool, *told: Any) -> None:
    """Print the machine's answer on standard output, or the person's tables and words."""
    if as_json:
        sys.stdout.write(json.dumps(summary, indent=2, allow_nan=False) + "\n")
        return
    for part in told:
        terminal.tell(part)


def require_file(out: Path, ending: str, what: str, *, refusal: type[KeepoutError]) -> None:
    """Refuse a file that cannot be written, or whose name does not end as it has to: before the work for it.

    Raises:
        UsageError: its name ends otherwise.
        KeepoutError: of the kind `refusal`, there is no such folder, or nothing can be written there.

    """
    if ending not in ("", out.suffix):
        raise UsageError(f"{out}: {what} ends in {ending}")
    if not out.absolute().parent.is_dir():
        raise refusal(f"{out}: the folder {out.parent} does not exist")
    require_place(out, refusal=refusal)


@contextmanager
def usage() -> Iterator[None]:
    """Turn the refusals of what reads an option's value into those of a command that cannot be meant.

    Raises:
        UsageError: for any `KeepoutError`.

    """
    try:
        yield
    except KeepoutError as error:
        raise UsageError(str(error)) from None


def target_entry(source: Mapping[str, Any], *, options: str = "--") -> "TargetEntry":
    """Make an entry of options named like the entries of `[target]`; one that is None is left out.

    Args:
        source: the options.
        options: what each one's name begins with on the command line, for a refusal.

    Raises:
        UsageError: an option is not valid.
        MeshError: there is no such file.

    """
    from keepout.core.mission.first_look import require_mesh
    from keepout.core.mission.scenario import Scenario

    given = {key: value for key, value in source.items() if value is not None}
    try:
        entry = Scenario.parse({"target": given}).target
    except ScenarioError as error:  # the user gave options, not a scenario
        raise UsageError(str(error).replace("scenario: target.", options)) from None
    require_mesh(entry.source)  # before what reads it is imported
    return entry


def mission_for_mesh(
    path: str, read: Mapping[str, Any], *, options: str = "--", settings: Sequence[str] | None = None
) -> "Scenario":
    """Load a scenario whose `[target]` is meant in place of a mesh.

    Args:
        path: of its TOML file.
        read: how a mesh is read, named like the entries of `[target]`, which says it here; none may be given.
        options: as of `target_entry`.
        settings: as of `mission_of`.

    Raises:
        UsageError: something of `read` is given, or a setting is not valid.
        ScenarioError: the file is not a scenario.

    """
    for key in (key for key, value in read.items() if value is not None and value is not False):
        name = f"{options}{key.replace('_', '-')}"
        raise UsageError(f"{name}: not with the scenario {path}, whose [target] says how its mesh lies")
    return mission_of(Path(path), None, settings)


Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="ENTRY=VALUE",
        help="Replace an entry, as chaser.mass=25; as often as wanted.",
    ),
]
Figures = Annotated[bool, typer.Option(help="Draw figures and the page.")]
Force = Annotated[bool, typer.Option("--force", help="Replace another mission's results.")]
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
        out: Annotated[Path | None, into("Folder of results, instead of out/NAME of the scenario.")] = None,
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


ORDER = (
    *("targets", "describe", "fit", "certify", "measure", "fly", "explore", "inspect", "replay", "report"),
    *("rare", "reproduce", "export", "audit", "scenario", "campaign"),
)


class Commands(typer.Typer):
    """Commands each of which takes --quiet and --log beside its own options."""

    def command(self, name: str | None = None, **options: Any) -> Callable[[Any], Any]:
        """Add a command under a name, by default its function's."""
        register = super().command(name, **options)

        def add(command: Callable[..., None]) -> Callable[..., None]:
            register(_heard(command))
            return command

        return add


def _heard(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command that takes --quiet and --log too."""

    def options(
        *,
        quiet: Annotated[
            bool, typer.Option("--quiet", "-q", help="Say only refusals, warnings and requirements not met.")
        ] = False,
        log: Annotated[Path | None, typer.Option(help="Add all that is said, with times, to this file.")] = None,
    ) -> None: ...

    @functools.wraps(command)
    def told(*, quiet: bool, log: Path | None, **given: Any) -> None:
        with terminal.heard(quiet, log):
            command(**given)

    both = (inspect.signature(of, eval_str=True).parameters.values() for of in (command, options))
    return _taking(told, chain.from_iterable(both))


class _WithPlugIns(TyperGroup):
    """The commands in the order of a user's work; one that an application adds is loaded when it is asked for."""

    def list_commands(self, ctx: Any) -> list[str]:
        return sorted({*super().list_commands(ctx), *plug_ins.names("mission_commands")}, key=ORDER.index)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        if cmd_name in plug_ins.names("mission_commands") and cmd_name not in self.commands:
            added = Commands(**_SETTINGS)
            add_mission_command(added, cmd_name, plug_ins.load("mission_commands", cmd_name))
            self.commands[cmd_name] = typer.main.get_command(added)
        return super().get_command(ctx, cmd_name)


_SETTINGS: Any = {"add_completion": False, "pretty_exceptions_enable": False, "rich_markup_mode": "markdown"}
app = Commands(
    cls=_WithPlugIns,
    help="Learn a spacecraft's shape, prove how wrong it can be, and fly around it without touching it.",
    no_args_is_help=True,
    **_SETTINGS,
)
