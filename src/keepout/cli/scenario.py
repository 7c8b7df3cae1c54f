"""Commands on scenario files: scenario new, check, schema."""

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from keepout.cli import options
from keepout.cli.options import AsJson, Commands, MeshFile, Settings, app, example, grouped, into
from keepout.core.errors import ScenarioError, UsageError
from keepout.core.progress import Progress
from keepout.flights.pages import terminal

scenarios = Commands(
    help="Write, check and explain scenario files.",
    no_args_is_help=True,
    epilog=example("keepout scenario new --for satellite.glb -o mission.toml", "keepout scenario check mission.toml"),
)


app.add_typer(scenarios, name="scenario")


@scenarios.command("new", epilog=example("keepout scenario new --for satellite.glb --units m -o mission.toml"))
@grouped
def new_scenario(
    *,
    out: Annotated[Path | None, into("The .toml to write, instead of standard output.")] = None,
    target: Annotated[
        str | None, typer.Option("--for", help="A mesh file or built-in target, to fill in its sizes.")
    ] = None,
    profile: Annotated[str, typer.Option(help="Of the control law: default or paper.")] = "default",
    approach: Annotated[
        bool,
        typer.Option("--approach", help="Lead over hold points, with a keep-out sphere and a corridor."),
    ] = False,
    read: MeshFile,
    force: Annotated[bool, typer.Option("--force", help="Replace a file that is there.")] = False,
    as_json: AsJson = False,
) -> None:
    """Write a scenario that explains itself: every entry with its meaning, unit and default.

    With --for it has a free start and goal, a speed that the thrusters honour, and enough time.
    """
    given = {key: value for key, value in {"source": target, **vars(read)}.items() if value}
    with terminal.progress("scenario new") as progress:
        summary = _drafted(given, out, profile, approach, force, progress)
    if out is None and not as_json:
        sys.stdout.write(summary["text"])
        return
    told = [f"written to {out}", *(f"next: {step}" for step in summary["next"])]
    options.answer(summary, as_json, *map(terminal.Line, told))


def _drafted(
    given: Mapping[str, Any], out: Path | None, profile: str, approach: bool, force: bool, progress: Progress
) -> dict[str, Any]:
    """Draft a scenario, for a target where `given` names one, and write it to `out` where that is given."""
    from keepout.core.whole_file import write_whole
    from keepout.verbs.draft import draft

    if out is not None:
        options.require_file(out, ".toml", "a scenario file", refusal=ScenarioError)
        if out.exists() and not force:
            raise ScenarioError(f"{out}: is there already; --force replaces it")
    if profile not in ("default", "paper"):
        raise UsageError(f"--profile: {profile!r}; it must be 'default' or 'paper'")
    if approach and "source" not in given:
        raise UsageError("--approach: only with --for, which names the target")
    if "source" not in given and given:
        raise UsageError(f"--{next(iter(given)).replace('_', '-')}: only with --for, which names the mesh")
    name = "mission" if out is None else "".join(c if c.isalnum() and c.isascii() else "-" for c in out.stem).strip("-")
    made = draft(
        **given,
        name=name or "mission",
        folder=Path() if out is None else out.parent,
        profile=profile,
        approach=approach,
        progress=progress,
    )
    if out is not None:
        write_whole(out, made.text, refusal=ScenarioError)
    chaser = made.scenario.chaser
    return {
        "scenario": None if out is None else str(out),
        "text": made.text,
        "extents_m": made.extents,
        "start_m": list(made.scenario.start.position),
        "goal_m": list(made.scenario.goal.position),
        "speed_limit_mps": chaser.speed_limit,
        "honoured_speed_mps": made.honoured_speed,
        "margin_m": made.scenario.safety.margin,
        "duration_s": made.scenario.duration,
        "next": [*made.remarks, *([] if out is None else [f"keepout scenario check {out}", f"keepout fly {out}"])],
    }


@scenarios.command("check", epilog=example("keepout scenario check mission.toml"))
def check_scenario(
    scenario: Annotated[Path, typer.Argument(help="A scenario file (TOML).")],
    settings: Settings = None,
    as_json: AsJson = False,
) -> None:
    """Say what a scenario would fly: conditions, time, Δv.

    If it would be refused, give the nearest values that would not be, with exit code 1.
    """
    with terminal.progress(f"check {scenario.name}") as progress:
        mission = options.mission_of(scenario, None, settings)  # before what checks it is imported, which takes seconds
        from keepout.verbs.check import check

        summary = check(mission, progress=progress).summary()
    options.answer(summary, as_json, *terminal.check_parts(summary))
    if not summary["flies"]:
        raise typer.Exit(1)


@scenarios.command("schema", epilog=example("keepout scenario schema -o keepout.schema.json"))
def schema_of_scenarios(
    out: Annotated[Path | None, into("The .json to write, instead of standard output.")] = None,
) -> None:
    """Write the JSON Schema of scenarios, for editors to complete and check them."""
    from keepout.core.mission.scenario import schema
    from keepout.core.whole_file import require_place, write_whole

    if out is not None:
        require_place(out, refusal=ScenarioError)
    text = json.dumps(schema(), indent=2, ensure_ascii=False) + "\n"
    if out is not None:
        write_whole(out, text, refusal=ScenarioError)
    sys.stdout.write(text if out is None else f"written to {out}\n")
