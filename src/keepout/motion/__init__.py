"""Motion of the chaser relative to the target: orbit, attitude, forces."""

from keepout.motion.actuator import Firing, ThrusterModel, Thrusters
from keepout.motion.attitude import AttitudeMotion, InertiallyFixed, Tumbling, VVLHFixed
from keepout.motion.chaser import Chaser
from keepout.motion.disturbance import (
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
from keepout.motion.orbit import Orbit, OrbitalFrame
from keepout.motion.perturbation import J2, Drag, Perturbation
from keepout.motion.relative import MotionState, RelativeMotion
from keepout.motion.sun import SolarPressure

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
