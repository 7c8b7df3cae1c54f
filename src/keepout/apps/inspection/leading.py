"""Law and guard led from place to place around one mesh, whose stand-off the law keeps."""

import dataclasses
import math
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from keepout.apps.inspection.limits import sparing
from keepout.apps.inspection.problem import require_stand_off
from keepout.apps.led.driver import Leading, moved
from keepout.core.control.barrier_grid import BarrierGrid
from keepout.core.control.geodesic import GeodesicGuidance
from keepout.core.control.law import Law
from keepout.core.errors import InspectionError
from keepout.core.fields.field import values
from keepout.core.fields.model import FieldModel
from keepout.core.geometry.distance import Point
from keepout.core.geometry.target import Target
from keepout.core.guard.start import require_flyable
from keepout.core.mission.build import build_guard, closing_radius, load_model, require_navigation
from keepout.core.mission.law import broken_as
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings
from keepout.core.mission.target import require_apart
from keepout.core.mission.zones import zoned
from keepout.core.motion.arrays import as_float64
from keepout.core.progress import Progress, part_of, silent
from keepout.flights.navigation.suites import navigation

_WANDERING = 0.1
"""Room beyond the stand-off that the law keeps for its own wandering, m: a coarse grid's slope bends at its nodes."""
_WITHIN = 0.05
"""Barrier at which a place is led to at least, m: nearer the law comes to its keep-out zone too slowly."""
_BORDER = 2.0
"""Metres by which the grid of ways reaches beyond all places from which something is in range."""
_STEPS, _STEP = 60, 0.05
"""Of the search for room beside a place that the law does not lead to."""
_BEYOND = 20.0
"""Seconds of travel at 1 m/s, beyond twice those of a leg, from where on no way to its goal is made."""
_THROUGH = 0.2
"""Share of the law's slowing length within which a chaser that means to fly on slows down."""
_SLOWEST = 0.2
"""Share of the speed limit below which no leg is flown so that the boresight may turn meanwhile."""


def _box(scenario: Scenario, target: Target) -> tuple[Point, Point]:
    """Give corners (m) of the grid of ways: from beyond it the guidance leads straight back."""
    beyond, start = scenario.camera.greatest_range + _BORDER, np.asarray(scenario.start.position)
    lower, upper = target.vertices.min(axis=0) - beyond, target.vertices.max(axis=0) + beyond
    if not scenario.zone:
        return lower, upper
    return np.minimum(lower, start - _BORDER), np.maximum(upper, start + _BORDER)


@dataclass(frozen=True, eq=False)
class AroundMesh(Leading):
    """A scenario's law around one mesh: its keep-out zone keeps the stand-off.

    The scenario has the margin that the stand-off asks for, a goal that reaches as far as any place, and its zones in
    the field. `field_sha256` is the digest of the field's model.
    """

    field_sha256: str = ""

    @classmethod
    def of(
        cls, scenario: Scenario, target: Target, *, model: FieldModel | None = None, progress: Progress = silent
    ) -> "AroundMesh":
        """Build field, grid and guard; refuse a start that cannot be flown from.

        Args:
            scenario: its entries `inspect.stand_off` and `camera.greatest_range` beside those of any flight.
            target: its mesh.
            model: its field, already loaded; else the scenario's.
            progress: called as they are built.

        Raises:
            KeepoutError: the message names the entry.

        """
        if scenario.control.profile != "default":
            raise InspectionError(f'control.profile: "{scenario.control.profile}"; an inspection flies "default" only')
        model = load_model(scenario, target, part_of(progress, 0.0, 0.4)) if model is None else model
        model.require_target(target, where="field")
        start = np.asarray(scenario.start.position)
        extent = float(np.linalg.norm(target.vertices, axis=1).max())
        away = {
            "start.position": float(np.linalg.norm(start)),
            "camera.greatest_range, beyond the target": extent + scenario.camera.greatest_range,
        }
        for number, hold in enumerate(scenario.inspect.hold_points):
            away[f"inspect.hold_points.{number}.position"] = float(np.linalg.norm(hold.position))
        Surroundings(scenario).region(away)
        reach = max(away.values())
        ahead = start / max(float(np.linalg.norm(start)), 1e-9)
        far = reach * ahead if ahead.any() else np.array([reach, 0.0, 0.0])
        scenario = moved(scenario, start, far)
        require_apart(scenario, target)
        require_navigation(scenario)
        radius = scenario.chaser.radius
        bound = model.certificate(radius).error_bound
        nominal = require_stand_off(scenario, target, bound) - (bound + radius + scenario.safety.margin)
        assumed = Surroundings(scenario, target).guard_assumptions
        kept = scenario.inspect.stand_off + float(assumed.position_error) + _WANDERING
        margin, stated = max(scenario.safety.margin, kept - radius - bound - nominal), scenario
        scenario = scenario.model_copy(update={"safety": scenario.safety.model_copy(update={"margin": margin})})
        offset = bound + radius + margin + nominal
        field, told = zoned(Surroundings(scenario), model.field, bound + radius), part_of(progress, 0.4, 0.8)
        box, spacing = _box(scenario, target), scenario.control.spacing
        grid = BarrierGrid.build(field, offset, *box, spacing=spacing, progress=told)
        motion = Surroundings(scenario).motion
        initial = motion.initial_state(start, np.asarray(scenario.start.velocity))
        sensed = navigation(scenario, motion, assumed)
        guard, certified = None, None
        if scenario.guard.enabled:
            # By the operator's own margin: what the stand-off asks for beyond it is the law's to keep.
            around, sealed, told = Surroundings(stated, target), closing_radius(model), part_of(progress, 0.8, 1.0)
            guard = build_guard(around, offset=model.offset, closing_radius=sealed, progress=told)
            # Where zones may be, the start alone is known to be outside of them.
            certified = require_flyable(guard, initial, as_float64(start if stated.zone else far))
        built = bound, grid, reach, nominal, guard, sensed, initial, certified
        # The field has the zones: no law is to put them into it again.
        return cls(scenario.model_copy(update={"zone": ()}), field, *built, model.sha256)

    def reachable(self, place: Point) -> Point | None:
        """Give the place, or the nearest found beside it where the law leads; None where there is none.

        The field's distance may be less than the true one, and places at the stand-off itself have no room for a law
        to wander in. From such a place the search climbs the field.
        """
        here = np.asarray(place, dtype=float).copy()
        needed = self.offset + _WITHIN
        for _ in range(_STEPS):
            probes = here + _STEP * np.vstack([np.zeros(3), np.eye(3), -np.eye(3)])
            said = values(self.field, probes)
            if said[0] >= needed:
                return here
            slope = (said[1:4] - said[4:7]) / (2.0 * _STEP)
            size = float(np.linalg.norm(slope))
            if not size > 0.1:
                return None
            here = here + slope / size * max(min(needed - said[0] + 1e-3, 5.0 * _STEP), 0.2 * _STEP)
        return None

    def law(
        self, goal: Point, position: Point, *, speed: float | None = None, most: float = math.inf, through: bool = False
    ) -> Law:
        """Make the law that leads to a goal.

        Args:
            goal: (3,) m, where the law leads (`reachable`).
            position: (3,) m, where the chaser is.
            speed: on the way, m/s; by default the chaser's limit. It is no less than a fifth of that.
            most: m/s, above which it is not flown, however slow that is.
            through: whether the chaser is hoped to fly on before it is there: then it slows down late, and passes the
                goal before it comes to rest there.

        Raises:
            ControlError: no way leads there.

        """
        # From beyond the grid the guidance leads back to it; from the law's own margin law and guard know the way out.
        free = float(values(self.field, np.asarray(position)[None])[0]) > self.offset
        law = self.made(goal, position, from_start=self.within_grid(position) and free, beyond=_BEYOND)
        scenario = self.scenario
        limit = scenario.chaser.speed_limit
        slowed = min(float(np.clip(limit if speed is None else speed, _SLOWEST * limit, limit)), most)
        guidance = law.velocity.guidance
        assert isinstance(guidance, GeodesicGuidance)
        slowing = guidance.slowing_length * (_THROUGH if through else 1.0)
        guidance = dataclasses.replace(guidance, speed=jnp.asarray(slowed), slowing_length=slowing)
        law = dataclasses.replace(law, velocity=dataclasses.replace(law.velocity, guidance=guidance))
        return broken_as(scenario, sparing(law, scenario), self.field)
