"""Write what each room offers the next into docs/architecture.md, from the code itself.

python docs/offers.py           # write it
python docs/offers.py --check   # exit 1 where the page is not of this version
"""

import importlib
import inspect
import re
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any

PAGE = Path(__file__).with_name("architecture.md")
BEGIN, END = "<!-- offers: written by docs/offers.py -->\n", "<!-- offers: end -->\n"
OFFERS = {
    "geometry": (
        "geometry.target.Target.load",
        "geometry.distance.ExactDistance",
        "geometry.distance.ExactDistance.distance",
        "geometry.distance.ExactDistance.closest",
        "geometry.offset_solid.OffsetSolid.build",
        "geometry.offset_solid.OffsetSolid.is_exterior",
        "geometry.offset_solid.OffsetSolid.signed_distance",
        "geometry.survey.survey",
        "geometry.octree.straddling_cells",
        "geometry.first_hit.FirstHit",
        "geometry.first_hit.FirstHit.ranges",
    ),
    "seeing": (
        "seeing.cut.cut",
        "seeing.sightlines.Sightlines",
        "seeing.sightlines.Sightlines.clear",
        "seeing.sightlines.Sightlines.lit",
        "seeing.visible.visible",
        "seeing.visible.in_view",
        "seeing.visible.lit_units",
        "seeing.room.Room",
        "seeing.room.Room.allowed",
        "seeing.room.Room.surely_not",
        "seeing.judge.seeable",
    ),
    "fields": (
        "fields.field.Field.value",
        "fields.field.Field.value_and_gradient",
        "fields.field.Field.value_gradient_hessian",
        "fields.own.stated_field",
        "fields.own.sampled_field",
        "fields.model.FieldModel.load",
        "fields.model.FieldModel.save",
        "fields.model.FieldModel.certificate",
        "fields.shipped.load_shipped",
        "fields.grid_build.build_grid",
        "fields.map_field.MapField.of",
    ),
    "mapping": (
        "mapping.known_free.KnownFreeMap.begin",
        "mapping.known_free.KnownFreeMap.see",
        "mapping.known_free.KnownFreeMap.distance_at_nodes",
        "mapping.known_free.KnownFreeMap.is_free",
        "mapping.view.View",
        "mapping.view.Pinhole",
        "mapping.view.SensorBounds",
        "mapping.map_file.save",
        "mapping.map_file.load",
        "mapping.skin.skin",
    ),
    "learning, proof, measures": (
        "learning.training.fit",
        "proof.certificate.certify",
        "proof.grid.certify_grid",
        "measures.field_measures.measure_model",
        "proof.map_slope.prove_slope",
    ),
    "motion": (
        "motion.chaser.Chaser",
        "motion.relative.RelativeMotion.initial_state",
        "motion.relative.RelativeMotion.drift_acceleration",
        "motion.relative.RelativeMotion.step",
        "motion.disturbance.Disturbance.force",
        "motion.actuator.ThrusterModel.apply",
        "motion.actuator.ThrusterModel.fire",
        "motion.thrusters.layout.preset",
        "motion.thrusters.on_off.OnOffThrusters.of",
        "motion.thrusters.capability.force_box",
    ),
    "depth sensor": (
        "sensing.depth.camera.DepthCamera",
        "sensing.depth.depth.take",
        "sensing.depth.errors.ErrorDraw",
        "sensing.depth.sure_return.sure_return_violations",
        "sensing.depth.pointing.axes_towards",
        "sensing.depth.pointing.Boresight.step",
    ),
    "control": (
        "control.law.Law.initial_state",
        "control.law.Law.step",
        "control.law.Law.with_applied_force",
        "control.law.Command.of_force",
        "control.operation.Operation",
        "control.profiles.default",
        "control.profiles.paper",
        "control.guidance.guidance.Guidance.desired_velocity",
        "control.guidance.plan.GuidancePlan.guidance",
    ),
    "guard": (
        "guard.safety_layer.SafetyLayer.initial_state",
        "guard.safety_layer.SafetyLayer.filter",
        "guard.guard.Guard",
        "guard.field.guard_field",
    ),
    "flight": (
        "flight.setup.FlightSetup",
        "flight.loop.fly",
        "flight.loop.step",
        "flight.segment.begin",
        "flight.segment.fly_segment",
        "flight.segment.joined",
        "flight.outcome.outcome",
        "flight.setup.Faults.estimate",
        "flight.setup.Faults.command",
        "flight.setup.Faults.actuate",
        "flight.on_board.OnBoard.step",
        "flight.on_board_navigation.OnBoardNavigation.step",
        "flight.record.FlightRecord.load",
        "flight.record.FlightRecord.save",
    ),
    "audit": ("audit.audit.audit", "audit.audit.audit_campaign", "audit.passage.audit_passage"),
    "mission": (
        "mission.scenario.Scenario.load",
        "mission.draft.draft",
        "mission.check.check",
        "mission.schema.schema",
        "mission.build.prepare",
        "mission.build.Mission.with_law",
        "mission.build.Mission.with_guard",
        "mission.own.with_disturbance",
        "mission.own.with_thrusters",
        "mission.own.with_field",
        "mission.law.build_law",
        "mission.build.build_guard",
        "mission.build.flight_setup",
        "mission.light.Light.sun",
        "mission.light.Light.suns",
        "mission.by_map.guard_by_map",
        "mission.by_map.law_by_map",
        "mission.by_map.setup_by_map",
        "mission.by_map.led_on",
        "mission.by_map.require_start",
        "mission.audited.fly_audited",
        "mission.audited.judge",
        "mission.flight.fly",
        "mission.flight.fly_mission",
        "mission.campaign.run_campaign",
    ),
    "campaign": (
        "campaign.plan.Plan.of",
        "campaign.chunk.fly_chunk",
        "campaign.dataset.Dataset.begin",
        "campaign.dataset.Dataset.open",
        "campaign.dataset.Dataset.table",
        "campaign.dataset.Dataset.bands",
        "campaign.run.fly_campaign",
        "campaign.scheduler.flyer_on",
        "campaign.replay.replay",
        "campaign.reading.read_campaign",
        "campaign.results.results",
        "campaign.comparison.compare",
        "campaign.summary.summary",
    ),
    "exchange": (
        "exchange.export.export_flight",
        "exchange.export.export_field",
        "exchange.orbit_message.read_oem",
        "exchange.orbit_message.write_oem",
        "exchange.attitude_message.read_aem",
        "exchange.attitude_message.write_aem",
        "exchange.encounter.encounter",
        "exchange.audited.audit_files",
    ),
    "exploring": (
        "exploring.explore.explore",
        "exploring.exploration.Exploration.summary",
        "exploring.departures.departures",
        "exploring.reachable.reachable",
        "exploring.next_view.choose",
    ),
    "inspecting": (
        "inspecting.inspect.inspect",
        "inspecting.inspection.Inspection.summary",
        "inspecting.leading.Leading.of",
        "inspecting.leading.Leading.law",
        "inspecting.frames.Camera.units",
        "inspecting.frames.as_flown",
        "inspecting.frames_file.coverage_of_files",
        "inspecting.problem.Problem.of",
        "inspecting.planning.plan",
        "inspecting.cover.fewest_views",
        "inspecting.ways.Ways.build",
        "inspecting.ways.Ways.path",
        "inspecting.tour.best_tour",
    ),
    "rare_events": (
        "rare_events.event.rare",
        "rare_events.event.RareEvent.summary",
        "rare_events.subset.simulate",
        "rare_events.estimate.estimate",
        "rare_events.tape.Tape.of",
        "rare_events.flights.TapedFlights.clearance",
        "rare_events.flights.TapedFlights.fly",
    ),
    "replay": (
        "replay.flights.of_flights",
        "replay.flights.of_files",
        "replay.clearance.proved_clearance",
        "replay.surfaces.drawn_surface",
        "replay.scene.scene",
        "replay.page.write_page",
    ),
}


def offer(path: str) -> str:
    """Give the signature of a function, method or class, and the first line of its docstring."""
    parts = path.split(".")
    cut = next(k for k, part in enumerate(parts) if k and (part[0].isupper() or k == len(parts) - 1))
    thing = importlib.import_module("keepout." + ".".join(parts[:cut]))
    for part in parts[cut:]:
        thing = getattr(thing, part)
    inside = inspect.unwrap(thing)
    said = re.sub(r"docs/([\w-]+)\.md", r"[\1](\1.md)", (inspect.getdoc(inside) or "").splitlines()[0])
    line = f"- `{'.'.join(parts[cut:])}({', '.join(arguments(inside))})` {said}"
    return textwrap.fill(line, 130, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)


def arguments(thing: Callable[..., Any]) -> list[str]:
    """Give the arguments as they are called: names and short defaults, `*` before those that need their names."""
    shown, named = [], False
    for parameter in inspect.signature(thing).parameters.values():
        if parameter.name == "self":
            continue
        if parameter.kind is parameter.KEYWORD_ONLY and not named:
            shown.append("*")
            named = True
        default = "" if parameter.default is parameter.empty else f"={parameter.default!r}"
        stars = "**" if parameter.kind is parameter.VAR_KEYWORD else ""
        shown.append(stars + parameter.name + (default if len(default) < 24 and "<" not in default else "=…"))
    return shown


def page(text: str) -> str:
    """Give the page with today's offers."""
    head, rest = text.split(BEGIN)
    tail = rest.split(END)[1]
    body = "".join(f"\n### {room}\n\n" + "\n".join(map(offer, offers)) + "\n" for room, offers in OFFERS.items())
    return f"{head}{BEGIN}{body}\n{END}{tail}"


def main() -> None:
    """Write the page, or check it."""
    old = PAGE.read_text(encoding="utf-8")
    new = page(old)
    if "--check" in sys.argv:
        sys.exit(0 if new == old else f"{PAGE}: not of this version; run python docs/offers.py")
    PAGE.write_text(new, encoding="utf-8")


if __name__ == "__main__":
    main()
