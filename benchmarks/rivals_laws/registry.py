"""All rivals, in the order of the table."""

from rivals_laws import geodesic_only, keepout_default
from rivals_laws.rival import Rival

RIVALS: tuple[Rival, ...] = (
    *keepout_default.RIVALS,
    *geodesic_only.RIVALS,
)
"""Each module offers its own tuple `RIVALS`."""
