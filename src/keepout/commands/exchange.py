"""Commands on files of others as functions: what `export` does."""

from pathlib import Path
from typing import Any

from keepout.commands.named_target import recorded_target
from keepout.progress import Progress, silent


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
    from keepout.exchange.export import check_export, export_field, export_flight

    given = {"--of": craft is not None, "--xml": xml, "--mesh": mesh is not None}
    check_export(source, to, out, craft=craft, given=given | {"--chaser-radius": chaser_radius is not None})
    chosen: dict[str, Any] = {"progress": progress}
    if source.suffix == ".keepout":
        from keepout.fields.model import FieldModel
        from keepout.mission.build import load_target

        model = FieldModel.load(source)
        target = load_target(recorded_target(source, model, mesh)) if to == "glb" else None
        written = export_field(model, to, out, target=target, chaser_radius=chaser_radius, seed=seed, **chosen)  # pyright: ignore[reportArgumentType]
    else:
        xml = xml or out.suffix.lower() == ".xml"
        written = export_flight(source, to, out, craft=craft or "chaser", xml=xml, mesh=mesh, **chosen)  # pyright: ignore[reportArgumentType]
    progress(1.0, "")
    return {"source": str(source), "to": to, "file": str(out), **written}
