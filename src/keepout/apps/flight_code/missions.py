"""What of a mission goes into the flight code, what the code cannot fly, and the mission as the code flies it.

The code computes in double what Python computes in double too, but for the learned field: there Python flies float32.
`coded` gives the same mission with that field in double and with the guard's field as its packed tables hold it:
then both compute the same, to rounding. The guard is told how far the packed field can be from the certified one.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from keepout.apps.flight_code.rounding import Rounding, of_network, of_pulses, of_spline, reach_of, with_rounding
from keepout.apps.flight_code.spline_tables import SplineTables, packed
from keepout.core.control.controller import Controller
from keepout.core.control.geodesic import GeodesicGuidance
from keepout.core.control.guidance import StraightGuidance
from keepout.core.control.law import AheadOfDelay
from keepout.core.control.observer import NoObserver, SampledObserver
from keepout.core.errors import ExchangeError
from keepout.core.fields.grid import GridField
from keepout.core.fields.neural import NeuralField
from keepout.core.flight.navigation import Navigation, Sensor
from keepout.core.guard.braking import GuardAssumptions
from keepout.core.guard.guard import Guard
from keepout.core.guard.start import require_flyable
from keepout.core.mission.build import Mission
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings
from keepout.core.motion.attitude import InertiallyFixed, Tumbling, VVLHFixed
from keepout.core.motion.chaser import Thrusters
from keepout.flights.navigation.estimators import KalmanFilter
from keepout.flights.navigation.known_set import CAPS_ROUNDING, SetMembership, largest_radii, told_by
from keepout.flights.navigation.sensors import (
    RangeBearing,
    RangeRate,
    RelativePosition,
    RelativeVelocity,
    TargetAttitude,
)
from keepout.flights.thrusters.on_off import OnOffThrusters

MOST_LAYERS, MOST_WIDTH = 10, 512
"""Of a learned field that the code has room for on its stack."""
SENSORS = (RelativePosition, RelativeVelocity, RangeBearing, RangeRate, TargetAttitude)
"""As numbered in sources/keepout.h."""
MOST_KEPT = 200
"""Control periods over which the set of a suite looks back: with the filter its memory is within 16 kB."""
MOST_POINTS = 256
"""Of an allocation: those of 12 directions, the most that there are, take about 100 kB of the mission's constants."""


class Coded(NamedTuple):
    """A mission for the code.

    Attributes:
        mission: as the code flies it, in double, by the packed field and with thrusters that push as they should.
        law: its law, without the layer that looks ahead of a delay.
        guard_tables: the guard's field, packed; None without a guard.
        law_tables: likewise the law's, where it flies by a spline of its own; None where it shares the guard's.
        packing_error: how far a packed field can be from the certified one, m.
        rounding: what double can do to the numbers of the code; the guard counts its own part.

    """

    mission: Mission
    law: Controller
    guard_tables: SplineTables | None
    law_tables: SplineTables | None
    packing_error: float
    rounding: Rounding


def coded(mission: Mission) -> Coded:
    """Take a mission for the code.

    Raises:
        ExchangeError: something of it that the code cannot fly; the message names the entry.

    """
    require_entries(mission.scenario)
    if refused := _refused(mission):
        raise ExchangeError(f"--to c: {refused}")
    setup, guard, tables, error = mission.setup, mission.guard, None, 0.0
    law, thrusters, navigation = _law(mission), _thrusters(mission), setup.navigation
    field = law.velocity.field
    if guard is not None:
        assert isinstance(guard.field, GridField)
        tables, held, error = packed(guard.field)
        shared = isinstance(field, GridField) and np.array_equal(field.coefficients, guard.field.coefficients)
        field = held if shared else field
        assumed = jax.tree.map(float, guard.assumptions)  # a setup's are arrays
        guard = Guard(held, guard.threshold, guard.lipschitz, assumed, guard.evaluation_error + error)
        guard, rounded, force = with_rounding(guard, 0.0 if isinstance(thrusters, Thrusters) else of_pulses(thrusters))
        if navigation is not None:
            guard, navigation = _with_set(guard, navigation)
    else:
        shared, rounded, force = False, 0.0, 0.0
    law_tables = None
    if isinstance(field, NeuralField):
        layers = jax.tree.map(lambda array: jax.device_put(np.asarray(array, np.float64)), field.layers)
        field = dataclasses.replace(field, layers=layers)
    elif isinstance(field, GridField) and not shared:
        law_tables, field, own = packed(field)
        error = max(error, own)
    law = dataclasses.replace(law, velocity=dataclasses.replace(law.velocity, field=field))
    outer = setup.controller
    flown = dataclasses.replace(outer, law=law) if isinstance(outer, AheadOfDelay) else law
    start_certified = mission.start_certified
    if guard is not None:
        start_certified = require_flyable(guard, mission.initial, law.goal) and not mission.assumptions_broken
    parts = {"controller": flown, "guard": guard, "field": field, "thrusters": thrusters, "navigation": navigation}
    setup = dataclasses.replace(setup, **parts)
    made = dataclasses.replace(mission, setup=setup, start_certified=start_certified)
    return Coded(made, law, tables, law_tables, error, Rounding(rounded, _law_rounding(field, guard), force))


def _with_set(guard: Guard, navigation: Navigation) -> tuple[Guard, Navigation]:
    """Count what the guard allows for the rounding of the force in the set too, and the radii that this leads to."""
    a, bounded = guard.assumptions, navigation.bounded
    assert isinstance(bounded, SetMembership)
    disturbance, limits = float(a.disturbance + a.fault_push), (float(a.range_limit), float(a.speed_limit))
    first = float(navigation.initial_errors[0]), float(navigation.initial_errors[1])
    radii = largest_radii(told_by(bounded.suite, limits), bounded.window, disturbance, float(a.period), first)
    assert radii is not None
    names = ("position_error", "velocity_error")
    errors = {
        name: max(float(getattr(a, name)), radius * (1.0 + CAPS_ROUNDING))
        for name, radius in zip(names, radii, strict=True)
    }
    assumptions: GuardAssumptions = dataclasses.replace(a, **errors)
    guard = Guard(guard.field, guard.threshold, guard.lipschitz, assumptions, guard.evaluation_error)
    bounded = dataclasses.replace(bounded, disturbance=disturbance)
    return guard, dataclasses.replace(navigation, bounded=bounded)


def _law_rounding(field: Any, guard: Guard | None) -> float:
    """Bound the rounding of the law's field, within the guard's range or else its domain, m."""
    reach = float(field.continuation.outer_radius) if guard is None else reach_of(guard)
    return of_network(field, reach) if isinstance(field, NeuralField) else of_spline(field, reach)


def _law(mission: Mission) -> Controller:
    outer = mission.setup.controller
    law = outer.law if isinstance(outer, AheadOfDelay) else outer
    assert isinstance(law, Controller)
    return law


def _thrusters(mission: Mission) -> Thrusters | OnOffThrusters:
    """Give the thrusters that the scenario asks for, without the errors that a flight draws: no code can know them."""
    if mission.scenario.thrusters.layout == "ideal":
        return Thrusters(mission.scenario.chaser.force_limit)
    assert isinstance(mission.setup.thrusters, OnOffThrusters)
    return dataclasses.replace(mission.setup.thrusters, misalignment=0.0, scale_error=0.0)


def require_entries(scenario: Scenario) -> None:
    """Refuse a scenario with entries that the code cannot fly, before anything is prepared.

    Args:
        scenario: what to fly.

    Raises:
        ExchangeError: the message names the first such entry and what is valid.

    """
    refused = None
    motion = Surroundings(scenario).motion
    if scenario.leg or scenario.zone or scenario.corridor or scenario.approach.model_dump(exclude_defaults=True):
        refused = "legs, zones, corridors and approach rules are not in the flight code; it flies to one goal"
    elif scenario.control.profile != "default":
        refused = f'control.profile is "{scenario.control.profile}"; the flight code has the default one'
    elif scenario.control.circulation is not None:
        refused = f'control.circulation is "{scenario.control.circulation}"; the flight code has none: leave it out'
    elif scenario.control.observer == "printed":
        refused = 'control.observer is "printed"; the flight code has "harmonic", "constant" and "off"'
    elif scenario.faults.law != "none":
        refused = f'faults.law is "{scenario.faults.law}"; the flight code has the law as it is: "none" is valid'
    elif scenario.thrusters.survive_failure:
        refused = "thrusters.survive_failure is true; the flight code fires a layout whose thrusters all work"
    elif scenario.faults.thruster is not None:
        refused = "faults.thruster is given; the flight code fires a layout whose thrusters all work: leave it out"
    elif scenario.navigation.suite != "none" and scenario.navigation.estimate != "filter":
        refused = f'navigation.estimate is "{scenario.navigation.estimate}"; of suites the flight code has the "filter"'
    elif scenario.navigation.suite != "none" and motion.held_inertially:
        refused = 'thrusters.held_in is "inertial"; with a suite the flight code holds forces in body axes'
    elif motion.perturbations:
        refused = "orbit.j2, drag and the push of sunlight are not in the flight code; leave them out"
    elif motion.held_inertially and scenario.guard.delay:
        refused = 'thrusters.held_in is "inertial" and guard.delay above 0; the code looks ahead in body axes only'
    if refused is not None:
        raise ExchangeError(f"--to c: {refused}")


def _refused(mission: Mission) -> str | None:
    """Say which part of a mission is none of the code's, or None: parts may be others than the scenario's."""
    outer = mission.setup.controller
    law = outer.law if isinstance(outer, AheadOfDelay) else outer
    if not isinstance(law, Controller):
        return f"the law is a {type(law).__name__}; the flight code has the default profile's only"
    velocity, field = law.velocity, law.velocity.field
    parts: list[tuple[str, Any, tuple[type, ...]]] = [
        ("the law's field", field, (NeuralField, GridField)),
        ("the law's guidance", velocity.guidance, (GeodesicGuidance, StraightGuidance)),
        ("the law's observer", law.observer, (SampledObserver, NoObserver)),
        ("the attitude", mission.setup.motion.attitude_motion, (VVLHFixed, InertiallyFixed, Tumbling)),
    ]
    if mission.scenario.thrusters.layout != "ideal":
        parts += [("the layout's thrusters", mission.setup.thrusters, (OnOffThrusters,))]
    if (navigation := mission.setup.navigation) is not None:
        parts += [("the law's estimate", navigation.estimator, (KalmanFilter,))]
        parts += [("the guard's estimate", navigation.bounded, (SetMembership,))]
        parts += [("a sensor", sensor, SENSORS) for sensor in navigation.suite.sensors]
    if mission.setup.guard is not None:
        parts += [("the guard", mission.setup.guard, (Guard,))]
    if mission.guard is not None:
        parts += [("the guard's field", mission.guard.field, (GridField,))]
    for name, part, valid in parts:
        if type(part) not in valid:
            return f"{name} is a {type(part).__name__}; valid: {', '.join(kind.__name__ for kind in valid)}"
    if velocity.circulation is not None or velocity.box is not None or velocity.differentiate:
        return "the law has a circulation, the paper's box or feedforward; the flight code has none of them"
    if isinstance(velocity.guidance, GeodesicGuidance) and int(velocity.guidance.first):
        return "the guidance is one of several legs; the flight code flies to one goal"
    if isinstance(law.observer, SampledObserver) and not _by_axis(law.observer):
        return "the law's observer mixes the axes; the flight code has one model for each axis alike"
    kept = 0 if navigation is None else _navigation_sizes(navigation)["KEPT"]
    if kept > MOST_KEPT:
        return f"the suite's set looks back over {kept} control periods; {MOST_KEPT} fit into its memory"
    if navigation is not None and len({sensor.latency for sensor in navigation.suite.sensors}) > 1:
        return "the suite's sensors have several latencies; the flight code has one for all"
    if isinstance(mission.setup.thrusters, OnOffThrusters):
        points, groups = mission.setup.thrusters.allocation.offset.shape
        if points > MOST_POINTS:
            return f"thrusters.own: its {groups} directions have {points} points of allocation; {MOST_POINTS} fit"
    if isinstance(field, NeuralField):
        widths = [len(bias) for bias in field.layers.biases[:-1]]
        if len(widths) > MOST_LAYERS or max(widths) > MOST_WIDTH:
            return f"the learned field has layers of {widths}; at most {MOST_LAYERS} of {MOST_WIDTH} neurons fit"
    return None


def _by_axis(observer: SampledObserver) -> bool:
    """Whether an observer is the same model for each axis, apart from the others."""
    count = len(observer.transition) // 3
    one = observer_of_an_axis(observer)
    whole = (observer.transition, observer.mean_output, observer.output, observer.gain)
    return count * 3 == len(observer.transition) and all(
        np.array_equal(np.asarray(matrix), np.kron(np.eye(3), part)) for matrix, part in zip(whole, one, strict=True)
    )


def observer_of_an_axis(observer: SampledObserver) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Give transition (q, q), mean output (1, q), output (1, q) and gain (q, 1) of one axis."""
    q = len(observer.transition) // 3
    return (
        np.asarray(observer.transition)[:q, :q],
        np.asarray(observer.mean_output)[:1, :q],
        np.asarray(observer.output)[:1, :q],
        np.asarray(observer.gain)[:q, :1],
    )


def directions_of(guidance: GeodesicGuidance) -> np.ndarray:
    """Give a guidance's directions as three signed bytes a node, (nx, ny, nz, 3), without the array's padding."""
    nodes = tuple(int(count) for count in np.asarray(guidance.nodes))
    number = np.asarray(guidance.directions)[: nodes[0], : nodes[1], : nodes[2]]
    return np.stack([(number << shift) >> 24 for shift in (24, 16, 8)], axis=-1).astype(np.int8)


def numbers_of(made: Coded) -> dict[str, dict[str, Any]]:
    """Give what the C structures hold, by structure and member (`sources/keepout.h`)."""
    setup, guidance = made.mission.setup, made.law.velocity.guidance
    motion, attitude = setup.motion, setup.motion.attitude_motion
    assert isinstance(guidance, GeodesicGuidance | StraightGuidance)
    tumbling = isinstance(attitude, Tumbling)
    told: dict[str, dict[str, Any]] = {
        "motion": {
            **{
                name: getattr(motion.orbit, name)
                for name in ("semi_major_axis", "eccentricity", "true_anomaly", "gravitational_parameter")
            },
            "centre_of_mass": motion.centre_of_mass,
            "turning": 2 if tumbling else int(isinstance(attitude, InertiallyFixed)),
            "inertia": attitude.inertia if tumbling else np.eye(3),
            "gravity_gradient": tumbling and attitude.gravity_gradient,
            "substeps": motion.substeps,
        },
        "law": _law_numbers(made),
        "guidance": {
            "goal": guidance.goal,
            "speed": guidance.speed,
            "slowing_length": guidance.slowing_length,
        },
    }
    if isinstance(guidance, GeodesicGuidance):
        told["guidance"] |= {name: getattr(guidance, name) for name in ("origin", "spacing", "inner", "outer")}
        told["guidance"]["nodes"] = np.asarray(guidance.nodes).astype(int)
    told["guard"] = _guard_numbers(made.mission.guard)
    told["thrusters"] = _thruster_numbers(made.mission)
    if setup.navigation is not None:
        told["navigation"] = _navigation_numbers(setup.navigation)
    return told


def _law_numbers(made: Coded) -> dict[str, Any]:
    law, scenario = made.law, made.mission.scenario
    velocity, tracking = law.velocity, law.tracking
    assert velocity.speed is not None
    assert velocity.class_k.braking is not None
    told = {
        "offset": velocity.offset,
        "nominal_offset": law.nominal_offset,
        "class_k_rate": velocity.class_k.rate,
        "class_k_braking": velocity.class_k.braking,
        "speed_limit": velocity.speed.limit,
        "speed_authority": velocity.speed.authority,
        "speed_reserve": velocity.speed.reserve,
        **{
            name: getattr(tracking, name)
            for name in (
                *("gain", "position_weight", "lyapunov_ratio", "barrier_ratio", "estimation_weight"),
                *("estimation_rate", "barrier_rate", "sharpness", "acceleration_limit"),
            )
        },
        "mass": law.mass,
        "period": made.mission.setup.period,
        "force_limit": law.force_limit,
        "delay": scenario.guard.delay,
        "model": 0,
        "field": int(isinstance(velocity.field, GridField)),
    }
    if scenario.navigation.suite == "none" and isinstance(law.observer, SampledObserver):
        names = ("transition", "mean_output", "output", "model_gain")
        parts = observer_of_an_axis(law.observer)
        told["model"] = len(parts[0])
        told |= {name: part if name == "transition" else part.ravel() for name, part in zip(names, parts, strict=True)}
    return told


def _navigation_numbers(navigation: Navigation) -> dict[str, Any]:
    kalman, bounded = navigation.estimator, navigation.bounded
    assert isinstance(kalman, KalmanFilter)
    assert isinstance(bounded, SetMembership)
    noise, errors = np.asarray(kalman.process_noise), np.asarray(navigation.initial_errors)
    return {
        "sensor": [
            _sensor_numbers(sensor, float(gate)) for sensor, gate in zip(kalman.sensors, kalman.gates, strict=True)
        ],
        **{name: getattr(kalman, name) for name in ("mass", "period", "disturbance_variance", "attitude_share")},
        # An array of a constant alone has no pairs; C has none of no length.
        **{name: [0.0] if kalman.model.size == 1 else getattr(kalman.model, name) for name in ("cosine", "sine")},
        "mean_output": kalman.model.mean_output,
        "noise": noise[:6:3, :6:3],
        "walk": noise[6, 6],
        "position_error": errors[0],
        "velocity_error": errors[1],
        "guard_mass": bounded.mass,
        "disturbance": bounded.disturbance,
    }


def _sensor_numbers(sensor: Sensor, gate: float) -> dict[str, Any]:
    told: dict[str, Any] = {"kind": SENSORS.index(type(sensor)), "gate": gate}
    if isinstance(sensor, RangeBearing):
        errors = sensor.range_errors
        theta = jnp.minimum(sensor.bearing_errors.bound(), jnp.pi)
        told |= {"bearing_variance": sensor.bearing_errors.variance(), "bearing_square": jnp.sin(0.5 * theta) ** 2}
    else:
        assert isinstance(sensor, RelativePosition | RelativeVelocity | RangeRate | TargetAttitude)
        errors = sensor.errors
    if isinstance(sensor, RangeBearing | RelativePosition | RelativeVelocity) and sensor.axes == "vvlh":
        told |= {"in_vvlh": True, "attitude_variance": sensor.attitude_error**2 / 5.0}
        told["turned"] = 2.0 * jnp.sin(0.5 * sensor.attitude_error)
    return told | {"variance": errors.variance(), "bound": errors.bound()}


def _thruster_numbers(mission: Mission) -> dict[str, Any]:
    thrusters = mission.setup.thrusters
    numbers = {"count": 0, "force_limit": mission.scenario.chaser.force_limit, "period": mission.setup.period}
    if not isinstance(thrusters, OnOffThrusters):
        return numbers
    allocation = thrusters.allocation
    points, groups = allocation.offset.shape
    return {
        **numbers,
        "count": len(thrusters.push),
        "groups": groups,
        "points": points,
        **{name: getattr(thrusters, name) for name in ("delta_sigma", "least_on_time", "rise_delay", "push")},
        "price": np.asarray(allocation.price).T,
        **{
            name: getattr(allocation, name)
            for name in ("fee", "slope", "offset", "largest", "balanced", "group", "paired", "alone")
        },
    }


def _guard_numbers(guard: Guard | None) -> dict[str, Any]:
    if guard is None:
        return {"present": False}
    a, design, observer = guard.assumptions, guard.braking, guard.braking.observer
    numbers = {
        "present": True,
        **{name: getattr(guard, name) for name in ("threshold", "lipschitz", "evaluation_error", "parts")},
        **{
            name: getattr(a, name)
            for name in (
                *("mass", "force_limit", "period", "disturbance", "drift", "fault_push", "range_limit", "speed_limit"),
                *("position_error", "velocity_error", "valid_until", "delay"),
            )
        },
        "windows": len(guard.windows),
        "window": np.array(guard.windows),
        **{
            name: getattr(design, name)
            for name in ("position_gain", "velocity_gain", "deceleration", "position_radius", "velocity_radius")
        },
        "observes": observer is not None,
    }
    if observer is not None:
        numbers |= {
            "observer_position": observer.position,
            "observer_velocity": observer.velocity,
            "error_radius": observer.error_radius,
            "velocity_error_radius": observer.velocity_error_radius,
            "plan_radius": observer.plan_radius,
        }
    return numbers


def sizes_of(made: Coded) -> dict[str, int]:
    """Give the sizes of the code's arrays, each at least 1."""
    field, guard = made.law.velocity.field, made.mission.guard
    widths = [len(bias) for bias in field.layers.biases[:-1]] if isinstance(field, NeuralField) else [1]
    grids = [tables for tables in (made.guard_tables, made.law_tables) if tables is not None]
    model = numbers_of(made)["law"]["model"]
    thrusters = _thruster_numbers(made.mission)
    return {
        "LAYERS": len(widths),
        "WIDTH": max(3, *widths),
        # Two at least: a compiler that knows that there is but one warns of what is done with others.
        "LEVELS": max([2, *(1 + len(tables.levels) for tables in grids)]),
        "DELAY": max(1, made.mission.scenario.guard.delay),
        "WINDOWS": 1 if guard is None else len(guard.windows),
        "MODEL": max(1, model),
        **{name.upper(): thrusters.get(name, 1) for name in ("points", "groups")},
        "THRUSTERS": max(1, thrusters["count"]),
        **_navigation_sizes(made.mission.setup.navigation),
    }


def _navigation_sizes(navigation: Navigation | None) -> dict[str, int]:
    if navigation is None:
        return {"SENSORS": 0, "LATENCY": 0, "PUSHES": 1, "WINDOW": 0, "KEPT": 1}
    kalman, bounded = navigation.estimator, navigation.bounded
    assert isinstance(kalman, KalmanFilter)
    assert isinstance(bounded, SetMembership)
    return {
        "SENSORS": len(kalman.sensors),
        "LATENCY": kalman.latency,
        "PUSHES": kalman.model.size,
        "WINDOW": bounded.window,
        "KEPT": max(1, bounded.window, kalman.latency),
    }
