"""Commands on files of others: export, audit."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from keepout.cli import options
from keepout.cli.options import AsJson, Seed, Settings, Units, app, example, from_zero, grouped, into
from keepout.core.errors import ExchangeError, UsageError
from keepout.flights.pages import terminal

if TYPE_CHECKING:
    from keepout.core.mission.entries import TargetEntry


@dataclass(frozen=True)
class _Wanted:
    """Options on what a format writes."""

    craft: Annotated[str | None, typer.Option("--of", help="Whose OEM: chaser (if not given) or target.")] = None
    xml: Annotated[bool, typer.Option("--xml", help="Write XML, as into a file that ends in .xml.")] = False
    chaser_radius: Annotated[float | None, from_zero("Of the certificate meant, m.")] = None
    mesh: Annotated[str | None, typer.Option(help="The mesh for a GLB, if it is not where flight or field say.")] = None


@app.command(
    epilog=example(
        "keepout export out/case1/case1.parquet --to oem -o chaser.oem",
        "keepout export satellite.keepout --to onnx -o satellite.onnx",
        "keepout export mission.toml --to c -o flight",
    )
)
@grouped
def export(
    source: Annotated[Path, typer.Argument(help="A flight (.parquet, .npz), a field (.keepout) or a mission (.toml).")],
    *,
    to: Annotated[
        str,
        typer.Option(help="oem, aem, czml, csv, parquet, npz, glb of a flight; onnx, glb of a field; c of a mission."),
    ],
    out: Annotated[Path, into("The file to write; of flight code the folder.")],
    wanted: _Wanted,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> None:
    """Write a flight, a field or a mission's flight code for other programs."""
    from keepout.flights.exchange.export import Export

    if source.suffix != ".toml":
        with options.usage():
            Export(to, **vars(wanted)).check(source)
        options.require_file(out, "", "", refusal=ExchangeError)
    with terminal.progress(f"export {source.name}") as progress:
        from keepout.verbs.files import export as exported

        written = exported(source, to, out, seed=seed, progress=progress, **vars(wanted))
    summary = {"source": str(source), **written}
    options.answer(summary, as_json, terminal.facts_table("Export", summary))


@dataclass(frozen=True)
class _Given:
    """Options that `Given` is made of: the files of a flight, and what it is judged by."""

    chaser: Annotated[Path, typer.Option(help="OEM of the chaser's centre.")]
    target_orbit: Annotated[Path, typer.Option(help="OEM of the target's centre of mass.")]
    chaser_radius: Annotated[float, from_zero("Of the ball that holds the chaser, m.")]
    acceleration_bound: Annotated[
        float,
        from_zero("Of the chaser relative to the target, inertial, of all causes, m/s²."),
    ]
    target_attitude: Annotated[Path | None, typer.Option(help="AEM of the target.")] = None
    target_fixed_in: Annotated[str | None, typer.Option(help="Without an AEM: vvlh (if not given) or inertial.")] = None
    turning_acceleration_bound: Annotated[
        float | None,
        from_zero("Of the target, rad/s², instead of one measured."),
    ] = None
    centre_of_mass: Annotated[
        tuple[float, float, float] | None,
        typer.Option(help="Of the target, body axes, m, if not the scenario's or 0 0 0."),
    ] = None
    chaser_object: Annotated[str | None, typer.Option(help="OBJECT_NAME or OBJECT_ID that its OEM must have.")] = None
    target_object: Annotated[str | None, typer.Option(help="OBJECT_NAME or OBJECT_ID that its OEM must have.")] = None
    attitude_object: Annotated[
        str | None, typer.Option(help="The target's name in the AEM, if not that of its OEM.")
    ] = None
    attitude_frame: Annotated[
        str | None, typer.Option(help="The body frame's name there, if not SC_BODY or SC_BODY_1.")
    ] = None
    sample_error: Annotated[float, from_zero("Of relative positions, m, if more than of their digits.")] = 1e-6
    attitude_error: Annotated[float, from_zero("Of attitudes, rad, if more than of their digits.")] = 0.0


@dataclass(frozen=True)
class _Placed:
    """Options on how the target's mesh lies, named like the entries of `[target]`."""

    target_units: Units = None
    target_scale: Annotated[float | None, typer.Option(help="Metres per unit of a mesh file, instead of units.")] = None
    target_drop_stray: Annotated[
        bool, typer.Option("--target-drop-stray", help="Leave out parts far from the rest.")
    ] = False
    target_thickness: Annotated[
        float | None, typer.Option(help="Diameter of the ball that each point of a point cloud stands for, m.")
    ] = None
    target_rotation: Annotated[
        tuple[float, float, float, float, float, float, float, float, float] | None,
        typer.Option(help="Rotation from file axes to body axes, row by row.", metavar="NINE NUMBERS"),
    ] = None
    target_origin: Annotated[
        tuple[float, float, float] | None, typer.Option(help="The body frame's origin in file axes, m.")
    ] = None

    def entry(self, target: str, settings: list[str] | None) -> "TargetEntry":
        """Make the entry `[target]` of a mesh, or give a scenario's with `settings`."""
        told = {key.removeprefix("target_"): value for key, value in vars(self).items()}
        if target.lower().endswith(".toml"):
            return options.mission_for_mesh(target, told, options="--target-", settings=settings).target
        for setting in settings or ():
            raise UsageError(f"--set {setting}: only with a scenario file (.toml) as --target, not {target}")
        if told["rotation"] is not None:
            told["rotation"] = tuple(told["rotation"][row : row + 3] for row in (0, 3, 6))
        return options.target_entry({"source": target, **told}, options="--target-")


@app.command(
    epilog=example(
        "keepout audit --target satellite.glb --target-units m --chaser chaser.oem --target-orbit target.oem "
        "--target-attitude target.aem --chaser-radius 0.5 --acceleration-bound 0.01"
    )
)
@grouped
def audit(
    target: Annotated[
        str,
        typer.Option(help="A mesh file, a built-in target, or a scenario's (.toml)."),
    ],
    given: _Given,
    placed: _Placed,
    settings: Settings = None,
    as_json: AsJson = False,
) -> None:
    """Bound the clearance of a flight told by OEM and AEM files, between its samples too, on the exact mesh.

    Exit code 0 whatever the verdict is: it is in the answer.
    """
    with terminal.progress("audit") as progress:
        if given.target_fixed_in not in (None, "vvlh", "inertial"):
            raise UsageError(f"--target-fixed-in {given.target_fixed_in}: valid: vvlh, inertial")
        entry = placed.entry(target, settings)
        from keepout.verbs.files import audit as audited

        summary = audited(**vars(given), target=entry, progress=progress)
    told = {key: value for key, value in summary.items() if key != "assumptions"}
    assumed = terminal.facts_table("It assumes", summary["assumptions"])
    options.answer(summary, as_json, terminal.facts_table("Audit", told), assumed)
