"""All rivals, in the order of the table: each module offers its own tuple `RIVALS`."""

from rivals_laws import (
    barrier_program,
    convexified,
    envelopes,
    geodesic_only,
    keepout_default,
    nonlinear_mpc,
    potential_field,
    sampling_mpc,
)
from rivals_laws.rival import Rival

RIVALS: tuple[Rival, ...] = (
    *keepout_default.RIVALS,
    *envelopes.RIVALS,
    *barrier_program.RIVALS,
    *potential_field.RIVALS,
    *sampling_mpc.RIVALS,
    *geodesic_only.RIVALS,
    *convexified.RIVALS,
    *nonlinear_mpc.RIVALS,
)
