"""The application that commands are added to; those of plug-ins are loaded when they are asked for."""

import functools
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from keepout.cli.options import add_mission_command
from keepout.core import plug_ins
from keepout.flights.pages import terminal

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
            bool, typer.Option("--quiet", "-q", help="Say nothing but refusals, warnings and what is not met.")
        ] = False,
        log: Annotated[Path | None, typer.Option(help="Add all that is said, with times, to this file.")] = None,
    ) -> None: ...

    @functools.wraps(command)
    def told(*, quiet: bool, log: Path | None, **given: Any) -> None:
        with terminal.heard(quiet, log):
            command(**given)

    own, added = (inspect.signature(of, eval_str=True).parameters.values() for of in (command, options))
    own = [option.replace(kind=inspect.Parameter.KEYWORD_ONLY) for option in own]
    told.__signature__ = inspect.Signature([*own, *added])  # pyright: ignore[reportAttributeAccessIssue]
    told.__annotations__ = {option.name: option.annotation for option in (*own, *added)}
    return told


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
