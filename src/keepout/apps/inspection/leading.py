"""Law and guard led from place to place around one mesh: what is built once, and what each place costs."""

import dataclasses
import math
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from keepout.apps.inspection.equipment import law_keeps, require_stand_off
from keepout.apps.inspection.plume import sparing
from keepout.core.control.barrier_grid import BarrierGrid
from keepout.core.control.geodesic import Geodesic, GeodesicGuidance
from keepout.core.control.law import Law
from keepout.core.errors import InspectionError
from keepout.core.fields.field import values
from keepout.core.fields.model import FieldModel
from keepout.core.flight.navigation import Navigation
from keepout.core.flight.setup import FlightSetup
from keepout.core.geometry.target import Target
from keepout.core.guard.guard import Guard, require_flyable
from keepout.core.mission.build import build_guard, closing_radius, load_model, require_navigation
from keepout.core.mission.law import broken_as, law_on
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings
from keepout.core.mission.target import require_apart
from keepout.core.motion.arrays import as_float64
from keepout.core.motion.relative import MotionState
from keepout.core.progress import Progress, part_of, silent
from keepout.flights.navigation.suites import navigation

Point = Float[np.ndarray, "3"]

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


@dataclass(frozen=True, eq=False)
class Leading:
    """A scenario's law around one mesh, for any goal: its keep-out zone keeps the stand-off.

    The grid of ways is made once; a goal costs the march over it. All laws have arrays of one shape, so one compiled
    program flies them all.

    Attributes:
        scenario: with the margin that the stand-off asks for, and a goal that reaches as far as any place.
        model: the field that the law flies by.
        grid: of ways, which all goals share.
        reach: how far places to go to are from the body frame's origin, m; the law is tuned for it.
        nominal_offset: of the law beyond its keep-out zone, m.
        guard: which is the same for all goals, or None.
        navigation: the sensors and both estimates, or None.
        initial: the true state at the start.
        start_certified: whether the guard's theorem holds from there; None without a guard.

    """

    scenario: Scenario
    model: FieldModel
    grid: BarrierGrid
    reach: float
    nominal_offset: float
    guard: Guard | None
    navigation: Navigation | None
    initial: MotionState
    start_certified: bool | None

    @classmethod
    def of(
        cls, scenario: Scenario, target: Target, *, model: FieldModel | None = None, progress: Progress = silent
    ) -> "Leading":
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
        Surroundings(scenario).require_bounded(away)
        reach = max(away.values())
        ahead = start / max(float(np.linalg.norm(start)), 1e-9)
        far = tuple((reach * ahead if ahead.any() else np.array([reach, 0.0, 0.0])).tolist())
        scenario = _moved(scenario, scenario.start.position, far)
        require_apart(scenario, target)
        require_navigation(scenario)
        bound = model.certificate(scenario.chaser.radius).error_bound
        require_stand_off(scenario, target, bound)
        least = bound + scenario.chaser.radius + scenario.safety.margin
        nominal = law_keeps(scenario, target, bound) - least
        assumed = Surroundings(scenario, target).guard_assumptions
        kept = scenario.inspect.stand_off + float(assumed.position_error) + _WANDERING
        margin, stated = max(scenario.safety.margin, kept - scenario.chaser.radius - bound - nominal), scenario
        scenario = scenario.model_copy(update={"safety": scenario.safety.model_copy(update={"margin": margin})})
        offset = bound + scenario.chaser.radius + margin + nominal
        beyond = scenario.camera.greatest_range + _BORDER
        lower, upper = target.vertices.min(axis=0) - beyond, target.vertices.max(axis=0) + beyond
        grid = BarrierGrid.build(
            model.field,
            offset,
            lower,
            upper,
            spacing=scenario.control.spacing,
            progress=part_of(progress, 0.4, 0.8),
        )
        motion = Surroundings(scenario).motion
        initial = motion.initial_state(start, np.asarray(scenario.start.velocity))
        sensed = None if scenario.navigation.suite == "none" else navigation(scenario, motion, assumed)
        guard, certified = None, None
        if scenario.guard.enabled:
            # By the operator's own margin: what the stand-off asks for beyond it is the law's to keep.
            guard = build_guard(
                Surroundings(stated, target),
                offset=model.offset,
                closing_radius=closing_radius(model),
                progress=part_of(progress, 0.8, 1.0),
            )
            certified = require_flyable(guard, initial, as_float64(far))
        return cls(scenario, model, grid, reach, nominal, guard, sensed, initial, certified)

    @property
    def offset(self) -> float:
        """The field's value, m, below which the law does not lead."""
        radius = self.scenario.chaser.radius
        bound = self.model.certificate(radius).error_bound
        return bound + radius + self.scenario.safety.margin + self.nominal_offset

    def reachable(self, place: Point) -> Point | None:
        """Give the place, or the nearest found beside it where the law leads; None where there is none.

        The field's distance may be less than the true one, and places at the stand-off itself have no room for a law
        to wander in. From such a place the search climbs the field.
        """
        here = np.asarray(place, dtype=float).copy()
        needed = self.offset + _WITHIN
        for _ in range(_STEPS):
            probes = here + _STEP * np.vstack([np.zeros(3), np.eye(3), -np.eye(3)])
            said = values(self.model.field, probes)
            if said[0] >= needed:
                return here
            slope = (said[1:4] - said[4:7]) / (2.0 * _STEP)
            size = float(np.linalg.norm(slope))
            if not size > 0.1:
                return None
            here = here + slope / size * max(min(needed - said[0] + 1e-3, 5.0 * _STEP), 0.2 * _STEP)
        return None

    def law(
        self,
        goal: Point,
        position: Point,
        *,
        speed: float | None = None,
        most: float = math.inf,
        through: bool = False,
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
        scenario = _moved(self.scenario, _floats(position), _floats(goal))
        bound = self.model.certificate(scenario.chaser.radius).error_bound
        options = {
            "guidance": Geodesic(grid=self.grid, beyond=_BEYOND),
            "reach": self.reach,
            "nominal_offset": self.nominal_offset,
        }
        upper = self.grid.origin + self.grid.spacing * (np.array(self.grid.values.shape) - 1)
        within = bool(np.all((position >= self.grid.origin) & (position <= upper)))
        free = float(values(self.model.field, np.asarray(position)[None])[0]) > self.offset
        # From beyond the grid the guidance leads back to it; from the law's own margin law and guard know the way out.
        law = law_on(scenario, self.model.field, bound, from_start=within and free, **options)
        limit = scenario.chaser.speed_limit
        slowed = min(float(np.clip(limit if speed is None else speed, _SLOWEST * limit, limit)), most)
        guidance = law.velocity.guidance
        assert isinstance(guidance, GeodesicGuidance)
        slowing = guidance.slowing_length * (_THROUGH if through else 1.0)
        guidance = dataclasses.replace(guidance, speed=jnp.asarray(slowed), slowing_length=slowing)
        law = dataclasses.replace(law, checked=(), velocity=dataclasses.replace(law.velocity, guidance=guidance))
        return broken_as(scenario, sparing(law, scenario), self.model.field)

    def setup(self, law: Law) -> FlightSetup:
        """Give the setup of the flight's first segment."""
        chosen = {"field": self.model.field, "guard": self.guard, "navigation": self.navigation, "goal": law.goal}
        return Surroundings(self.scenario).setup(law, **chosen)

    def led_on(self, setup: FlightSetup, law: Law) -> FlightSetup:
        """Give the setup of a segment that another law leads."""
        return dataclasses.replace(setup, controller=law, goal=as_float64(law.goal))


def _floats(point: Point) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in np.asarray(point))
    return x, y, z


def _moved(scenario: Scenario, start: tuple[float, ...], goal: tuple[float, ...]) -> Scenario:
    """Give the scenario with another start and goal."""
    return scenario.model_copy(
        update={
            "start": scenario.start.model_copy(update={"position": tuple(start)}),
            "goal": scenario.goal.model_copy(update={"position": tuple(goal)}),
        }
    )
