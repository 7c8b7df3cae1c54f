"""What a flight is made of: the motion, what disturbs it, and the layers that steer it."""

import dataclasses
import math

import equinox as eqx
import jax
from jax.core import Tracer
from jaxtyping import PRNGKeyArray, PyTree

from keepout.core.control.law import Law
from keepout.core.errors import ScenarioError
from keepout.core.fields.field import Field
from keepout.core.flight.navigation import Navigation
from keepout.core.guard.safety_layer import SafetyLayer
from keepout.core.motion.arrays import Scalar, Vector, as_float64, numbers_as_arrays
from keepout.core.motion.chaser import ThrusterModel
from keepout.core.motion.disturbance import Disturbance
from keepout.core.motion.relative import MotionState, RelativeMotion


class Faults(eqx.Module):
    """What stands between truth and control law: sensor errors, delays, broken thrusters.

    A fault's memory (delay lines, random keys) is a pytree that every method takes and gives back. What a fault does
    not override it leaves alone.
    """

    def initial_state(self, key: PRNGKeyArray) -> PyTree:
        """Make the memory that a flight starts with; by default none.

        Args:
            key: for what is random in the faults.

        """
        return ()

    def estimate(self, fault_state: PyTree, true_state: MotionState) -> tuple[PyTree, MotionState]:
        """Say what the control law is told about the true state; by default the truth.

        Args:
            fault_state: the memory.
            true_state: of the motion, body frame, m and m/s.

        Returns:
            The memory, and the estimate (m, m/s, body frame).

        """
        return fault_state, true_state

    def command(self, fault_state: PyTree, force: Vector, time: Scalar) -> tuple[PyTree, Vector]:
        """Say what force (N, body axes) reaches the thrusters when `force` is commanded now; by default that.

        Args:
            fault_state: the memory.
            force: commanded, (3,) N, body axes.
            time: s since the epoch.

        Returns:
            The memory, and the force, (3,) N.

        """
        return fault_state, force

    def actuate(self, fault_state: PyTree, force: Vector, time: Scalar) -> tuple[PyTree, Vector]:
        """Say what the thrusters give when told to give `force` (already within their limits), N, body axes.

        Args:
            fault_state: the memory.
            force: (3,) N, body axes.
            time: s since the epoch.

        Returns:
            The memory, and the force that is given, (3,) N.

        """
        return fault_state, force


class NoFaults(Faults):
    """A flight where nothing fails."""


class FlightSetup(eqx.Module):
    """Everything about a flight but its initial state, its length and its random key.

    Attributes:
        motion: the true motion.
        disturbance: the force that nobody commanded.
        thrusters: the true ones.
        controller: the control law.
        goal: (3,) m, body axes.
        mass: the true one, kg.
        period: control period, s.
        guard: the layer between law and thrusters, or None. Its numbers become arrays, so that flights whose numbers
            differ share a compiled program.
        faults: what stands between truth and law.
        field: logged along the true path where given.
        tolerance: m; a flight has reached its goal when it stays closer than this until its end.
        navigation: what is known of the motion; None where law and guard are told the state that `faults` leave.

    Raises:
        ScenarioError: a mass, period or tolerance that is not positive and finite, or a disturbance that jumps more
            often in a step than it says.

    """

    motion: RelativeMotion
    disturbance: Disturbance
    thrusters: ThrusterModel
    controller: Law
    goal: Vector = eqx.field(converter=as_float64)
    mass: Scalar = eqx.field(converter=as_float64)
    period: Scalar = eqx.field(converter=as_float64, default=1.0)
    guard: SafetyLayer | None = eqx.field(converter=numbers_as_arrays, default=None)
    faults: Faults = eqx.field(default_factory=NoFaults)
    field: Field | None = None
    tolerance: Scalar = eqx.field(converter=as_float64, default=0.1)
    navigation: Navigation | None = None

    def __check_init__(self):
        for name, unit in (("mass", "kg"), ("period", "s"), ("tolerance", "m")):
            value = getattr(self, name)
            if not isinstance(value, Tracer) and not (math.isfinite(value) and float(value) > 0):
                raise ScenarioError(f"{name}: {float(value):g} {unit}; it must be positive and finite")
        if any(isinstance(value, Tracer) for value in jax.tree.leaves((self.disturbance, self.period))):
            return  # values are not known yet inside a transformation
        stretch, longest = float(self.period) / self.motion.substeps, self.disturbance.longest_stretch
        if stretch > longest * (1 + 1e-9):
            raise ScenarioError(
                f"disturbance: it changes sign too often for a step of {stretch:g} s, which must be at most "
                f"{longest:g} s; give it a longer period or more `most_switches`, or take more substeps"
            )


def flown_setup(setup: FlightSetup) -> FlightSetup:
    """Give a setup without what flying it does not need and no two laws share (`Law.flown`)."""
    return dataclasses.replace(setup, controller=setup.controller.flown())
