"""Motion of the chaser relative to the target: orbit, attitude, forces."""

from keepout.core.motion.actuator import Firing, ThrusterModel, Thrusters
from keepout.core.motion.attitude import AttitudeMotion, InertiallyFixed, Tumbling, VVLHFixed
from keepout.core.motion.chaser import Chaser
from keepout.core.motion.disturbance import (
    BandLimitedNoise,
    CombinedDisturbance,
    ConstantDisturbance,
    Disturbance,
    NoDisturbance,
    SinusoidalDisturbance,
    SquareWaveDisturbance,
    band_limited_noise,
    paper_disturbance,
    resonant,
    steady,
)
from keepout.core.motion.orbit import Orbit, OrbitalFrame
from keepout.core.motion.perturbation import J2, Drag, Perturbation
from keepout.core.motion.relative import MotionState, RelativeMotion
from keepout.core.motion.sun import SolarPressure

__all__ = [
    "J2",
    "AttitudeMotion",
    "BandLimitedNoise",
    "Chaser",
    "CombinedDisturbance",
    "ConstantDisturbance",
    "Disturbance",
    "Drag",
    "Firing",
    "InertiallyFixed",
    "MotionState",
    "NoDisturbance",
    "Orbit",
    "OrbitalFrame",
    "Perturbation",
    "RelativeMotion",
    "SinusoidalDisturbance",
    "SolarPressure",
    "SquareWaveDisturbance",
    "ThrusterModel",
    "Thrusters",
    "Tumbling",
    "VVLHFixed",
    "band_limited_noise",
    "paper_disturbance",
    "resonant",
    "steady",
]
