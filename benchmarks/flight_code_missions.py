"""The missions by which the flight code is tried, each exported and compiled."""

from pathlib import Path
from typing import Any, NamedTuple

from compiled_step import CompiledStep

from keepout.apps.flight_code.folder import write_flight_code
from keepout.apps.flight_code.missions import Coded, coded
from keepout.core.mission.build import prepare
from keepout.core.mission.scenario import Scenario

TURNING = {"kind": "tumbling", "angular_velocity": (0.001, 0.002, 0.0005)}
OWN = [
    {"position": place, "direction": way, "force": force}
    for place, way, force in (
        ((-0.5, 0.3, 0.0), (1.0, 0.0, 0.0), 0.06),
        ((-0.5, -0.2, 0.0), (1.0, 0.0, 0.0), 0.05),
        ((0.5, 0.1, 0.0), (-1.0, 0.0, 0.0), 0.12),
        ((0.0, -0.5, 0.0), (0.0, 1.0, 0.0), 0.11),
        ((0.2, 0.5, 0.0), (0.0, -1.0, 0.0), 0.06),
        ((-0.2, 0.5, 0.1), (0.0, -1.0, 0.0), 0.06),
        ((0.0, 0.0, -0.5), (0.0, 0.0, 1.0), 0.11),
        ((0.1, 0.0, 0.5), (0.0, 0.0, -1.0), 0.12),
        ((-0.4, -0.4, 0.0), (1.0, 1.0, 0.0), 0.06),
        ((0.4, -0.2, -0.4), (-1.0, 0.5, 1.0), 0.05),
    )
]
"""Thrusters askew, in pairs of which some turn the chaser: groups that are full, and parts of them that come alone."""
MISSIONS: dict[str, dict[str, Any]] = {
    "as it is": {},
    "delay": {"guard": {"delay": 2}},
    "errors of the estimate": {"guard": {"position_error": 0.05, "velocity_error": 0.002}},
    "both, inertially fixed": {
        "guard": {"delay": 1, "position_error": 0.03, "velocity_error": 0.001},
        "attitude": {"kind": "inertial"},
    },
    "tumbling": {"attitude": {**TURNING, "inertia": ((2.0, 0, 0), (0, 3.0, 0), (0, 0, 4.0))}},
    "elliptic": {"orbit": {"eccentricity": 0.3, "semi_major_axis": 2.4e7, "true_anomaly": 0.4}},
    "law by the spline": {"field": {"source": "grid"}},
    "strong, errors and delay": {
        "chaser": {"mass": 100.0, "force_limit": 1.0},
        "guard": {"position_error": 0.1, "velocity_error": 0.004, "delay": 2},
    },
    "tumbling by gravity, elliptic": {
        "attitude": {**TURNING, "inertia": ((2.0, 0.1, 0), (0.1, 3.0, 0), (0, 0, 4.0)), "gravity_gradient": True},
        "orbit": {"eccentricity": 0.1, "semi_major_axis": 9e6},
        "chaser": {"mass": 60.0, "force_limit": 1.0},
    },
    "straight guidance": {"control": {"guidance": "straight"}},
    "constant observer, longest delay": {
        "control": {"observer": "constant"},
        "guard": {"delay": 8},
        "chaser": {"mass": 20.0, "force_limit": 1.0},
    },
    "no observer": {"control": {"observer": "off"}},
    "held inertially, 2 s": {"thrusters": {"held_in": "inertial"}, "control": {"period": 2.0}},
    "unguarded": {"guard": {"enabled": False}},
    "12 thrusters": {"thrusters": {"layout": "12"}},
    "24 thrusters, late, owed": {
        "thrusters": {
            **{"layout": "24", "modulation": "delta-sigma", "least_on_time": 0.04, "rise_delay": 0.004},
            **{"misalignment": 0.01, "scale_error": 0.02},
        },
        "guard": {"delay": 1, "position_error": 0.03, "velocity_error": 0.001},
        "chaser": {"mass": 100.0, "force_limit": 1.0},
    },
    "pose by lidar, late": {
        "navigation": {"suite": "close", "dropout": 0.05, "most_missed": 2},
        "guard": {"delay": 1},
        "chaser": {"mass": 30.0, "force_limit": 1.0},
    },
    "GNSS, elliptic, unguarded": {
        "navigation": {"suite": "far"},
        "guard": {"enabled": False},
        "attitude": {"kind": "inertial"},
        "control": {"observer": "constant"},
        "orbit": {"eccentricity": 0.1, "semi_major_axis": 9e6},
    },
    "thrusters askew": {"thrusters": {"layout": "own", "own": OWN, "least_on_time": 0.05, "modulation": "delta-sigma"}},
    "laser, tumbling": {
        "navigation": {"suite": "near"},
        "attitude": {**TURNING, "inertia": ((2.0, 0, 0), (0, 3.0, 0), (0, 0, 4.0))},
        "chaser": {"mass": 30.0, "force_limit": 1.0},
    },
}


class Exported(NamedTuple):
    """A mission, the folder of its flight code, and that compiled."""

    name: str
    made: Coded
    folder: Path
    code: CompiledStep


def folder_of(name: str, kept: Path) -> Path:
    """Give the folder of a mission's flight code among those of all."""
    return kept / "".join(letter if letter.isalnum() else "-" for letter in name)


def exported(name: str, kept: Path) -> Exported:
    """Export a mission of `MISSIONS` into its folder and compile it."""
    folder = folder_of(name, kept)
    mission = prepare(Scenario().replace(**MISSIONS[name]))
    write_flight_code(mission, folder)
    made = coded(mission)
    return Exported(name, made, folder, CompiledStep(made, folder))
