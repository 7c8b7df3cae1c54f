"""What commands share: options, targets, answers.

Each command imports what it needs when it is called: who lists targets does not wait for what flies and draws. Each
tries where its results are to go before it works, and leaves nothing behind where it refuses.
"""

import functools
import inspect
import json
import math
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from keepout.core.errors import KeepoutError, ScenarioError, UsageError
from keepout.core.whole_file import require_place
from keepout.flights.pages import terminal

if TYPE_CHECKING:
    from keepout.core.mission.entries import TargetEntry


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
AsJson = Annotated[bool, typer.Option("--json", help="One JSON object on standard output; all else on standard error.")]
Seed = Annotated[int, typer.Option(callback=_SEED, help="Seed of every random choice: the same seed, the same answer.")]
ScenarioSeed = Annotated[int | None, typer.Option(callback=_SEED, help="Replaces the scenario's own seed.")]
Units = Annotated[str | None, typer.Option(help="Length unit of a mesh file: m, cm, mm, in or ft.")]
ChaserRadius = Annotated[float, from_zero("Radius of the ball that holds the chaser, m.")]


def grouped(command: Callable[..., None]) -> Callable[..., None]:
    """Let options that belong together be one parameter: one that is a dataclass stands for an option each field."""
    parameters = inspect.signature(command, eval_str=True).parameters
    groups: dict[str, Any] = {name: one.annotation for name, one in parameters.items() if is_dataclass(one.annotation)}
    options = [
        option.replace(kind=inspect.Parameter.KEYWORD_ONLY)
        for name, one in parameters.items()
        for option in (inspect.signature(groups[name]).parameters.values() if name in groups else (one,))
    ]

    @functools.wraps(command)
    def of_options(**given: Any) -> None:
        made = {name: of(**{one.name: given.pop(one.name) for one in fields(of)}) for name, of in groups.items()}
        command(**given, **made)

    of_options.__signature__ = inspect.Signature(options)  # pyright: ignore[reportAttributeAccessIssue]
    of_options.__annotations__ = {option.name: option.annotation for option in options}
    return of_options


@dataclass(frozen=True)
class MeshFile:
    """Options on how a mesh file is read."""

    units: Units = None
    scale: Annotated[float | None, typer.Option(help="Metres per unit of a mesh file, instead of --units.")] = None
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
