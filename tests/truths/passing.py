"""A flight that nobody flew: a straight pass over the built-in box, whose clearance is known in closed form."""

import numpy as np

from keepout.core.geometry.target import Target
from keepout.core.guard.field import guard_field
from keepout.core.mission.scenario import Scenario
from truths.invented_flight import record_of

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
    half, moving = 0.5 * turning * time, np.tile([SPEED, 0.0, 0.0], (len(time), 1))
    chosen = {
        "position": np.array([START, 0.0, height]) + time[:, None] * moving,
        "velocity": moving,
        "attitude": np.column_stack([np.cos(half), 0.0 * half, 0.0 * half, np.sin(half)]),
        "safe_velocity": moving,
        "barrier": np.full(len(time), height - 1.6),
    }
    header = {"scenario": scenario.model_dump_json(), "target_sha256": Target.load("box").sha256}
    return record_of(header, time=time, **chosen | columns)


def pass_position(time, height):
    """Where the chaser of `pass_record` is."""
    return np.array([START + SPEED * time, 0.0, height])
