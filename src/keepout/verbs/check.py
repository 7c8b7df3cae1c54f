"""What flying a scenario would mean, found out without flying it: in words, in numbers, and what would be refused.

What the flight will take is estimated from the way that its law leads: no flight, and no bound.
"""

import math
import operator
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from itertools import accumulate, repeat, takewhile
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from keepout.core.control.controller import Controller
from keepout.core.control.law import AheadOfDelay, Condition
from keepout.core.control.legs import LegLaw
from keepout.core.control.profiles import ControlWarning, drift_bound, tune
from keepout.core.errors import KeepoutError, KeepOutZoneError, ScenarioError
from keepout.core.fields.field import values
from keepout.core.fields.model import FieldModel
from keepout.core.flight.faults import BrokenLaw
from keepout.core.flight.setup import FlightSetup
from keepout.core.geometry.target import Target
from keepout.core.guard.braking import design
from keepout.core.mission.build import Mission, load_model, prepare
from keepout.core.mission.first_look import require_files
from keepout.core.mission.law import operation
from keepout.core.mission.scenario import Scenario, ScenarioLike, with_entries
from keepout.core.mission.surroundings import Surroundings, broken_assumptions, guard_numbers
from keepout.core.mission.target import has_way_out, load_target, require_apart, room_to_start
from keepout.core.motion.arrays import as_float64
from keepout.core.motion.disturbance import NoDisturbance
from keepout.core.motion.relative import MotionState
from keepout.core.progress import Progress, part_of, silent
from keepout.flights.campaign.dispersion import Design, refused_values
from keepout.flights.campaign.dispersion import design as campaign_design
from keepout.flights.pages.mission_words import in_words
from keepout.flights.pages.page import bracketed

_LONGEST = 4
"""Times a scenario's own duration after which a way is given up."""
_LEAST_STEPS = 5000


@dataclass(frozen=True)
class Expected:
    """Estimates, each of what the working law does without faults.

    Attributes:
        way: along which the law leads to the goal, m; None where it does not.
        least_duration: that way at the speed limit, s.
        duration: with the law's own speeds along it, s.
        disturbance_delta_v: to hold against the disturbance for the whole flight, ∫‖d‖/m dt, m/s.
        drift_delta_v: to hold against the drift (gravity's difference, the frame's turning), likewise, m/s.
        speed_delta_v: to start and to stop, twice the largest speed on the way, m/s.

    """

    way: float | None
    least_duration: float | None
    duration: float | None
    disturbance_delta_v: float
    drift_delta_v: float
    speed_delta_v: float

    @property
    def delta_v(self) -> float:
        """The sum, m/s: an estimate, as what pushes the right way need not be held against."""
        return self.disturbance_delta_v + self.drift_delta_v + self.speed_delta_v

    def summary(self) -> dict[str, Any]:
        """Give the estimates as plain numbers for JSON, named with their units."""
        named = asdict(self)
        units = {"way": "m", "least_duration": "s", "duration": "s"}
        figures = {f"{key}_{units.get(key, 'mps')}": value for key, value in named.items()}
        return {**figures, "delta_v_mps": self.delta_v, "kind": "estimate"}


class _Way(eqx.Module):
    """The flight without inertia, so far."""

    at: MotionState
    memory: Float[Array, "3"]
    length: Float[Array, ""]
    fastest: Float[Array, ""]
    disturbance: Float[Array, ""]
    drift: Float[Array, ""]
    arrived: Float[Array, ""]


def expected(mission: Mission) -> Expected:
    """Estimate what a mission takes, by following its law's safe velocity from the start without inertia."""
    law = mission.setup.controller
    while isinstance(law, AheadOfDelay | BrokenLaw):
        law = law.law
    most, ends = max(_LONGEST * mission.steps, _LEAST_STEPS), []
    if isinstance(law, LegLaw):
        ends = _leg_by_leg(mission, law, most)
    else:
        assert isinstance(law, Controller)
        ends = [_followed(mission.setup, law, mission.initial, as_float64(mission.steps), as_float64(most))]
    end, way = ends[-1], sum(float(end.length) for end in ends)
    arrived = float(end.arrived)
    reached = math.isfinite(arrived)
    return Expected(
        way=way if reached else None,
        least_duration=way / mission.scenario.chaser.speed_limit if reached else None,
        duration=arrived if reached else None,
        disturbance_delta_v=sum(float(end.disturbance) for end in ends),
        drift_delta_v=sum(float(end.drift) for end in ends),
        speed_delta_v=2.0 * sum(float(end.fastest) for end in ends),
    )


def _leg_by_leg(mission: Mission, law: LegLaw, most: int) -> list[_Way]:
    """Follow one leg after the other, each from where the one before ends, once it was held and is released.

    Raises nothing: a leg that does not lead to its place is the last, with an infinite time of arrival.
    """
    ends, at, begun = [], mission.initial, float(mission.initial.time)
    for number, leg in enumerate(mission.scenario.leg):
        setup = replace(mission.setup, goal=as_float64(leg.position), tolerance=as_float64(leg.tolerance))
        last = number + 1 == len(mission.scenario.leg)
        steps = max(mission.steps - begun / float(setup.period), 0.0) if last else 0.0
        way = _followed(setup, law.at_leg(jnp.asarray(number, jnp.int32)), at, as_float64(steps), as_float64(most))
        arrived = begun + float(way.arrived)
        ends.append(replace(way, arrived=as_float64(arrived)))
        if not math.isfinite(arrived):
            break
        begun = max(arrived + float(law.legs.dwell[number]), float(law.legs.release[number]))
        at = replace(way.at, time=as_float64(begun))
    return ends


@eqx.filter_jit
def _followed(
    setup: FlightSetup, law: Controller, initial: MotionState, steps: Float[Array, ""], most: Float[Array, ""]
) -> _Way:
    """Follow the safe velocity until the goal is reached and the flight's `steps` are over, or `most` are."""
    zero = jnp.zeros(())
    period, mass = setup.period, setup.mass
    nothing, still = NoDisturbance(), jnp.zeros(3)

    def going(way: _Way) -> Bool[Array, ""]:
        count = jnp.round((way.at.time - initial.time) / period)
        return (count < steps) | (jnp.isinf(way.arrived) & (count < most))

    def step(way: _Way) -> _Way:
        at = way.at
        point, memory = law.velocity.at_time(at.time)(at.position, at.velocity, way.memory)
        held = at.time - initial.time < steps * period
        speed = jnp.linalg.norm(point.velocity)
        near = jnp.linalg.norm(at.position - setup.goal) < setup.tolerance
        arrived = jnp.where(jnp.isinf(way.arrived) & near, at.time - initial.time, way.arrived)
        # Only what turns the frame is stepped; the chaser goes where its velocity points.
        turned = setup.motion.step(at, still, nothing, period, mass)
        moved = eqx.tree_at(
            lambda state: (state.position, state.velocity),
            turned,
            (at.position + period * point.velocity, point.velocity),
        )
        push = jnp.linalg.norm(setup.disturbance.force(at.time)) / mass
        drift = jnp.linalg.norm(setup.motion.drift_acceleration(at))
        return _Way(
            at=moved,
            memory=memory,
            length=way.length + jnp.where(jnp.isinf(arrived), speed * period, 0.0),
            fastest=jnp.maximum(way.fastest, speed),
            disturbance=way.disturbance + jnp.where(held, push * period, 0.0),
            drift=way.drift + jnp.where(held, drift * period, 0.0),
            arrived=arrived,
        )

    at_rest = eqx.tree_at(lambda state: state.velocity, initial, jnp.zeros(3))
    begin = _Way(at_rest, jnp.zeros(3), zero, zero, zero, zero, jnp.full((), jnp.inf))
    return jax.lax.while_loop(going, step, begin)


_CLOSE = 1e-3
"""Relative: a number nearer than this to one that is refused is not looked for."""
_DIRECTIONS = 400


@dataclass(frozen=True)
class Nearest:
    """A value of one entry with which a scenario is not refused for the same reason.

    Attributes:
        entry: dotted name.
        value: a number, or a place in m.
        words: the same as a person reads it.

    """

    entry: str
    value: float | tuple[float, float, float]
    words: str


@dataclass(frozen=True)
class Refusal:
    """One reason why a scenario would not be flown, and values with which that reason falls away.

    Attributes:
        said: the refusal, one line.
        nearest: values of single entries, each of which would do; none where none was found.

    """

    said: str
    nearest: tuple[Nearest, ...] = ()


@dataclass(frozen=True)
class Check:
    """What is known of a scenario before it is flown.

    Attributes:
        scenario: that was looked at.
        words: what will be flown, a sentence each.
        refusals: why it would not be flown; none if it would.
        conditions: the law's design conditions with their numbers; none where the law cannot be built.
        guard: what the guard assumes and what follows from it, as numbers; None without one.
        start_certified: whether the guard's theorem holds from the start; None without a guard.
        assumptions_broken: what would be flown beyond what the scenario declares.
        expected: estimates of way, time and Δv; None where nothing would be flown.
        remarks: what else is worth knowing.

    """

    scenario: Scenario
    words: tuple[str, ...]
    refusals: tuple[Refusal, ...] = ()
    conditions: tuple[Condition, ...] = ()
    guard: dict[str, Any] | None = None
    start_certified: bool | None = None
    assumptions_broken: tuple[str, ...] = ()
    expected: Expected | None = None
    remarks: tuple[str, ...] = ()

    @property
    def flies(self) -> bool:
        """Whether `keepout fly` would fly it, and `keepout campaign` draw its runs."""
        return not self.refusals

    def summary(self) -> dict[str, Any]:
        """Give everything as plain values for JSON."""
        return {
            "scenario": self.scenario.name,
            "flies": self.flies,
            "words": list(self.words),
            "refusals": [{**vars(refusal), "nearest": [*map(vars, refusal.nearest)]} for refusal in self.refusals],
            "conditions": [
                {**condition._asdict(), "margin": margin(condition), "required": condition.required}
                for condition in self.conditions
            ],
            "guard": self.guard,
            "start_certified": self.start_certified,
            "assumptions_broken": list(self.assumptions_broken),
            "expected": None if self.expected is None else self.expected.summary(),
            "remarks": list(self.remarks),
        }


def margin(condition: Condition) -> float:
    """Give how far a condition's number is from its limit: positive where it holds, negative where it does not."""
    away = abs(condition.value - condition.limit)
    return away if condition.satisfied else -away


def check(
    scenario: ScenarioLike,
    *,
    target: Target | None = None,
    model: FieldModel | None = None,
    progress: Progress = silent,
) -> Check:
    """Find out what flying a scenario would mean.

    Refusals of the dispersions, of the numbers, of the places and of the field are looked for one after the other, so
    that several are told at once; the law and the guard are built only where none of these is found.

    Args:
        scenario: what would be flown: a `Scenario`, the path of its TOML file, or its tables as a dict.
        target: already loaded; else the scenario's.
        model: its field, already loaded; else the scenario's.
        progress: called as the work goes on.

    Raises:
        ScenarioError: the file is not a scenario.
        MeshError: the mesh cannot be used.

    """
    scenario = Scenario.of(scenario)
    progress(0.0, "target")
    target = load_target(scenario.target) if target is None else target
    words = in_words(scenario, target)
    broken = broken_assumptions(scenario, target) if _bounded(scenario) else ()
    campaign, found = _campaign(scenario)
    if campaign is not None:
        names = ", ".join(one.name for one in campaign.dispersions)
        words += (f"A campaign of {campaign.runs} flights varies {names} ({campaign.sampling}).",)
    progress(0.1, "numbers")
    refused = number_refusal(scenario, target)
    if refused is not None:
        found.append(Refusal(str(refused), tuple(remedies(scenario, target))))
    progress(0.25, "places")
    touching, room = _touching(scenario, target), room_to_start(scenario)
    model, refused_field = _field(scenario, target, model)
    found += refused_field
    for name, said in touching.items():
        if found or model is None:  # what a field says of the place is not known
            near = _place(scenario, target, name, lambda points: target.distance.distance(points) > room)
        else:
            near = _free_place(scenario, target, model, name, said, part_of(progress, 0.3, 0.9))
        found.append(Refusal(said, near))
    if found or model is None:
        return Check(scenario, words, tuple(found), assumptions_broken=broken)
    try:
        mission = _prepared(scenario, target, model, part_of(progress, 0.3, 0.8))
    except KeepoutError as refusal:
        name = _named(refusal)
        near = () if name is None else _free_place(scenario, target, model, name, str(refusal), progress)
        return Check(scenario, words, (Refusal(str(refusal), near),), assumptions_broken=broken)
    progress(0.85, "way")
    estimate = expected(mission)
    progress(1.0, "")
    return Check(
        scenario,
        words,
        conditions=mission.setup.controller.conditions,
        guard=None if mission.guard is None else guard_numbers(mission.guard, scenario),
        start_certified=mission.start_certified,
        assumptions_broken=broken,
        expected=estimate,
        remarks=(
            *_remarks(mission, estimate),
            *(() if campaign is None else refused_values(scenario, campaign)),
        ),
    )


def _campaign(scenario: Scenario) -> tuple[Design | None, list[Refusal]]:
    """Read what a campaign of the scenario varies, if it says so itself, or say why it cannot be read."""
    if not scenario.campaign.dispersions:
        return None, []
    try:
        return campaign_design(scenario), []
    except ScenarioError as refusal:
        return None, [Refusal(str(refusal))]


def _field(scenario: Scenario, target: Target, model: FieldModel | None) -> tuple[FieldModel | None, list[Refusal]]:
    """Give the field that the scenario is flown by, or say why it cannot be."""
    try:
        if model is None:
            require_files(scenario)
            model = load_model(scenario, target)
        model.require_target(target, where="field")
        model.certificate(scenario.chaser.radius)
    except KeepoutError as refusal:
        return None, [Refusal(str(refusal), _certified_radius(scenario, model))]
    return model, []


def _prepared(scenario: Scenario, target: Target, model: FieldModel, progress: Progress = silent) -> Mission:
    """Build the mission; that the paper's law violates conditions is shown with them, not warned of."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ControlWarning)
        return prepare(scenario, target=target, model=model, progress=progress)


def _bounded(scenario: Scenario) -> bool:
    try:
        _ = Surroundings(scenario).disturbance_bound
    except KeepoutError:
        return False
    return True


def _touching(scenario: Scenario, target: Target) -> dict[str, str]:
    """Give the refusals of a start and a goal that touch the target, by name."""
    # The other of the two stands where it touches nothing, so that each is told of.
    away = (float(2.0 * np.abs(target.vertices).max() + 10.0 + 2.0 * scenario.chaser.radius), 0.0, 0.0)
    found = {}
    for name, other in (("start", "goal"), ("goal", "start")):
        try:
            require_apart(scenario.replace(**{other: {"position": away}}, leg=(), zone=()), target)
        except KeepoutError as refusal:
            found[name] = str(refusal)
    return found


def _place(scenario: Scenario, target: Target, name: str, roomy: Any) -> tuple[Nearest, ...]:
    """Give a place near a start or goal that has room, and is proved to have a way out."""
    place = np.asarray(getattr(scenario, name).position)
    size = float(np.ptp(target.vertices, axis=0).max())

    def free(points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Keep of the points with room the first one with a way out, as one is all that is asked for."""
        kept = np.zeros(len(points), dtype=bool)
        for number in np.flatnonzero(roomy(points)):
            if has_way_out(scenario, target, points[number]):
                kept[number] = True
                break
        return kept

    near = nearest_place(free, place, 2.0 * size + 10.0)
    if near is None:
        return ()
    away = math.dist(near, place)
    words = f"{name}.position = {bracketed(near)}, {away:.3g} m away, is free"
    return (Nearest(f"{name}.position", near, words),)


def _certified_radius(scenario: Scenario, model: FieldModel | None) -> tuple[Nearest, ...]:
    """Give the chaser radius nearest to the scenario's for which the field is certified."""
    if model is None:
        try:
            model = load_model(scenario, load_target(scenario.target))
        except KeepoutError:
            return ()
    radii = sorted((c.chaser_radius for c in model.certificates), key=lambda r: abs(r - scenario.chaser.radius))
    return tuple(Nearest("chaser.radius", radius, f"chaser.radius = {radius:g} m") for radius in radii[:1])


def _named(refusal: KeepoutError) -> str | None:
    """Say which of start and goal a refusal is about, if it is about one of them."""
    if isinstance(refusal, KeepOutZoneError):
        return refusal.place
    said = str(refusal)
    if "at the goal" in said or said.removeprefix("guard: ").startswith("goal"):
        return "goal"
    return "start" if "at the start" in said or said.removeprefix("guard: ").startswith("start") else None


def _free_place(
    scenario: Scenario, target: Target, model: FieldModel, name: str, said: str, progress: Progress
) -> tuple[Nearest, ...]:
    """Give a place near a start or goal that was refused, with which law and guard can be built.

    None where the goal is the last leg's place.
    """
    if name == "goal" and scenario.leg:
        return ()
    error_bound = model.certificate(scenario.chaser.radius).error_bound
    designed = operation(Surroundings(scenario), error_bound)
    least = designed.keep_out + (tune(designed).nominal_offset if scenario.control.profile == "default" else 0.0)
    # Beside what the law keeps there is the guard's tube; where that is not enough, more.
    for extra in (0.01, 0.25, 0.5, 1.0):
        near = _place(scenario, target, name, lambda points, e=extra: values(model.field, points) > least + e)
        if not near:
            return ()
        progress(0.9, "nearest place")
        try:
            _prepared(scenario.replace(**{name: {"position": near[0].value}}), target, model)
        except KeepoutError as again:
            if _named(again) == name or str(again) == said:
                continue
        return near
    return ()


def _remarks(mission: Mission, estimate: Expected) -> tuple[str, ...]:
    """Say what is not refused and still worth knowing."""
    found = [
        f"[{verb}] is flown by `keepout {verb}`; what stands here is of a flight by `keepout fly`, to [goal]"
        for verb in ("inspect", "explore")
        if verb in mission.scenario.model_fields_set
    ]
    duration = mission.scenario.duration
    if estimate.duration is None:
        found.append("the safe velocity does not lead to the goal: the law gets stuck, or another guidance is needed")
    elif estimate.duration > duration:
        found.append(
            f"duration {duration:g} s is shorter than the {estimate.duration:.0f} s that the way is expected to take: "
            f"the goal will not be reached; duration = {math.ceil(1.2 * estimate.duration + 50.0):g} gives it time"
        )
    if mission.start_certified is False:
        found.append("the start is not certified: the guard promises nothing until it has a plan")
    found += [f"beyond the guard's assumptions: {broken}" for broken in mission.assumptions_broken]
    found += [str(c) for c in mission.setup.controller.conditions if not c.satisfied]
    return tuple(found)


def number_refusal(scenario: Scenario, target: Target) -> KeepoutError | None:
    """Give what a scenario's numbers are refused for, whatever its field says: by the law, then by the guard."""
    try:
        around = Surroundings(scenario, target)
        designed = operation(around, 0.0)
        if scenario.control.profile == "default":
            reach = max(np.linalg.norm(scenario.goal.position), np.linalg.norm(scenario.start.position))
            drift = drift_bound(designed.motion, radius=float(reach), speed=scenario.chaser.speed_limit)
            tune(designed, drift_bound=drift)
        if scenario.guard.enabled:
            design(around.guard_assumptions)
    except KeepoutError as refusal:
        return refusal
    return None


def nearest_number(refused: Callable[[float], Any], value: float, end: float) -> float | None:
    """Give the number nearest to `value`, which is refused, on the way to `end`, that is not; None if `end` is too.

    By bisection, so of several such stretches one; the answer itself was tried. It has three or four digits.
    """
    if refused(end):
        return None
    good, bad = end, value
    while abs(bad - good) > _CLOSE * max(abs(good), 1e-9):
        low, high = min(good, bad), max(good, bad)
        # Orders of magnitude apart, the middle is that of the logarithms.
        middle = math.sqrt(low * high) if 0.0 < 4.0 * low < high else 0.5 * (low + high)
        good, bad = (good, middle) if refused(middle) else (middle, bad)
        if max(abs(good), abs(bad)) < 1e-9:
            break
    for digits in (3, 4):
        rounded = _towards(good, end, digits)
        if not refused(rounded):
            return rounded
    return good


def _towards(value: float, end: float, digits: int) -> float:
    """Round a number to some digits, in the direction of another."""
    if value == 0.0:
        return value
    unit = 10.0 ** (math.floor(math.log10(abs(value))) + 1 - digits)
    steps = value / unit
    return float(f"{(math.ceil(steps - 1e-9) if end > value else math.floor(steps + 1e-9)) * unit:.{digits}g}")


def remedies(scenario: Scenario, target: Target) -> list[Nearest]:
    """Give, for a scenario whose numbers are refused, values of single entries with which they are not.

    Tried are a lower speed limit, stronger thrusters, a weaker disturbance, and smaller errors declared to the guard.
    """
    guard, chaser = scenario.guard, scenario.chaser
    errors = (("position_error", " m"), ("velocity_error", " m/s"), ("mass_error", ""), ("gain_error", ""))
    tried = [("chaser.speed_limit", chaser.speed_limit, 1e-3 * chaser.speed_limit, "at most", " m/s")]
    tried += [("chaser.force_limit", chaser.force_limit, 1e3 * chaser.force_limit, "at least", " N")]
    tried += [
        (f"guard.{name}", getattr(guard, name), 0.0, "at most", unit)
        for name, unit in errors
        if guard.enabled and getattr(guard, name) > 0.0
    ]
    found = []
    for entry, value, end, words, unit in tried:

        def refused(number: float, entry: str = entry) -> bool:
            return number_refusal(with_entries(scenario, {entry: number}), target) is not None

        nearest = nearest_number(refused, value, end)
        if nearest is not None:
            found.append(Nearest(entry, nearest, f"{entry} {words} {nearest:.4g}{unit}"))
    return found


def nearest_place(
    free: Callable[[Float[np.ndarray, "n 3"]], Bool[np.ndarray, " n"]], place: Float[np.ndarray, "3"], furthest: float
) -> tuple[float, float, float] | None:
    """Give a place (m) that is free, near to one that is not; None where none is found within `furthest` m.

    Spheres about the place are searched in many directions from the smallest on, and the way back from what is found is
    bisected. What is given is free; that nothing nearer is, is not proved.
    """
    for radius in takewhile(lambda radius: radius < furthest, accumulate(repeat(1.25), operator.mul, initial=0.05)):
        shell = place + radius * _sphere()
        found = np.flatnonzero(free(shell))
        if not len(found):
            continue
        good, bad = shell[found[0]], place
        while np.linalg.norm(good - bad) > 1e-3:
            middle = 0.5 * (good + bad)
            good, bad = (middle, bad) if free(middle[None])[0] else (good, middle)
        rounded = np.round(good, 2)
        x, y, z = (rounded if free(rounded[None])[0] else good).tolist()
        return x, y, z
    return None


def _sphere() -> Float[np.ndarray, "n 3"]:
    """Directions spread evenly over the sphere (Fibonacci's)."""
    turn = np.pi * (1.0 + math.sqrt(5.0)) * np.arange(_DIRECTIONS)
    z = 1.0 - (2.0 * np.arange(_DIRECTIONS) + 1.0) / _DIRECTIONS
    flat = np.sqrt(1.0 - z * z)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)
