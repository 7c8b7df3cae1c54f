"""How far pulses can be from the force asked for, and from the motion under it, as bounds: docs/my-thrusters.md.

A layout's forces are bounded by N = max ‖Σ F_g |d_g|‖ over the groups that fire together (`Allocation.active`):
whatever signs and sizes e_g ≤ e their errors have, ‖Σ e_g F_g d_g‖ ≤ e N.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from keepout.core.motion.thrusters.allocation import Allocation
from keepout.core.motion.thrusters.layout import Layout


@dataclass(frozen=True)
class ThrusterErrors:
    """What thrusters add to what a guard and an audit must assume; all zero for thrusters that hold any force.

    Attributes:
        force_error: bound on the norm of a constant force that, added to the force asked for, has the same effect on
            position and velocity at the end of a control period as the pulses' quantisation and delay have, N.
        running_error: bound on the norm of the impulse given less the one asked for, added up over all periods so far,
            beside what misalignment and scale add up to, N s; infinite where nothing is made up for.
        excursion: bound on the distance within a period between the path and that of the held mean force through either
            end of the period, m.
        velocity_excursion: the same of the velocities, m/s.
        gain_error: relative error of each axis' force that covers misalignment and scale, as the guard's `gain_error`
            counts it.
        fault_force: bound on the norm of the force that a stuck thruster adds or leaves out until it is known, N.
        fault_steps: control periods until it is known.

    """

    force_error: float = 0.0
    running_error: float = 0.0
    excursion: float = 0.0
    velocity_excursion: float = 0.0
    gain_error: float = 0.0
    fault_force: float = 0.0
    fault_steps: int = 0

    def times_gain(self, gain_error: float) -> "ThrusterErrors":
        """Give the errors of thrusters whose every force is wrong by a further factor of 1 ± `gain_error`.

        Whatever they give is scaled, what they give wrongly too: relative errors compound, all else grows.
        """
        most = 1.0 + gain_error
        return replace(
            self,
            force_error=most * self.force_error,
            running_error=most * self.running_error,
            excursion=most * self.excursion,
            velocity_excursion=most * self.velocity_excursion,
            gain_error=gain_error + self.gain_error + gain_error * self.gain_error,
            fault_force=most * self.fault_force,
        )


def thruster_errors(
    layout: Layout,
    *,
    force_limit: float,
    mass: float,
    period: float,
    delta_sigma: bool,
    detection_time: float | None = None,
) -> ThrusterErrors:
    """Bound the errors of a layout's pulses.

    With T the period, τ the least on-time, ρ the rise delay and e = (1 + ε) N, where ε bounds the relative error of a
    thruster's force as a vector: a pulse is wrong by at most τ/2, or τ where it makes up for earlier ones. A centred
    pulse that is on for the share p leaves the mean's motion by p(1−p) T/2 ≤ T/8 times its force over the mass in
    velocity, and by p(1−p) T²/8 ≤ T²/32 in position. A delay moves what is on by up to ρ at either end of the period:
    2ρ and 2ρT more, a mean wrong by 2ρ/T, and an end that is off by up to 1.5ρT in position, which is what a force of
    4 · 1.5ρ/T that changes its sign in the middle of the period does.

    Args:
        layout: the thrusters.
        force_limit: per body axis, N.
        mass: least mass of the chaser, kg.
        period: between control steps, s.
        delta_sigma: whether what a pulse gives too much or too little is made up for later.
        detection_time: after which a stuck thruster is known, s, where the guard is to cover one; else None.

    """
    allocations = [Allocation.of(layout)]
    if detection_time is not None:
        allocations += [Allocation.of(layout.without(i)) for i in range(layout.count)]
    directions = layout.groups()[1]
    strongest = max(_together(allocation, directions) for allocation in allocations)
    tilt = vector_error(layout)
    size = (1.0 + tilt) * strongest
    late = layout.rise_delay
    quantum = layout.least_on_time * (1.0 if delta_sigma else 0.5) / period
    all_on = np.linalg.norm(np.abs(directions).T @ np.asarray(allocations[0].largest))
    owed = (1.0 + tilt) * float(all_on) * 0.5 * layout.least_on_time
    return ThrusterErrors(
        force_error=size * (quantum + 8.0 * late / period),
        running_error=owed + 2.0 * size * late if delta_sigma else math.inf,
        excursion=size / mass * (period**2 / 32.0 + 3.5 * late * period),
        velocity_excursion=size / mass * (period / 8.0 + 2.0 * late),
        gain_error=tilt * _spent(allocations, force_limit, layout) / (math.sqrt(3.0) * force_limit),
        fault_force=0.0 if detection_time is None else (1.0 + layout.scale_error) * float(layout.force.max()),
        fault_steps=0 if detection_time is None else math.ceil(detection_time / period - 1e-9),
    )


def vector_error(layout: Layout) -> float:
    """Bound ‖g − f d‖/f: how far a thruster's force is from what it should be, as a vector, relative to its size."""
    scale = layout.scale_error
    return math.sqrt(scale**2 + 2.0 * (1.0 + scale) * (1.0 - math.cos(layout.misalignment)))


def _together(allocation: Allocation, directions: np.ndarray) -> float:
    """N of one allocation."""
    forces = np.abs(directions) * np.asarray(allocation.largest)[:, None]
    return float(np.linalg.norm(allocation.active().astype(float) @ forces, axis=1).max())


def _spent(allocations: Sequence[Allocation], force_limit: float, layout: Layout) -> float:
    """Bound Σ a_g, the thrust that is on for a force of the box, with a thruster stuck on and held against.

    It is convex in the force (the dual's largest value), so that it is largest at a corner of the box.
    """
    corners = force_limit * np.array(np.meshgrid(*[[1.0, -1.0]] * 3)).reshape(3, -1).T
    most = 0.0
    for number, allocation in enumerate(allocations):
        stuck = np.zeros((1, 3)) if number == 0 else np.stack([np.zeros(3), layout.pushes()[number - 1]])
        asked = (corners[:, None] - stuck[None]).reshape(-1, 3)
        value = np.max(asked @ np.asarray(allocation.price) - np.asarray(allocation.fee), axis=1)
        most = max(most, float(value.max()) + (0.0 if number == 0 else float(layout.force[number - 1])))
    return most
