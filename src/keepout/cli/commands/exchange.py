"""Commands on files of others as functions: what `export` and `audit` do."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from keepout.cli.commands import usage
from keepout.cli.commands.named_target import recorded_target, target_entry
from keepout.core.errors import ExchangeError, UsageError
from keepout.core.progress import Progress, silent
from keepout.core.whole_file import require_place

if TYPE_CHECKING:
    from keepout.core.mission.entries import TargetEntry


def export_to_file(
    source: Path,
    to: str,
    out: Path,
    *,
    craft: str | None = None,
    xml: bool = False,
    chaser_radius: float | None = None,
    mesh: str | None = None,
    seed: int = 0,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Write a flight file or a field file in another program's format `to`; OEM and AEM in XML if `out` is `.xml`."""
    from keepout.flights.exchange.export import check_export, export_field, export_flight

    given = {"--of": craft is not None, "--xml": xml, "--mesh": mesh is not None}
    with usage():
        check_export(source, to, craft=craft, given=given | {"--chaser-radius": chaser_radius is not None})
    if not out.absolute().parent.is_dir():
        raise ExchangeError(f"{out}: the folder {out.parent} does not exist")
    require_place(out, refusal=ExchangeError)
    chosen: dict[str, Any] = {"progress": progress}
    if source.suffix == ".keepout":
        from keepout.core.fields.model import FieldModel
        from keepout.core.mission.build import load_target

        model = FieldModel.load(source)
        target = load_target(recorded_target(source, model, mesh)) if to == "glb" else None
        written = export_field(model, to, out, target=target, chaser_radius=chaser_radius, seed=seed, **chosen)  # pyright: ignore[reportArgumentType]
    else:
        xml = xml or out.suffix.lower() == ".xml"
        written = export_flight(source, to, out, craft=craft or "chaser", xml=xml, mesh=mesh, **chosen)  # pyright: ignore[reportArgumentType]
    progress(1.0, "")
    return {"source": str(source), "to": to, "file": str(out), **written}


def audit_of_files(
    target: str,
    *,
    placed: Mapping[str, Any],
    centre_of_mass: tuple[float, float, float] | None,
    **files: Any,
) -> dict[str, Any]:
    """Bound the clearance of a flight told by OEM and AEM files.

    Args:
        target: a mesh file, a built-in's name, or a scenario file (TOML), whose table `[target]` says all of it.
        placed: of a mesh: entries of `[target]` that say how it lies in the body frame; None where not given.
        centre_of_mass: of the target, in the body frame, m; the scenario's, or the origin, which a remark
            says, where not given.
        **files: the other entries of `exchange.audited.Given`, and `progress`.

    """
    from keepout.core.mission.target import load_target
    from keepout.flights.exchange.audited import Given, audit_files

    fixed_in = files.get("fixed_in")
    if fixed_in not in (None, "vvlh", "inertial"):
        raise UsageError(f"--target-fixed-in {fixed_in}: valid: vvlh, inertial")
    entry = _audited_target(target, placed)
    told = entry.centre_of_mass if "centre_of_mass" in entry.model_fields_set else None
    centre = told if centre_of_mass is None else centre_of_mass
    progress = files.pop("progress", silent)
    return audit_files(load_target(entry), Given(centre_of_mass=centre, **files), progress=progress)


def _audited_target(target: str, placed: Mapping[str, Any]) -> "TargetEntry":
    if not target.lower().endswith(".toml"):
        return target_entry({"source": target, **placed}, options="--target-")
    given = next((name for name, value in placed.items() if value is not None), None)
    if given is not None:
        name = f"--target-{given.replace('_', '-')}"
        raise UsageError(f"{name}: not with the scenario {target}, whose [target] says how its mesh lies")
    from keepout.core.mission.scenario import Scenario

    return Scenario.load(Path(target)).target
