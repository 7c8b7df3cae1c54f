"""Explore: see, let the map grow, choose the next view, fly there by what is known free, until the end is reached."""

import math
import time
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from keepout.apps.led.camera import Boresight, axes_towards
from keepout.apps.unknown import by_map, equipment
from keepout.apps.unknown.cells import Tried
from keepout.apps.unknown.departures import departures
from keepout.apps.unknown.depth_sensor import ErrorDraw, take
from keepout.apps.unknown.exploration import Exploration, TakenView
from keepout.apps.unknown.known_free import ViewStatus
from keepout.apps.unknown.map_field import MapField
from keepout.apps.unknown.next_view import UP, Ended, NextView, Seeker, choose
from keepout.apps.unknown.open_surface import open_surface, seen_share
from keepout.apps.unknown.skin import Stages
from keepout.apps.unknown.view import View
from keepout.core.compiled.kept_programs import keep_programs
from keepout.core.control.law import Law
from keepout.core.errors import ControlError
from keepout.core.flight.loop import FlightLog, LoopState, begin, fly_segment, joined
from keepout.core.flight.record import EXPLORED
from keepout.core.flight.setup import FlightSetup
from keepout.core.geometry.first_hit import FirstHit
from keepout.core.geometry.target import Target
from keepout.core.guard.guard import GuardState, starts_certified
from keepout.core.guard.safety_layer import GuardFlag, GuardStatus
from keepout.core.mission.flight import recorded
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings, broken_assumptions, guard_numbers
from keepout.core.mission.target import load_target
from keepout.core.progress import Progress, silent

Point = Float[np.ndarray, "3"]
Pose = tuple[Point, Float[np.ndarray, "3 3"]]

_NEAR = 0.25
"""Metres from the place of a view at which it is taken."""
_ALIGNED = math.cos(math.radians(3.0))
"""Cosine of the angle to the direction wanted within which it is."""
_PATIENCE = 3.0
"""A view not reached after so many times the way at the speed limit, and `_EXTRA` s, is given up."""
_EXTRA = 240.0
_ATTEMPTS = 4
"""Views that the law may refuse to lead to before nothing more is tried; each keeps a little more room."""
_OF_LATTICE = 1.0
"""Cubes by which a place is kept further from unknown room than the law keeps: what is between the lattice's nodes."""
_STOPPING = 240.0
"""Seconds after which the way back begins although the guard does not say that the chaser rests."""
_RESTING = 10
"""Control steps within the tolerance after which the goal is reached."""


def explore(
    scenario: Scenario | str | Path,
    *,
    target: Target | None = None,
    expected: Target | None = None,
    progress: Progress = silent,
) -> Exploration:
    """Explore an unknown target: fly round it by what a depth sensor has seen free, towards a goal or all round.

    On board nothing is known of the target but the declared ball (`[map]`) and what the sensor saw. What has not been
    seen free is an obstacle, for law and guard alike. The clearance is audited on the true mesh.

    Args:
        scenario: or the path of its TOML file. Its entries `depth_sensor`, `map` and `explore` beside those of any
            flight; `target` is the truth.
        target: the true mesh, already loaded; else the scenario's.
        expected: what the mission believes, already loaded; else `explore.expected`, which may be unset.
        progress: called as the flight goes on.

    Raises:
        KeepoutError: something cannot be flown; the message names the entry, and nothing has been flown.

    """
    scenario = Scenario.of(scenario)
    return _Explorer(scenario, target, expected).flown(progress)


class _Explorer:
    """One exploration under way."""

    def __init__(self, scenario: Scenario, target: Target | None, expected: Target | None) -> None:
        self.began = time.perf_counter()
        keep_programs()
        self.scenario, entry = scenario, scenario.explore
        self.camera = equipment.depth_camera(scenario)
        equipment.require_explorable(scenario, self.camera)
        self.ball = equipment.declared_ball(scenario)
        self.known = equipment.map_of(scenario, self.camera)
        self.goal = np.asarray(scenario.goal.position) if entry.towards == "goal" else None
        self.field = self._field()
        self.guard = by_map.guard_by_map(scenario, self.field, self.ball) if scenario.guard.enabled else None
        motion = Surroundings(scenario).motion
        self.initial = motion.initial_state(np.asarray(scenario.start.position), np.asarray(scenario.start.velocity))
        by_map.require_start(scenario, self.ball, self.initial, self.guard)
        self.target = load_target(scenario.target) if target is None else target
        self.expected = equipment.expected_target(scenario) if expected is None else expected
        self.wrongly_free = equipment.WronglyFree(self.known, self.target)
        self.inherited = self.known.assumptions_broken
        self.first_hit = FirstHit(self.target.vertices, self.target.faces)
        self.surface = open_surface(self.target, self.first_hit)
        self.generator = np.random.default_rng(scenario.seed)
        broken = scenario.depth_sensor.broken
        self.draw = ErrorDraw(scenario.depth_sensor.errors, None if broken == "none" else broken)
        self.tried = Tried.of_map(self.known, self.camera.camera)
        self.boresight = Boresight.at_rest(
            np.asarray(self.ball.centre) - np.asarray(scenario.start.position),
            greatest_rate=scenario.depth_sensor.turn_rate,
            greatest_acceleration=scenario.depth_sensor.turn_acceleration,
        )
        self.views: list[TakenView] = []
        self.stages = Stages(self.known, 0.0)
        self.logs: list[FlightLog] = []
        self.under_way: list[tuple[float, View, Pose]] = []
        self.pose: Pose | None = None
        self.wanted: NextView | None = None
        self.given_up = self.there_since = math.inf
        self.resting = self.outside = 0
        self.contradicted_at: float | None = None
        self.on_way_back = False
        self.free_volume = 0.0

    def flown(self, progress: Progress) -> Exploration:
        """Fly until the end, and judge."""
        scenario = self.scenario
        ticks = round(scenario.depth_sensor.period / scenario.control.period)
        start = np.asarray(self.initial.position)
        setup = by_map.setup_by_map(
            scenario, self.field, self.ball, self._law(self._within_map(start), start), self.guard
        )
        self.keep = by_map.kept_by_law(scenario, self.field, self.guard) + _OF_LATTICE * self.known.spacing
        state = begin(setup, self.initial, jax.random.key(scenario.seed))
        flown = 0
        while True:
            now, position = float(state.motion.time), np.asarray(state.motion.position)
            if self.contradicted_at is None:
                self._look(now, position)
                self._take_in(now)
                if self.contradicted_at is not None:
                    self.wanted, state = None, _told(state, contradicted=True)
            ending = self._ending(flown)
            if ending is None and self.contradicted_at is not None:
                setup, state, ending = self._go_back(setup, state, now, position)
            elif ending is None and self._is_over(now, position):
                field = self._field()
                choice = self._choose(field, position)
                if isinstance(choice, Ended):
                    ending = choice
                else:
                    self.wanted, law = choice
                    way = float(np.linalg.norm(self.wanted.position - position))
                    self.given_up = now + _PATIENCE * way / scenario.chaser.speed_limit + _EXTRA
                    setup = by_map.led_on(setup, field, law)
            if ending is not None and self.logs:
                break
            # Not beyond the duration, over which orbit and rotation are bounded.
            count = min(ticks, scenario.steps - flown)
            state, log = fly_segment(setup, state, count, longest=ticks)
            self.logs.append(log)
            flown += count
            self._turn(count)
            self._count_rest(log)
            share = max(flown / scenario.steps, len(self.views) / scenario.explore.most_views)
            progress(min(share, 0.98), f"{len(self.views)} views, {self.free_volume:.0f} m³ known free")
        _, last = fly_segment(setup, state, 1, longest=ticks)
        return self._judged(joined([*self.logs, last]), setup, ending)

    def _field(self) -> MapField:
        return MapField.of(self.known.squares, self.known.origin, self.known.spacing)

    def _law(self, goal: Point, position: Point, field: MapField | None = None) -> Law:
        field = self.field if field is None else field
        return by_map.law_by_map(self.scenario, field, goal, position, ball=self.ball, guard=self.guard)

    def _look(self, now: float, position: Point) -> None:
        """Take an image; it arrives a latency later."""
        axes = axes_towards(self.boresight.direction, UP)
        pose = self.camera.sensor_position(position, axes), axes
        # A pose told late is that of the image before.
        told = (self.pose or pose) if self.draw.broken == "late" else None
        view = take(self.camera, self.first_hit, *pose, self.generator, self.draw, time=now, told=told)
        self.pose = pose
        self.under_way.append((now + self.camera.latency, view, pose))

    def _take_in(self, now: float) -> None:
        """Let the map grow by the images that have arrived."""
        while self.under_way and self.under_way[0][0] <= now + 1e-9:
            _, view, (place, axes) = self.under_way.pop(0)
            report = self.known.see(view)
            if report.status is ViewStatus.SEEN:
                self.tried.note(self.known, view)
                self.wrongly_free.note(self.known, view.time)
            if report.contradicting and self.contradicted_at is None:
                self.contradicted_at = now
            self.outside += report.outside
            self.free_volume += report.opened * self.known.spacing**3
            why = "" if self.wanted is None else self.wanted.why
            said = report.status.value.replace("_", " ")
            told = said, report.opened, self.free_volume, why, report.contradicting
            self.views.append(TakenView(view.time, place, axes[:, 2], *told))
            self.stages.note(self.known, view.time, self.free_volume)

    def _ending(self, flown: int) -> Ended | None:
        if self.wanted is not None and self.wanted.is_goal and self.resting >= _RESTING:
            return Ended("reached goal", f"the goal is held within {self.scenario.goal.tolerance:g} m")
        if flown >= self.scenario.steps and self.contradicted_at is not None:
            return self._contradicted(f"duration {self.scenario.duration:g} s was over before the chaser was back")
        if flown >= self.scenario.steps:
            return Ended("out of time", f"duration {self.scenario.duration:g} s is over")
        if len(self.views) >= self.scenario.explore.most_views and self.contradicted_at is None:
            return Ended("out of views", f"explore.most_views {self.scenario.explore.most_views} were taken")
        return None

    def _go_back(
        self, setup: FlightSetup, state: LoopState, now: float, position: Point
    ) -> tuple[FlightSetup, LoopState, Ended | None]:
        """Lead to where the map began once the chaser rests: by the map as it was before the view that contradicts."""
        began = self._within_map(np.asarray(self.initial.position))
        if self.on_way_back:
            back = float(np.linalg.norm(position - began)) < _NEAR
            if back:
                return setup, state, self._contradicted("the chaser came to rest, and went back to where it began")
            if now > self.given_up:
                return setup, state, self._contradicted("the chaser came to rest; it did not get back in time")
            return setup, state, None
        assert self.contradicted_at is not None
        said = int(self.logs[-1].guard_status[-1]) if self.logs else 0
        held = bool(said & GuardFlag.CONTRADICTED) and said & max(GuardStatus) == GuardStatus.HOLDING
        resting = self.guard is None or held
        if not resting and now < self.contradicted_at + _STOPPING:
            return setup, state, None
        field = self._field()
        try:
            law = self._law(began, position, field)
        except ControlError as refusal:
            return setup, state, self._contradicted(f"the chaser came to rest, and no way back is known: {refusal}")
        way = float(np.linalg.norm(began - position))
        self.on_way_back, self.given_up = True, now + _PATIENCE * way / self.scenario.chaser.speed_limit + _EXTRA
        return by_map.led_on(setup, field, law), _told(state, contradicted=False), None

    def _contradicted(self, then: str) -> Ended:
        view = next(view for view in self.views if view.contradicting)
        return Ended(
            "contradicted",
            f"{view.contradicting} returns of the image at {view.time:g} s lie in room that was known free, so a "
            f"promise of ball or sensor is broken; {then}",
        )

    def _is_over(self, now: float, position: Point) -> bool:
        """Whether the view under way has been taken and taken in, or is given up."""
        if self.wanted is None or now > self.given_up:
            return True
        if self.wanted.is_goal:
            return False
        there = float(np.linalg.norm(position - self.wanted.position)) < _NEAR
        if there and float(self.boresight.direction @ self.wanted.direction) > _ALIGNED:
            self.there_since = min(self.there_since, now)
            if now >= self.there_since + self.camera.latency:
                self.there_since = math.inf
                return True
        return False

    def _choose(self, field: MapField, position: Point) -> tuple[NextView, Law] | Ended:
        """Choose the next view, and the law that leads there."""
        refusals = []
        for attempt in range(_ATTEMPTS):
            keep = self.keep + attempt * 0.5 * self.known.spacing
            camera, speed, rate = self.camera.camera, self.scenario.chaser.speed_limit, self.boresight.greatest_rate
            seeker = Seeker(position, camera, keep, self.boresight.direction, speed, rate)
            seed = self.scenario.seed + len(self.views) + 1000 * attempt
            choice = choose(self.known, seeker, self.goal, self.tried, seed=seed)
            if isinstance(choice, Ended):
                return choice
            try:
                return choice, self._law(choice.position, position, field)
            except ControlError as refusal:
                refusals.append(str(refusal))
        return Ended("no way known", f"the law finds no way to {_ATTEMPTS} views: {refusals[-1]}")

    def _within_map(self, position: Point) -> Point:
        """Give the position itself, or the way's first point in the map's box towards the middle of the ball."""
        half = 0.5 * (self.known.upper - self.known.lower)
        middle = self.known.lower + half
        beyond = float(np.max(np.abs(position - middle) / half))
        return position if beyond <= 1.0 else middle + (position - middle) / beyond

    def _turn(self, steps: int) -> None:
        if self.wanted is not None:
            for _ in range(steps):
                self.boresight = self.boresight.step(self.wanted.direction, self.scenario.control.period)

    def _count_rest(self, log: FlightLog) -> None:
        """Count the control steps in a row, up to now, within the tolerance of the goal."""
        near = np.linalg.norm(np.asarray(log.position) - self.scenario.goal.position, axis=1)
        away = np.flatnonzero(near >= self.scenario.goal.tolerance)
        self.resting = self.resting + len(near) if len(away) == 0 else len(near) - 1 - int(away[-1])

    def _judged(self, log: FlightLog, setup: FlightSetup, ending: Ended) -> Exploration:
        """Put together what was flown, and audit it on the true mesh."""
        scenario = self.scenario
        bounds = Surroundings(scenario).flight_bounds
        contradicting = sum(view.contradicting for view in self.views)
        extra = {EXPLORED: True, "contradicting_returns": contradicting}
        flown, record, verdict = recorded(scenario, self.target, setup, log, bounds, extra=extra)
        promises = equipment.broken_promises(scenario, self.target, self.ball) + self.wrongly_free.words(scenario)
        if self.outside:
            promises += (f"{self.outside} returns lie outside the declared ball (map.centre, map.radius)",)
        self.known.broken = tuple(dict.fromkeys((*self.known.broken, *promises)))
        if contradicting:
            promises += (f"{contradicting} returns lie in room that was known free: ball or sensor broke a promise",)
        broken = (*broken_assumptions(scenario, self.target), *self.inherited, *promises)
        start = jax.tree.map(lambda leaf: leaf[None], self.initial)
        certified = self.guard is not None and bool(starts_certified(self.guard, start)[0])
        return Exploration(
            scenario=scenario,
            target=self.target,
            expected=self.expected,
            map=self.known,
            record=record,
            flown=flown,
            audit=verdict,
            outcome=ending.outcome,
            why=ending.why,
            views=tuple(self.views),
            stages=self.stages.at_the_end(self.known, float(record.time[-1])),
            seen_share=seen_share(self.surface, self.known.returns, scenario.explore.explained),
            unknown=ending.unknown,
            departures=None if self.expected is None else departures(self.known, self.expected, self.camera.camera),
            seconds=time.perf_counter() - self.began,
            start_certified=certified and not broken,
            assumptions_broken=broken,
            guard={} if self.guard is None else guard_numbers(self.guard, scenario),
            keep=self.keep,
        )


def _told(state: LoopState, *, contradicted: bool) -> LoopState:
    """Tell the guard, where there is one, whether what it is told is contradicted."""
    if not isinstance(state.guard, GuardState):
        return state
    return eqx.tree_at(lambda state: state.guard.contradicted, state, jax.device_put(np.asarray(contradicted)))
