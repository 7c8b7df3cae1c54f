"""Explore: see, let the map grow, choose the next view, fly there by what is known free, until the end is reached."""

import math
import time
from collections.abc import Iterator
from dataclasses import replace

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from keepout.apps.led.camera import Boresight, axes_towards
from keepout.apps.led.driver import Leader, LedFlight, given_up_at, lead
from keepout.apps.led.first_hit import FirstHit
from keepout.apps.unknown import equipment
from keepout.apps.unknown.by_map import ByMap, DeclaredBall, field_of
from keepout.apps.unknown.cells import Tried
from keepout.apps.unknown.depth_sensor import DepthCamera, ErrorDraw, take
from keepout.apps.unknown.exploration import (
    Exploration,
    TakenView,
    WronglyFree,
    broken_promises,
    departures,
    open_surface,
    seen_share,
)
from keepout.apps.unknown.known_free import KnownFreeMap, ViewStatus
from keepout.apps.unknown.next_view import UP, Ended, NextView, Seeker, choose
from keepout.apps.unknown.skin import Stages
from keepout.apps.unknown.view import View
from keepout.core.compiled.kept_programs import keep_programs
from keepout.core.errors import ControlError
from keepout.core.flight.record import EXPLORED
from keepout.core.flight.setup import FlightSetup
from keepout.core.geometry.distance import Point
from keepout.core.geometry.target import Target
from keepout.core.guard.guard import GuardState
from keepout.core.guard.safety_layer import GuardFlag, GuardStatus
from keepout.core.mission.flight import recorded
from keepout.core.mission.scenario import Scenario, ScenarioLike
from keepout.core.mission.surroundings import Surroundings, broken_assumptions
from keepout.core.mission.target import load_target
from keepout.core.progress import Progress, silent

Pose = tuple[Point, Float[np.ndarray, "3 3"]]

_NEAR = 0.25
"""Metres from the place of a view at which it is taken."""
_ALIGNED = math.cos(math.radians(3.0))
"""Cosine of the angle to the direction wanted within which it is."""
_ATTEMPTS = 4
"""Views that the law may refuse to lead to before nothing more is tried; each keeps a little more room."""
_OF_LATTICE = 1.0
"""Cubes by which a place is kept further from unknown room than the law keeps: what is between the lattice's nodes."""
_STOPPING = 240.0
"""Seconds after which the way back begins although the guard does not say that the chaser rests."""
_RESTING = 10
"""Control steps within the tolerance after which the goal is reached."""


def explore(
    scenario: ScenarioLike,
    *,
    target: Target | None = None,
    expected: Target | None = None,
    progress: Progress = silent,
) -> Exploration:
    """Explore an unknown target: fly round it by what a depth sensor has seen free, towards a goal or all round.

    On board nothing is known of the target but the declared ball (`[map]`) and what the sensor saw. What has not been
    seen free is an obstacle, for law and guard alike. The clearance is audited on the true mesh.

    Args:
        scenario: a `Scenario`, the path of its TOML file, or its tables as a dict. Its
            entries `depth_sensor`, `map` and `explore` beside those of any flight; `target` is the truth.
        target: the true mesh, already loaded; else the scenario's.
        expected: what the mission believes, already loaded; else `explore.expected`, which may be unset.
        progress: called as the flight goes on.

    Raises:
        KeepoutError: something cannot be flown; the message names the entry, and nothing has been flown.

    """
    began = time.perf_counter()
    scenario = Scenario.of(scenario)
    keep_programs()
    camera = equipment.depth_camera(scenario)
    equipment.require_explorable(scenario, camera)
    ball = equipment.declared_ball(scenario)
    known = equipment.map_of(scenario, camera)
    leading = ByMap.of(scenario, ball, field_of(known))
    target = load_target(scenario.target) if target is None else target
    expected = equipment.expected_target(scenario) if expected is None else expected
    eye, inherited = _Eye(scenario, camera, ball, target), known.assumptions_broken
    seen = _Seen(known, camera, target)
    explorer = _Explorer(scenario, leading, eye, seen)
    ticks = round(scenario.depth_sensor.period / scenario.control.period)
    flight = LedFlight(scenario, leading.initial, ticks)
    flight.lead_on(explorer.resting())
    ended = lead(explorer, flight, progress)
    assert isinstance(ended, Ended)
    assert flight.setup is not None
    log = flight.log(with_end=True)
    bounds = Surroundings(scenario).flight_bounds
    broken = (*broken_assumptions(scenario, target), *inherited, *seen.broken(scenario, target, ball))
    standing = leading.start_certified, broken
    extra = {EXPLORED: True, "contradicting_returns": seen.contradicting}
    judged = recorded(scenario, target, flight.setup, log, bounds, standing, extra=extra)
    surface = open_surface(target, eye.first_hit)
    return Exploration(
        flight=judged,
        outcome=ended.outcome,
        why=ended.why,
        seconds=time.perf_counter() - began,
        expected=expected,
        map=known,
        views=tuple(seen.views),
        stages=seen.stages.at_the_end(known, float(judged.record.time[-1])),
        seen_share=seen_share(surface, known.returns, scenario.explore.explained),
        unknown=ended.unknown,
        departures=None if expected is None else departures(known, expected, camera.camera),
        keep=explorer.keep,
    )


class _Eye:
    """The depth sensor in flight: where it looks, and its images that are under way."""

    def __init__(self, scenario: Scenario, camera: DepthCamera, ball: DeclaredBall, target: Target) -> None:
        sensor = scenario.depth_sensor
        self.camera, self.period = camera, scenario.control.period
        self.first_hit = FirstHit(target.vertices, target.faces)
        self.generator = np.random.default_rng(scenario.seed)
        self.draw = ErrorDraw(sensor.errors, None if sensor.broken == "none" else sensor.broken)
        self.boresight = Boresight.at_rest(
            np.asarray(ball.centre) - np.asarray(scenario.start.position),
            greatest_rate=sensor.turn_rate,
            greatest_acceleration=sensor.turn_acceleration,
        )
        self._before: Pose | None = None
        self._under_way: list[tuple[float, View, Pose]] = []

    def turn(self, wanted: Point, steps: int) -> None:
        """Turn towards a direction for some control steps."""
        for _ in range(steps):
            self.boresight = self.boresight.step(wanted, self.period)

    def look(self, now: float, position: Point) -> None:
        """Take an image; it arrives a latency later."""
        axes = axes_towards(self.boresight.direction, UP)
        pose = self.camera.sensor_position(position, axes), axes
        # A pose told late is that of the image before.
        told = (self._before or pose) if self.draw.broken == "late" else None
        view = take(self.camera, self.first_hit, *pose, self.generator, self.draw, time=now, told=told)
        self._before = pose
        self._under_way.append((now + self.camera.latency, view, pose))

    def arrived(self, now: float) -> Iterator[tuple[View, Pose]]:
        """Hand over the images that have arrived, with the true pose of each."""
        while self._under_way and self._under_way[0][0] <= now + 1e-9:
            yield self._under_way.pop(0)[1:]


class _Seen:
    """What has been seen: the map, and what each image did to it."""

    def __init__(self, known: KnownFreeMap, camera: DepthCamera, target: Target) -> None:
        self.known, self.tried = known, Tried.of_map(known, camera.camera)
        self.wrongly_free = WronglyFree(known, target)
        self.views: list[TakenView] = []
        self.stages = Stages(known, 0.0)
        self.outside, self.free_volume = 0, 0.0

    def take_in(self, view: View, pose: Pose, why: str) -> bool:
        """Let the map grow by an image that was wanted for a reason; say whether the image contradicts the map."""
        report = self.known.see(view)
        if report.status is ViewStatus.SEEN:
            self.tried.note(self.known, view.camera, view)
            self.wrongly_free.note(self.known, view.time)
        self.outside += report.outside
        self.free_volume += report.opened * self.known.spacing**3
        said = report.status.value.replace("_", " ")
        told = said, report.opened, self.free_volume, why, report.contradicting
        self.views.append(TakenView(view.time, pose[0], pose[1][:, 2], *told))
        self.stages.note(self.known, view.time, self.free_volume)
        return report.contradicting > 0

    @property
    def contradicting(self) -> int:
        """Returns so far that prove that a promise was broken."""
        return sum(view.contradicting for view in self.views)

    def broken(self, scenario: Scenario, target: Target, ball: DeclaredBall) -> tuple[str, ...]:
        """Name the promises that were broken, and note them with the map."""
        found = broken_promises(scenario, target, ball) + self.wrongly_free.words(scenario)
        if self.outside:
            found += (f"{self.outside} returns lie outside the declared ball (map.centre, map.radius)",)
        self.known.broken = tuple(dict.fromkeys((*self.known.broken, *found)))
        if self.contradicting:
            found += (f"{self.contradicting} returns lie in room that was known free: ball or sensor broke a promise",)
        return found


class _Explorer(Leader):
    """Flies to the next view, to the goal, or back to where the map began once a view contradicts the map."""

    def __init__(self, scenario: Scenario, leading: ByMap, eye: _Eye, seen: _Seen) -> None:
        self.scenario, self.leading, self.eye, self.seen = scenario, leading, eye, seen
        self.goal = np.asarray(scenario.goal.position) if scenario.explore.towards == "goal" else None
        self.keep = leading.offset + _OF_LATTICE * seen.known.spacing
        self.began = self._within_map(np.asarray(leading.initial.position))
        self.wanted: NextView | None = None
        self.given_up = self.there_since = math.inf
        self.resting_steps = 0
        self.contradicted_at: float | None = None
        self.on_way_back = False

    def resting(self) -> FlightSetup:
        """Give what the chaser rests by: the law to where it is, or where the map begins."""
        return self.leading.setup(self.leading.law(self.began, np.asarray(self.leading.initial.position)))

    def look(self, flight: LedFlight) -> None:
        """Turn over the rows flown last, take an image, and take in those that have arrived."""
        if flight.logs:
            near = np.linalg.norm(np.asarray(flight.logs[-1].position) - self.scenario.goal.position, axis=1)
            if self.wanted is not None:
                self.eye.turn(self.wanted.direction, len(near))
            away = np.flatnonzero(near >= self.scenario.goal.tolerance)
            self.resting_steps = len(near) - 1 - int(away[-1]) if len(away) else self.resting_steps + len(near)
        if self.contradicted_at is not None:
            return
        self.eye.look(flight.now, flight.position)
        why = "" if self.wanted is None else self.wanted.why
        if any([self.seen.take_in(view, pose, why) for view, pose in self.eye.arrived(flight.now)]):
            self.contradicted_at, self.wanted = flight.now, None
            _tell(flight, contradicted=True)

    def ended(self, flight: LedFlight) -> Ended | None:
        """Say how the flight is over: at the goal, or out of time or views."""
        scenario, over = self.scenario, flight.rows >= self.scenario.steps
        if self.wanted is not None and self.wanted.is_goal and self.resting_steps >= _RESTING:
            return Ended("reached goal", f"the goal is held within {scenario.goal.tolerance:g} m")
        if over and self.contradicted_at is not None:
            return self._contradicted(f"duration {scenario.duration:g} s was over before the chaser was back")
        if over:
            return Ended("out of time", f"duration {scenario.duration:g} s is over")
        if len(self.seen.views) >= scenario.explore.most_views and self.contradicted_at is None:
            return Ended("out of views", f"explore.most_views {scenario.explore.most_views} were taken")
        return None

    def onward(self, flight: LedFlight) -> FlightSetup | Ended | None:
        """Go on to the next view once that under way was taken and taken in, or is given up."""
        if self.contradicted_at is not None:
            return self._back(flight, self.contradicted_at)
        if not self._is_over(flight.now, flight.position):
            return None
        choice = self._choose(flight)
        if not isinstance(choice, Ended):
            assert self.wanted is not None
            way = float(np.linalg.norm(self.wanted.position - flight.position))
            self.given_up = given_up_at(flight.now, way / self.scenario.chaser.speed_limit)
        return choice

    def next_rows(self, flight: LedFlight) -> int:
        """Say how many rows there are to the next image, not beyond the duration, which bounds orbit and rotation."""
        return min(flight.longest, self.scenario.steps - flight.rows)

    def told(self, flight: LedFlight) -> tuple[float, str]:
        """Give the share of time or views that is used up."""
        views = len(self.seen.views)
        share = max(flight.rows / self.scenario.steps, views / self.scenario.explore.most_views)
        return min(share, 0.98), f"{views} views, {self.seen.free_volume:.0f} m³ known free"

    def _is_over(self, now: float, position: Point) -> bool:
        if self.wanted is None or now > self.given_up:
            return True
        if self.wanted.is_goal:
            return False
        there = float(np.linalg.norm(position - self.wanted.position)) < _NEAR
        if there and float(self.eye.boresight.direction @ self.wanted.direction) > _ALIGNED:
            self.there_since = min(self.there_since, now)
            if now >= self.there_since + self.eye.camera.latency:
                self.there_since = math.inf
                return True
        return False

    def _choose(self, flight: LedFlight) -> FlightSetup | Ended:
        """Choose the next view, and the law that leads there."""
        assert flight.setup is not None
        self.leading = self.leading.by(field_of(self.seen.known))
        scenario, boresight, spacing = self.scenario, self.eye.boresight, self.seen.known.spacing
        seeker = Seeker(
            flight.position,
            self.eye.camera.camera,
            self.keep,
            boresight.direction,
            scenario.chaser.speed_limit,
            boresight.greatest_rate,
        )
        refusal = None
        for attempt in range(_ATTEMPTS):
            farther = replace(seeker, keep=self.keep + attempt * 0.5 * spacing)
            seed = scenario.seed + len(self.seen.views) + 1000 * attempt
            choice = choose(self.seen.known, farther, self.goal, self.seen.tried, seed=seed)
            if isinstance(choice, Ended):
                return choice
            try:
                law = self.leading.law(choice.position, flight.position)
            except ControlError as error:
                refusal = error
                continue
            self.wanted = choice
            return self.leading.led_on(flight.setup, law)
        return Ended("no way known", f"the law finds no way to {_ATTEMPTS} views: {refusal}")

    def _back(self, flight: LedFlight, since: float) -> FlightSetup | Ended | None:
        """Lead to where the map began once the chaser rests: by the map as it was before the view that contradicts."""
        now, position = flight.now, flight.position
        way = float(np.linalg.norm(position - self.began))
        if self.on_way_back:
            if way < _NEAR:
                return self._contradicted("the chaser came to rest, and went back to where it began")
            if now > self.given_up:
                return self._contradicted("the chaser came to rest; it did not get back in time")
            return None
        said = int(flight.logs[-1].guard_status[-1]) if flight.logs else 0
        held = bool(said & GuardFlag.CONTRADICTED) and said & max(GuardStatus) == GuardStatus.HOLDING
        if self.leading.guard is not None and not held and now < since + _STOPPING:
            return None
        assert flight.setup is not None
        self.leading = self.leading.by(field_of(self.seen.known))
        try:
            law = self.leading.law(self.began, position)
        except ControlError as refusal:
            return self._contradicted(f"the chaser came to rest, and no way back is known: {refusal}")
        self.on_way_back, self.given_up = True, given_up_at(now, way / self.scenario.chaser.speed_limit)
        _tell(flight, contradicted=False)
        return self.leading.led_on(flight.setup, law)

    def _contradicted(self, then: str) -> Ended:
        view = next(view for view in self.seen.views if view.contradicting)
        return Ended(
            "contradicted",
            f"{view.contradicting} returns of the image at {view.time:g} s lie in room that was known free, so a "
            f"promise of ball or sensor is broken; {then}",
        )

    def _within_map(self, position: Point) -> Point:
        """Give the position itself, or the way's first point in the map's box towards the middle of the ball."""
        known = self.seen.known
        half = 0.5 * (known.upper - known.origin)
        middle = known.origin + half
        beyond = float(np.max(np.abs(position - middle) / half))
        return position if beyond <= 1.0 else middle + (position - middle) / beyond


def _tell(flight: LedFlight, *, contradicted: bool) -> None:
    """Tell the guard, where there is one, whether what it is told is contradicted."""
    if flight.state is not None and isinstance(flight.state.guard, GuardState):
        said = jax.device_put(np.asarray(contradicted))
        flight.state = eqx.tree_at(lambda state: state.guard.contradicted, flight.state, said)
