"""The command line: reads arguments, calls the package, shows the answer. No logic lives here."""

import gc
import json
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from typer.core import TyperGroup
from typer.exceptions import TyperException

import keepout
from keepout.errors import KeepoutError
from keepout.report import terminal

app = typer.Typer(
    help="Learn a spacecraft's shape, prove how wrong it can be, and fly around it without touching it.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
)


def _at_least(least: int | float) -> Callable[[int | float | None], int | float | None]:
    """Refuse a smaller number with the value and what would be valid."""

    def check(value: int | float | None) -> int | float | None:
        if value is not None and not value >= least:
            raise typer.BadParameter(f"{value} is not valid; it must be at least {least:g}")
        return value

    return check


AsJson = Annotated[bool, typer.Option("--json", help="One JSON object on standard output; all else on standard error.")]
Seed = Annotated[
    int, typer.Option(callback=_at_least(0), help="Of every random choice; the same seed gives the same answer.")
]
ScenarioSeed = Annotated[int | None, typer.Option(callback=_at_least(0), help="Replaces the scenario's own seed.")]
Units = Annotated[str | None, typer.Option(help="Length unit of a mesh file: m, cm, mm, in or ft.")]
Scale = Annotated[float | None, typer.Option(help="Metres per unit of a mesh file, instead of --units.")]
DropStray = Annotated[bool, typer.Option("--drop-stray", help="Leave out parts far from the rest.")]
ChaserRadius = Annotated[
    float, typer.Option(callback=_at_least(0.0), help="Radius of the ball that holds the chaser, m.")
]


def example(*lines: str) -> str:
    """Format the example shown at the end of a command's help."""
    return "**Example**\n\n" + "\n\n".join(f"`{line}`" for line in lines)


def _answer(summary: Any, as_json: bool) -> None:
    """Print the machine's answer on standard output, or the person's tables."""
    if as_json:
        sys.stdout.write(json.dumps(summary, indent=2, allow_nan=False) + "\n")


@app.callback(invoke_without_command=True)
def _version(
    version: Annotated[bool, typer.Option("--version", is_eager=True, help="Print the version and stop.")] = False,
) -> None:
    if version:
        sys.stdout.write(f"keepout {keepout.__version__}\n")
        raise typer.Exit


@app.command(epilog=example("keepout targets", "keepout targets --pictures out/targets"))
def targets(
    pictures: Annotated[Path | None, typer.Option(help="Also draw each target into this folder.")] = None,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> None:
    """List the built-in targets: extents, volume, triangles, parameters."""
    from keepout.commands import describe_targets

    with terminal.progress("targets") as progress:
        rows = describe_targets(pictures=pictures, progress=progress)
    _answer({"targets": rows, "seed": seed}, as_json)
    if not as_json:
        Console().print(terminal.targets_table(rows))


@app.command(epilog=example("keepout fit satellite.glb --units m -o satellite.keepout"))
def fit(
    mesh: Annotated[str, typer.Argument(help="A mesh file, or a built-in target's name.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The field file to write (.keepout).")],
    profile: Annotated[
        str,
        typer.Option(
            help="default; quick, rough, for trying out; paper, the source paper's network and loss; "
            "paper_printed, with the loss as printed."
        ),
    ] = "default",
    chaser_radius: ChaserRadius = 0.5,
    units: Units = None,
    scale: Scale = None,
    drop_stray: DropStray = False,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> None:
    """Learn a target's signed distance, tightest where the chaser touches.

    A killed run resumes from its last checkpoint when started again.
    """
    from keepout.commands import fit_to_file

    source = {"source": mesh, "units": units, "scale": scale, "drop_stray": drop_stray}
    with terminal.progress(f"fit {mesh}") as progress:
        summary = fit_to_file(source, out, profile=profile, chaser_radius=chaser_radius, seed=seed, progress=progress)
    _answer(summary, as_json)
    if not as_json:
        Console().print(terminal.facts_table("Fit", summary))


@app.command(epilog=example("keepout certify satellite.keepout --chaser-radius 0.5"))
def certify(
    field: Annotated[Path, typer.Argument(help="A field file (.keepout); the certificate is added to it.")],
    chaser_radius: ChaserRadius = 0.5,
    prove_slope: Annotated[bool, typer.Option("--prove-slope", help="Prove a bound of ‖∇f̃‖ too: minutes.")] = False,
    mesh: Annotated[str | None, typer.Option(help="The mesh, where it is not where `fit` found it.")] = None,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> None:
    """Bound how far the field can over-state the distance where a chaser of this radius would touch."""
    from keepout.commands import certify_file

    with terminal.progress(f"certify {field.name}") as progress:
        summary = certify_file(
            field, chaser_radius=chaser_radius, prove_slope=prove_slope, mesh=mesh, seed=seed, progress=progress
        )
    _answer(summary, as_json)
    if not as_json:
        Console().print(terminal.facts_table("Certificate", summary))


@app.command(
    epilog=example(
        "keepout inspect satellite.keepout -o out/satellite",
        "keepout inspect satellite.glb",
        "keepout inspect intelsat30 --shipped",
    )
)
def inspect(
    source: Annotated[str, typer.Argument(help="A field file (.keepout), a mesh file, or a built-in target's name.")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Also draw it into this folder.")] = None,
    mesh: Annotated[
        str | None, typer.Option(help="Of a field: the mesh, where it is not where `fit` found it.")
    ] = None,
    shipped: Annotated[
        bool, typer.Option("--shipped", help="Of a built-in target: measure the field that comes with the package.")
    ] = False,
    units: Units = None,
    scale: Scale = None,
    drop_stray: DropStray = False,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> None:
    """Measure a field against its mesh and list its certificates; or report what is wrong with a mesh."""
    from keepout.commands import inspect_file, inspect_mesh
    from keepout.fields.shipped import shipped_path

    of_field = shipped or source.endswith(".keepout")
    if mesh is not None and not of_field:
        raise typer.BadParameter(f"{mesh}: only a field has a mesh to be named; {source} is not a .keepout file")
    with terminal.progress(f"inspect {source}") as progress:
        if of_field:
            path = shipped_path(source) if shipped else Path(source)
            summary = inspect_file(path, out, mesh=mesh, seed=seed, progress=progress)
            tables = terminal.inspection_tables(summary)
        else:
            given = {"source": source, "units": units, "scale": scale, "drop_stray": drop_stray}
            summary = inspect_mesh(given, out, progress=progress)
            tables = [terminal.facts_table("Mesh", summary)]
    _answer(summary, as_json)
    if not as_json:
        for table in tables:
            Console().print(table)


@app.command(epilog=example("keepout fly examples/case1.toml -o out/case1"))
def fly(
    scenario: Annotated[Path, typer.Argument(help="A scenario file (TOML).")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for flight file, figures and page.")] = Path("out"),
    figures: Annotated[bool, typer.Option(help="Draw figures and the page.")] = True,
    seed: ScenarioSeed = None,
    as_json: AsJson = False,
) -> None:
    """Fly one scenario, audit the clearance on the exact mesh, and draw it."""
    from keepout.commands import fly_to_folder
    from keepout.mission.scenario import Scenario

    mission = Scenario.load(scenario)
    if seed is not None:
        mission = mission.replace(seed=seed)
    with terminal.progress(f"fly {mission.name}") as progress:
        summary = fly_to_folder(mission, out, figures=figures, progress=progress)
    _answer(summary, as_json)
    if not as_json:
        Console().print(terminal.flights_table([summary]))
        Console().print(f"written to [bold]{out}[/bold]")


class _FlyUnlessNamed(TyperGroup):
    """A group whose first command is meant where none is named: `keepout campaign mission.toml` flies."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        first = args[0] if args else None
        return super().parse_args(ctx, args if first in (*self.commands, "--help") else ["fly", *args])


campaigns = typer.Typer(
    cls=_FlyUnlessNamed,
    help="Fly a scenario many times, with whatever varies drawn anew for each flight, and audit every flight.\n\n"
    "`keepout campaign MISSION.toml -o OUT` is short for `keepout campaign fly MISSION.toml -o OUT`; its options are "
    "--runs, --keep, --batch, --scheduler, --mixed-processors, --seed and --json.",
    epilog=example(
        "keepout campaign examples/case1.toml --runs 1000 -o out/campaign",
        "keepout campaign replay out/campaign --run 47",
    ),
)
app.add_typer(campaigns, name="campaign")


@campaigns.command("fly", epilog=example("keepout campaign examples/case1.toml --runs 1000 -o out/campaign"))
def campaign(
    scenario: Annotated[Path, typer.Argument(help="A scenario file (TOML) with its [campaign] table.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for results and figure.")] = Path("out"),
    runs: Annotated[
        int | None, typer.Option(callback=_at_least(1), help="Replaces the scenario's own number of flights.")
    ] = None,
    keep: Annotated[
        str, typer.Option(help="Flights that become flight files: worst:N, by least clearance, all or none.")
    ] = "worst:20",
    batch: Annotated[
        int | None, typer.Option(callback=_at_least(1), help="Flights at once; part of what the campaign is.")
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(help="Who flies: tcp://HOST:PORT, a dask.distributed cluster; local or local:N, processes here."),
    ] = None,
    mixed_processors: Annotated[
        bool, typer.Option("--mixed-processors", help="Let processors of several kinds fly, with other last bits.")
    ] = False,
    seed: ScenarioSeed = None,
    as_json: AsJson = False,
) -> None:
    """Fly a scenario's campaign into a folder; stopped and started again, it goes on.

    With --json, a line of JSON a second says on standard error how far it is.
    """
    from keepout.commands import campaign_to_folder
    from keepout.mission.scenario import Scenario

    mission = Scenario.load(scenario)
    if seed is not None:
        mission = mission.replace(seed=seed)
    if runs is not None:
        mission = mission.replace(campaign={"runs": runs})
    chosen = {"batch": batch, "keep": keep, "scheduler": scheduler, "mixed_processors": mixed_processors}
    if as_json:
        summary = campaign_to_folder(mission, out, **chosen, told=terminal.standing_lines())
    else:
        with terminal.progress(f"campaign {mission.name}") as progress:
            summary = campaign_to_folder(mission, out, **chosen, progress=progress)
    _answer(summary, as_json)
    if not as_json:
        # What the guard assumes is for the file: two dozen numbers.
        left_out = ("guard", "kept", "refusals", "rates", "page")
        Console().print(terminal.facts_table("Campaign", {k: v for k, v in summary.items() if k not in left_out}))
        _print_rates(summary)


def _print_rates(report: dict[str, Any]) -> None:
    Console().print(terminal.rates_table(report["rates"]))
    Console().print(f"open {report['page']}", highlight=False, markup=False, soft_wrap=True)


@campaigns.command("report", epilog=example("keepout campaign report out/campaign"))
def report(
    folder: Annotated[Path, typer.Argument(help="The folder of a campaign, finished or not.")],
    as_json: AsJson = False,
) -> None:
    """Write a campaign's page, figures and CSV files anew: rates, distributions, what matters, the worst flights."""
    from keepout.report.campaign_page import report_campaign

    with terminal.progress(f"report {folder.name}") as progress:
        summary = report_campaign(folder, progress=progress)
    _answer(summary, as_json)
    if not as_json:
        _print_rates(summary)


@campaigns.command("compare", epilog=example("keepout campaign compare out/guarded out/unguarded -o out/compared"))
def compare(
    first: Annotated[Path, typer.Argument(help="The folder of a finished campaign.")],
    second: Annotated[Path, typer.Argument(help="Another one.")],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Also write page, figures and CSV files into this folder.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Compare two finished campaigns: rates, quantiles, and run by run where both drew the same."""
    from keepout.report.comparison_page import compare_campaigns

    with terminal.progress("compare") as progress:
        summary = compare_campaigns(first, second, out, progress=progress)
    _answer(summary, as_json)
    if not as_json:
        for table in terminal.comparison_tables(summary):
            Console().print(table)
        for words in summary["words"]:
            Console().print(words, highlight=False, markup=False)
        if "page" in summary:
            Console().print(f"open {summary['page']}", highlight=False, markup=False, soft_wrap=True)


@campaigns.command("replay", epilog=example("keepout campaign replay out/campaign --run 47"))
def replay_run(
    folder: Annotated[Path, typer.Argument(help="The folder of a campaign.")],
    run: Annotated[int, typer.Option(callback=_at_least(0), help="Number of the run, as in the table.")],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder to write; by default run-N in that of the campaign.")
    ] = None,
    figures: Annotated[bool, typer.Option(help="Draw figures and the page.")] = True,
    as_json: AsJson = False,
) -> None:
    """Fly one run of a campaign again, to the same bits; write its flight file, figures and page."""
    from keepout.commands import replay_to_folder

    with terminal.progress(f"replay {run}") as progress:
        summary = replay_to_folder(folder, run, out, figures=figures, progress=progress)
    _answer(summary, as_json)
    if not as_json:
        Console().print(terminal.flights_table([summary]))
        same = "equal to its row in the campaign" if summary["equal"] else f"differs: {summary['differences']}"
        Console().print(f"run {run}: {same}", highlight=False, markup=False)


@app.command(epilog=example("keepout rare examples/case1.toml --below 0 -o out/rare"))
def rare(
    scenario: Annotated[Path, typer.Argument(help="A scenario file (TOML) in which something is random.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for results, figure and page.")] = Path("out"),
    below: Annotated[float, typer.Option(help="The clearance, m; 0 is contact.")] = 0.0,
    runs: Annotated[int, typer.Option(callback=_at_least(2), help="Whose spread gives the interval.")] = 8,
    flights: Annotated[
        int, typer.Option(callback=_at_least(64), help="Of each level and run; a multiple of 8.")
    ] = 1024,
    quick: Annotated[bool, typer.Option("--quick", help="256 flights of each level and run: a rough answer.")] = False,
    seed: ScenarioSeed = None,
    as_json: AsJson = False,
) -> None:
    """Measure how probable a contact is where nothing is proved, by subset simulation.

    A killed run goes on from its last level when started again.
    """
    from keepout.commands import rare_to_folder
    from keepout.mission.scenario import Scenario

    mission = Scenario.load(scenario)
    if seed is not None:
        mission = mission.replace(seed=seed)
    with terminal.progress(f"rare {mission.name}") as progress:
        summary = rare_to_folder(
            mission, out, below=below, runs=runs, flights=256 if quick else flights, progress=progress
        )
    _answer(summary, as_json)
    if not as_json:
        Console().print(summary["said"])
        Console().print(f"written to [bold]{out}[/bold]")


@app.command(epilog=example("keepout reproduce all --quick -o out/paper"))
def reproduce(
    experiments: Annotated[
        list[str], typer.Argument(help="all, or any of table1, surfaces, volumes, case1, case2, runtime, case3.")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for tables, figures and page.")] = Path("out"),
    quick: Annotated[bool, typer.Option("--quick", help="Fewer flights, shipped fields: minutes.")] = False,
    fields: Annotated[
        Path | None,
        typer.Option(
            help="Folder with fields of the paper's network, instead of hours of fitting: benchmarks/results/fields."
        ),
    ] = None,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> None:
    """Repeat the source paper's tables, figures and flights, with Keepout's own answers beside them.

    The full run takes hours: it fits the paper's network, about an hour for each of three targets, unless --fields
    names a folder with its fields. A run that was stopped goes on where it was.
    """
    from keepout.experiments import reproduce as repeat

    with terminal.progress(f"reproduce {' '.join(experiments)}") as progress:
        parts = repeat(experiments, out, quick=quick, seed=seed, fields=fields, progress=progress)
    _answer([row for part in parts for row in part.named_rows], as_json)
    if not as_json:
        for part in parts:
            for table in part.tables:
                Console().print(terminal.entries_table(f"{part.title}: {table.caption}", table.rows))
        Console().print(f"open [bold]{out / 'index.html'}[/bold]; tables (CSV) and figures stand beside it")


def _show_warning(message: Warning | str, *_: Any) -> None:
    sys.stderr.write(f"keepout: warning: {message}\n")


def main() -> None:
    """Run the command line: a refusal is one line on standard error and a non-zero exit, a warning is one line."""
    warnings.showwarning = _show_warning
    # Tracing a program makes many objects that live on; looking through them for garbage took a tenth of a start.
    gc.set_threshold(1_000_000, 50, 100)
    try:
        code = app(standalone_mode=False, prog_name="keepout")
        if code == 130:  # typer turns an interrupt into this code, without a word
            raise KeyboardInterrupt
    except KeepoutError as error:
        sys.stderr.write(f"keepout: {error}\n")
        code = 1
    except TyperException as error:
        said = error.format_message().replace("\n", " ").rstrip()
        if said:  # without arguments the help has been shown, and there is nothing to add
            sys.stderr.write(f"keepout: {said}\n")
        code = 2
    except OSError as error:
        place = "" if error.filename is None else f"{error.filename}: "
        sys.stderr.write(f"keepout: {place}{error.strerror or error}\n")
        code = 1
    except KeyboardInterrupt:
        sys.stderr.write("keepout: stopped\n")
        code = 130
    gc.freeze()  # what is left goes with the process; looking through it took longest of all
    sys.exit(code if isinstance(code, int) else 0)


if __name__ == "__main__":
    main()
