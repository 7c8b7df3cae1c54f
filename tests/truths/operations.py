"""The paper's chaser and its numbers, as laws are designed for them."""

import dataclasses

from keepout.core.control.profiles import Operation
from keepout.core.motion.chaser import Chaser
from keepout.core.motion.orbit import Orbit
from keepout.core.motion.relative import RelativeMotion

CHASER = Chaser(mass=20.0, radius=0.5, force_limit=0.1, speed_limit=0.1)


def operation(**changes):
    """Give the paper's operation; `changes` are entries of the chaser or of the operation."""
    body = {f.name for f in dataclasses.fields(Chaser)}
    chaser = dataclasses.replace(CHASER, **{name: value for name, value in changes.items() if name in body})
    numbers = {"motion": RelativeMotion(Orbit(42_164_000.0)), "error_bound": 0.05, "disturbance_bound": 0.0142}
    return Operation(chaser=chaser, **numbers | {n: v for n, v in changes.items() if n not in body})
