"""The application that commands are added to, the options that they share, and how they answer."""

import json
import math
import sys
from collections.abc import Callable
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

ORDER = (
    *("targets", "describe", "fit", "certify", "measure", "fly", "explore", "inspect", "replay"),
    *("rare", "reproduce", "export", "audit", "scenario", "campaign"),
)


class _InOrderOfWork(TyperGroup):
    """The help lists the commands in the order of a user's work, whatever the order of the modules."""

    def list_commands(self, ctx: Any) -> list[str]:
        return sorted(super().list_commands(ctx), key=ORDER.index)


app = typer.Typer(
    cls=_InOrderOfWork,
    help="Learn a spacecraft's shape, prove how wrong it can be, and fly around it without touching it.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
)


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


_SEED = at_least(0, 2**32 - 1)
AsJson = Annotated[bool, typer.Option("--json", help="One JSON object on standard output; all else on standard error.")]
Seed = Annotated[int, typer.Option(callback=_SEED, help="Of every random choice; the same seed gives the same answer.")]
ScenarioSeed = Annotated[int | None, typer.Option(callback=_SEED, help="Replaces the scenario's own seed.")]
Units = Annotated[str | None, typer.Option(help="Length unit of a mesh file: m, cm, mm, in or ft.")]
Scale = Annotated[float | None, typer.Option(help="Metres per unit of a mesh file, instead of --units.")]
DropStray = Annotated[bool, typer.Option("--drop-stray", help="Leave out parts far from the rest.")]
ChaserRadius = Annotated[
    float, typer.Option(callback=at_least(0.0), help="Radius of the ball that holds the chaser, m.")
]


def example(*lines: str) -> str:
    """Format the example shown at the end of a command's help."""
    return "**Example**\n\n" + "\n\n".join(f"`{line}`" for line in lines)


def answer(summary: Any, as_json: bool) -> None:
    """Print the machine's answer on standard output, or the person's tables."""
    if as_json:
        sys.stdout.write(json.dumps(summary, indent=2, allow_nan=False) + "\n")
