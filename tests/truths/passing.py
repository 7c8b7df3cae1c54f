"""A flight that nobody flew: a straight pass over the built-in box, whose clearance is known in closed form."""

import numpy as np

from keepout.flight.record import FlightRecord
from keepout.geometry.target import Target
from keepout.guard.field import guard_field
from keepout.mission.scenario import Scenario

SPEED, STEPS, RADIUS = 0.05, 200, 0.5
START = -5.0


def box_scenario(folder, height, name, **changes):
    """A scenario around the box whose law flies by a field of its own file, a spline with a proved bound."""
    field = folder / "box.keepout"
    if not field.exists():
        guard_field(Target.load("box"), RADIUS).save(field)
    entries = {
        "target": {"source": "box"},
        "field": {"source": str(field)},
        "goal": {"position": (5.0, 0.0, height)},
        "chaser": {"radius": RADIUS},
        **changes,
    }
    return Scenario().replace(name=name, **entries)


def pass_record(scenario, height, *, turning=0.0, **columns):
    """A pass at a height, m, at constant speed; the body frame turns about z against VVLH, rad/s."""
    time = np.arange(STEPS + 1.0)
    rows = len(time)
    half = 0.5 * turning * time
    zeros = (
        *("angular_velocity", "estimated_position", "estimated_velocity", "commanded_force", "guarded_force"),
        *("force", "disturbance", "disturbance_estimate", "desired_velocity"),
    )
    chosen = {
        "position": np.column_stack([START + SPEED * time, np.zeros(rows), np.full(rows, height)]),
        "velocity": np.tile([SPEED, 0.0, 0.0], (rows, 1)),
        "attitude": np.column_stack([np.cos(half), np.zeros(rows), np.zeros(rows), np.sin(half)]),
        "safe_velocity": np.tile([SPEED, 0.0, 0.0], (rows, 1)),
        "barrier": np.full(rows, height - 1.6),
        **{name: np.zeros((rows, 3)) for name in zeros},
        **{name: np.zeros(rows) for name in ("backstepping_barrier", "lyapunov", "field_value")},
        **{name: np.zeros(rows, np.int32) for name in ("control_status", "guard_status")},
        "saturated": np.zeros(rows, bool),
        **columns,
    }
    header = {"scenario": scenario.model_dump_json(), "target_sha256": Target.load("box").sha256}
    return FlightRecord(header, time, **chosen)


def pass_position(time, height):
    """Where the chaser of `pass_record` is."""
    return np.array([START + SPEED * time, 0.0, height])
