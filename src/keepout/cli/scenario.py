"""Commands on scenario files: scenario new, check, schema."""

import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from keepout.cli.options import AsJson, DropStray, Scale, Units, answer, app, example
from keepout.flights.pages import terminal

scenarios = typer.Typer(
    help="Write, check and explain scenario files.",
    no_args_is_help=True,
    epilog=example("keepout scenario new --for satellite.glb -o mission.toml", "keepout scenario check mission.toml"),
)


app.add_typer(scenarios, name="scenario")


@scenarios.command("new", epilog=example("keepout scenario new --for satellite.glb --units m -o mission.toml"))
def new_scenario(
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="The file to write (.toml); by default standard output.")
    ] = None,
    target: Annotated[
        str | None, typer.Option("--for", help="A mesh file, or a built-in target's name, whose sizes to fill in.")
    ] = None,
    profile: Annotated[str, typer.Option(help="Of the control law: default or paper.")] = "default",
    units: Units = None,
    scale: Scale = None,
    drop_stray: DropStray = False,
    force: Annotated[bool, typer.Option("--force", help="Replace a file that is there.")] = False,
    as_json: AsJson = False,
) -> None:
    """Write a scenario that explains itself: every entry with its meaning, unit and default.

    With --for it has a start and a goal outside the target, a speed that the thrusters honour, and enough time.
    """
    from keepout.cli.commands.scenario import new_scenario_file

    source = {"source": target, "units": units, "scale": scale, "drop_stray": drop_stray}
    with terminal.progress("scenario new") as progress:
        summary = new_scenario_file(source, out, profile=profile, force=force, progress=progress)
    if out is None and not as_json:
        sys.stdout.write(summary["text"])
        return
    answer(summary, as_json)
    if not as_json:
        for line in [f"written to {out}", *(f"next: {step}" for step in summary["next"])]:
            Console().print(line, highlight=False, markup=False, soft_wrap=True)


@scenarios.command("check", epilog=example("keepout scenario check mission.toml"))
def check_scenario(
    scenario: Annotated[Path, typer.Argument(help="A scenario file (TOML).")],
    as_json: AsJson = False,
) -> None:
    """Say what a scenario would fly, without flying it: conditions, time, Δv, and what would be refused.

    Where it would be refused, the nearest values that would not are looked for, and the exit code is 1.
    """
    from keepout.cli.commands.scenario import check_scenario_file

    with terminal.progress(f"check {scenario.name}") as progress:
        summary = check_scenario_file(scenario, progress=progress)
    answer(summary, as_json)
    if not as_json:
        for part in terminal.check_parts(summary):
            Console().print(part, highlight=False, markup=False)
    if not summary["flies"]:
        raise typer.Exit(1)


@scenarios.command("schema", epilog=example("keepout scenario schema -o keepout.schema.json"))
def schema_of_scenarios(
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="The file to write (.json); by default standard output.")
    ] = None,
) -> None:
    """Write the JSON Schema of scenarios, by which editors complete and check them."""
    from keepout.cli.commands.scenario import schema_file

    text = schema_file(out)
    sys.stdout.write(text if out is None else f"written to {out}\n")
