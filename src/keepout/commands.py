"""Each command of the command line as a function from its arguments to its JSON summary.

Each imports what it needs when it is called: who lists targets does not wait for what flies and draws.
"""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from keepout.errors import FieldError, FlightError, ScenarioError
from keepout.progress import Progress, part_of, silent

if TYPE_CHECKING:
    from keepout.campaign.run import Standing
    from keepout.fields.model import FieldModel
    from keepout.mission.entries import TargetEntry
    from keepout.mission.scenario import Scenario


def describe_targets(*, pictures: Path | None = None, progress: Progress = silent) -> list[dict[str, Any]]:
    """List the built-in targets with size, triangles and parameters; draw them into `pictures` where it is given."""
    from keepout.fields.shipped import shipped_names
    from keepout.geometry.builtin import BUILTINS
    from keepout.geometry.shape import enclosed_volume
    from keepout.geometry.target import Target
    from keepout.report.folder import make_folder

    if pictures is not None:
        make_folder(pictures)
    rows = []
    for place, (name, builtin) in enumerate(BUILTINS.items()):
        progress(place / len(BUILTINS), name)
        target = Target.load(name)
        row: dict[str, Any] = {
            "name": name,
            "extents_m": [float(extent) for extent in target.vertices.max(axis=0) - target.vertices.min(axis=0)],
            "volume_m3": enclosed_volume(target.vertices, target.faces),
            "triangles": len(target.faces),
            "shipped_field": name in shipped_names(),
            "parameters": {key: parameter.default for key, parameter in builtin.parameters.items()},
        }
        if pictures is not None:
            from keepout.report import target_view

            picture = pictures / f"{name}.png"
            target_view.draw_target(picture, name, target.vertices, target.faces)
            row["picture"] = str(picture)
        rows.append(row)
    return rows


def _entry(source: Mapping[str, Any]) -> "TargetEntry":
    from keepout.mission.scenario import Scenario

    given = {key: value for key, value in source.items() if value is not None}
    try:
        return Scenario.parse({"target": given}).target
    except ScenarioError as error:  # the user gave options, not a scenario
        raise ScenarioError(str(error).replace("scenario: target.", "--")) from None


def _field_path(path: Path) -> Path:
    if path.suffix != ".keepout":
        raise FieldError(f"{path}: a field file ends in .keepout")
    if not path.absolute().parent.is_dir():
        raise FieldError(f"{path}: the folder {path.parent} does not exist")
    return path


def fit_to_file(
    source: Mapping[str, Any],
    out: Path,
    *,
    profile: str = "default",
    chaser_radius: float = 0.5,
    certified: bool = False,
    seed: int = 0,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Learn the field of a mesh file or built-in target and write it to `out`, where asked with its certificate.

    While it runs, a checkpoint stands beside `out`; a run that was killed goes on from there. The field is written
    before it is certified, so that a proof that is stopped loses nothing.
    """
    from keepout.learning.training import fit
    from keepout.measures.quality import surface_errors
    from keepout.mission.build import load_target

    out = _field_path(out)
    entry = _entry(source)
    target = load_target(entry)
    start = time.perf_counter()
    model = fit(
        target,
        profile=profile,
        chaser_radius=chaser_radius,
        seed=seed,
        checkpoint=out.with_name(out.name + ".checkpoint"),
        progress=part_of(progress, 0.0, 0.9) if certified else progress,
    )
    seconds = time.perf_counter() - start
    located = entry.model_dump()
    if Path(entry.source).exists():
        located["source"] = str(Path(entry.source).resolve())
    model = model.with_training(target=located)
    model.save(out)
    errors = surface_errors(model.field, target, seed=seed)
    proof: dict[str, Any] = {}
    if certified:
        part = part_of(progress, 0.9, 1.0)
        proof["certificate"] = certify_file(out, chaser_radius=chaser_radius, seed=seed, progress=part)
    return {
        "field": str(out),
        "seconds": seconds,
        "epsilon_m": errors.epsilon,
        "epsilon_plus_m": errors.epsilon_plus,
        "sampled_maximum_m": errors.maximum,
        "profile": profile,
        "seed": seed,
        "target": target.name,
        "target_sha256": target.sha256,
        "warnings": list(target.report.warnings),
        **proof,
    }


def certify_file(
    path: Path,
    *,
    chaser_radius: float,
    prove_slope: bool = False,
    mesh: str | None = None,
    seed: int = 0,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Add a certificate for a chaser radius to a field file; the mesh is found where `fit` found it unless given."""
    from keepout.fields.model import FieldModel
    from keepout.mission.build import load_target
    from keepout.proof.certificate import certify

    model = FieldModel.load(path)
    entry = _recorded_target(path, model, mesh)
    model = certify(
        model,
        load_target(entry),
        chaser_radius=chaser_radius,
        prove_slope=prove_slope,
        seed=seed,
        progress=progress,
    )
    model.save(path)
    certificate = model.certificate(chaser_radius)
    return {
        "field": str(path),
        "kind": certificate.kind,
        "error_bound_m": certificate.error_bound,
        "chaser_radius_m": certificate.chaser_radius,
        "sampled_maximum_m": certificate.sampled_maximum,
        "gradient_bound": certificate.gradient_bound,
        "gradient_kind": certificate.gradient_kind,
        "gradient_found": certificate.gradient_found,
        "seconds": certificate.seconds,
        "target_sha256": certificate.target_sha256,
    }


def inspect_file(
    path: Path, out: Path | None = None, *, mesh: str | None = None, seed: int = 0, progress: Progress = silent
) -> dict[str, Any]:
    """Measure a field against its mesh and list its certificates; draw slices and surface into `out` if given."""
    from keepout.fields.model import FieldModel
    from keepout.measures.inspection import inspect_model
    from keepout.mission.build import load_target
    from keepout.report.folder import make_folder

    model = FieldModel.load(path)
    target = load_target(_recorded_target(path, model, mesh))
    model = FieldModel.load(path, target=target)
    if out is not None:
        make_folder(out)
    measures, surface = inspect_model(model, target, seed=seed, progress=part_of(progress, 0.0, 0.9))
    summary: dict[str, Any] = {"field": str(path), **measures}
    if out is not None:
        from keepout.report.field_view import draw_slices, draw_surface

        progress(0.9, "pictures")
        draw_slices(out / "slices.png", model, target)
        draw_surface(out / "surface.png", target, surface, level=measures["surface"]["level"])
        summary["pictures"] = [str(out / "slices.png"), str(out / "surface.png")]
    progress(1.0, "")
    return summary


def inspect_mesh(source: Mapping[str, Any], out: Path | None = None, *, progress: Progress = silent) -> dict[str, Any]:
    """Report what is known about a mesh before anything is learned from it; draw it into `out` if that is given."""
    from keepout.geometry.survey import survey
    from keepout.mission.build import load_target
    from keepout.report.folder import make_folder

    target = load_target(_entry(source))
    summary: dict[str, Any] = {"lengths": _lengths(source)}
    summary |= asdict(survey(target, progress=part_of(progress, 0.0, 0.95)))
    if out is not None:
        from keepout.report import target_view

        make_folder(out)
        picture = out / f"{target.name}.png"
        target_view.draw_target(picture, target.name, target.vertices, target.faces)
        summary["picture"] = str(picture)
    progress(1.0, "")
    return summary


def _lengths(source: Mapping[str, Any]) -> str:
    """Say in which unit a mesh's report is, and what the file's numbers were taken for."""
    if source.get("scale") is not None:
        return f"m; one unit of the file is {source['scale']:g} m, as given"
    if source.get("units") is not None:
        return f"m; the file's numbers are in {source['units']}, as given"
    if not Path(source["source"]).exists():
        return "m"  # a built-in target
    return "m; no --units or --scale was given, so the file's own unit holds, or metres where it names none"


def _recorded_target(path: Path, model: "FieldModel", mesh: str | None) -> "TargetEntry":
    """Say where a field's mesh is: as given, or as `fit` recorded it, or the built-in of its name."""
    from keepout.geometry.builtin import BUILTINS

    recorded = model.training.get("target")
    if mesh is not None:
        return _entry({**(recorded or {}), "source": mesh})
    if recorded is not None:
        return _entry(recorded)
    if model.target_name in BUILTINS:
        return _entry({"source": model.target_name})
    raise FieldError(f"{path}: does not say where its mesh is; name it with --mesh")


def new_scenario_file(
    source: Mapping[str, Any],
    out: Path | None,
    *,
    profile: str = "default",
    force: bool = False,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Draft a scenario, for a target where `source` names one, and write it to `out` where that is given."""
    from keepout.mission.draft import draft
    from keepout.whole_file import write_whole

    if out is not None and out.suffix != ".toml":
        raise ScenarioError(f"{out}: a scenario file ends in .toml")
    if out is not None and out.exists() and not force:
        raise ScenarioError(f"{out}: is there already; --force replaces it")
    if out is not None and not out.absolute().parent.is_dir():
        raise ScenarioError(f"{out}: the folder {out.parent} does not exist")
    if profile not in ("default", "paper"):
        raise ScenarioError(f"--profile: {profile!r}; it must be 'default' or 'paper'")
    given = {key: value for key, value in source.items() if value}
    if "source" not in given and given:
        raise ScenarioError(f"--{next(iter(given)).replace('_', '-')}: only with --for, which names the mesh")
    name = "mission" if out is None else "".join(c if c.isalnum() and c.isascii() else "-" for c in out.stem).strip("-")
    made = draft(
        **given,
        name=name or "mission",
        folder=Path() if out is None else out.parent,
        profile=profile,
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


def check_scenario_file(path: Path, *, progress: Progress = silent) -> dict[str, Any]:
    """Say what a scenario file would fly, without flying it."""
    from keepout.mission.scenario import Scenario

    scenario = Scenario.load(path)  # before what checks it is imported, which takes seconds
    from keepout.mission.check import check

    return check(scenario, progress=progress).summary()


def schema_file(out: Path | None) -> str:
    """Give the JSON Schema of scenarios as text, written to `out` where that is given."""
    from keepout.mission.schema import schema
    from keepout.whole_file import write_whole

    text = json.dumps(schema(), indent=2, ensure_ascii=False) + "\n"
    if out is not None:
        write_whole(out, text, refusal=ScenarioError)
    return text


def fly_to_folder(
    scenario: "Scenario", out: Path, *, figures: bool = True, progress: Progress = silent
) -> dict[str, Any]:
    """Fly a scenario; write flight file, figures, page and `summary.json` into `out`."""
    from keepout.mission.first_look import look

    target = look(scenario)
    from keepout.mission.flight import fly
    from keepout.report.folder import make_folder, write_flights, write_summary

    make_folder(out)
    flight = fly(scenario, target=target, progress=part_of(progress, 0.0, 0.9))
    introduction = (
        f"Target {flight.target.name}, start {list(scenario.start.position)} m, goal {list(scenario.goal.position)} m."
    )
    [summary] = write_flights(
        out, {scenario.name: flight}, title=f"Flight {scenario.name}", introduction=introduction, figures=figures
    )
    write_summary(out, summary)
    return summary


def campaign_to_folder(
    scenario: "Scenario",
    out: Path,
    *,
    batch: int | None = None,
    keep: str = "worst:20",
    scheduler: str | None = None,
    mixed_processors: bool = False,
    told: "Callable[[Standing], None]" = lambda standing: None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Fly a scenario's campaign into `out`, or what is missing of it there; then its bands, page and `summary.json`.

    `scheduler` names who flies, if not this process (`flyer_on`). `told` hears how far it is as flights land;
    `progress` too, in words.
    """
    from keepout.campaign.dataset import Dataset
    from keepout.campaign.keep import Keep, keep_flights
    from keepout.campaign.plan import Plan
    from keepout.campaign.run import fly_campaign, in_threads
    from keepout.campaign.scheduler import flyer_on
    from keepout.campaign.summary import band_figures, summary
    from keepout.report.campaign_page import report_campaign
    from keepout.report.campaign_view import DRAWN, draw_campaign
    from keepout.report.folder import write_summary
    from keepout.whole_file import write_whole

    flyer = in_threads if scheduler is None else flyer_on(scheduler, mixed_processors=mixed_processors)
    began, chosen = time.perf_counter(), Keep.parse(keep)
    progress(0.0, "preparing")
    plan = Plan.of(scenario, batch=batch)
    dataset = Dataset.begin(out, plan)

    def tell(standing: "Standing") -> None:
        told(standing)
        progress(0.05 + 0.9 * standing.done / standing.runs, standing.line())

    with dataset.lock():
        standing = fly_campaign(plan, dataset, flyer=flyer, told=tell)
        kept = keep_flights(plan, dataset, chosen, told=lambda done, of: progress(0.95, f"{done} of {of} flights kept"))
        bands = out / "bands.json"
        write_whole(bands, json.dumps(band_figures(dataset), allow_nan=False) + "\n")
        figures = {
            **summary(dataset, scenario),
            "guard": plan.guard_numbers(),
            "batch": plan.batch,
            "seconds": time.perf_counter() - began,
            "flown_now": standing.flown,
            "processors": dataset.processors(),
            "flights": str(out / "flights"),
            "bands": str(bands),
            "kept": [str(dataset.kept(run)) for run in kept],
        }
        draw_campaign(out / "campaign.png", dataset.table(list(DRAWN)))
        page = report_campaign(out, progress=part_of(progress, 0.97, 1.0))
        figures |= {"page": page["page"], "rates": page["rates"]}
        write_summary(out, figures)
    return figures


def replay_to_page(
    flights: Sequence[Path], out: Path, *, title: str | None = None, progress: Progress = silent
) -> dict[str, Any]:
    """Write a replay of flight files, all around one target, as one self-contained page."""
    from keepout.replay.flights import of_files
    from keepout.report.replay_view import write_replay

    if out.suffix.lower() not in (".html", ".htm"):
        raise FlightError(f"{out}: a replay is a page; its name ends in .html")
    gathered = of_files(flights, progress=part_of(progress, 0.0, 0.4))
    first = gathered[0]
    title = title or f"{first.scenario.name} · {first.target.name}"
    return write_replay(out, gathered, title=title, progress=part_of(progress, 0.4, 1.0))


def replay_to_folder(
    campaign: Path, run: int, out: Path | None = None, *, figures: bool = True, progress: Progress = silent
) -> dict[str, Any]:
    """Fly one run of a campaign's folder again; write what `fly_to_folder` writes, and say whether it is the same."""
    from keepout.campaign.dataset import Dataset
    from keepout.campaign.plan import Plan
    from keepout.campaign.replay import differences, replay
    from keepout.mission.scenario import Scenario
    from keepout.report.folder import write_flights, write_summary

    dataset = Dataset.open(campaign)
    identity = dataset.identity
    scenario = Scenario.parse(identity["scenario"], where=str(campaign / "campaign.json"))
    progress(0.0, "preparing")
    plan = Plan.of(scenario, batch=identity["batch"])
    dataset = Dataset.begin(campaign, plan)  # refused where mesh, field or version are others now
    out = campaign / f"run-{run}" if out is None else out
    progress(0.4, "flying")
    [again] = replay(plan, [run])
    kept = dataset.part(run // plan.chunk).slice(run % plan.chunk, 1)
    differing = differences(kept, again.row)
    progress(0.8, "writing")
    introduction = f"Run {run} of the campaign {scenario.name}, flown again."
    [summary] = write_flights(
        out,
        {f"run {run}": again.flight},
        title=f"Run {run} of {scenario.name}",
        introduction=introduction,
        figures=figures,
    )
    summary |= {
        "run": run,
        "equal": not differing,
        "differences": {name: {"campaign": a, "replay": b} for name, (a, b) in differing.items()},
        "record_apart": again.apart,
        "drawn": dict(again.run.values),
        "seed": scenario.seed,
    }
    write_summary(out, summary)
    return summary


def rare_to_folder(
    scenario: "Scenario",
    out: Path,
    *,
    below: float = 0.0,
    runs: int | None = None,
    flights: int | None = None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Measure a rare event; write levels, curve, the worst flight, a page and `summary.json` into `out`.

    Stopped, it goes on from its last level when it is started again.
    """
    from keepout.rare_events.event import FLIGHTS, RUNS, rare
    from keepout.report.folder import make_folder, write_summary
    from keepout.report.rare_view import write_rare

    make_folder(out)
    runs, flights = RUNS if runs is None else runs, FLIGHTS if flights is None else flights
    event = rare(scenario, below=below, runs=runs, flights=flights, state=out, progress=part_of(progress, 0.0, 0.97))
    summary = write_rare(out, event)
    write_summary(out, summary)
    return summary


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
        target = load_target(_recorded_target(source, model, mesh)) if to == "glb" else None
        written = export_field(model, to, out, target=target, chaser_radius=chaser_radius, seed=seed, **chosen)  # pyright: ignore[reportArgumentType]
    else:
        xml = xml or out.suffix.lower() == ".xml"
        written = export_flight(source, to, out, craft=craft or "chaser", xml=xml, mesh=mesh, **chosen)  # pyright: ignore[reportArgumentType]
    progress(1.0, "")
    return {"source": str(source), "to": to, "file": str(out), **written}
