"""How the Earth is turned against inertial axes, well enough to draw: what CZML needs for an orientation.

The Earth rotation angle and the precession of the pole of the IAU 2000/2006 conventions (IERS Conventions 2010,
chapter 5). Nutation, polar motion and UT1 − UTC are left out: less than 40 arc seconds together.
"""

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

_J2000 = 946_728_000_000_000_000
"""2000-01-01T12:00, ns since 1970."""
_DAY = 86_400 * 1_000_000_000
_ARC_SECOND = np.pi / 648_000.0


def earth_from_inertial(epochs: Int[np.ndarray, "n"]) -> Float[np.ndarray, "n 3 3"]:
    """Give the rotations Earth-fixed ← EME2000 at UTC instants (ns since 1970)."""
    since = epochs - _J2000
    # Whole days are no turns of the angle's first term: taken off before floating point.
    turns = 0.7790572732640 + (since % _DAY) / _DAY + 0.00273781191135448 * (since / _DAY)
    centuries = since / _DAY / 36525.0
    x = (2004.191898 * centuries - 0.4297829 * centuries**2) * _ARC_SECOND
    y = (-0.006951 - 0.025896 * centuries - 22.4072747 * centuries**2) * _ARC_SECOND
    # The rotation that takes the pole (X, Y, Z) to z by the shortest way, and then the Earth's own turn.
    pole = np.stack([x, y, np.sqrt(1.0 - x**2 - y**2)], axis=1)
    a = 1.0 / (1.0 + pole[:, 2])
    to_pole = np.stack(
        [
            np.stack([1.0 - a * x * x, -a * x * y, -x], axis=1),
            np.stack([-a * x * y, 1.0 - a * y * y, -y], axis=1),
            pole,
        ],
        axis=1,
    )
    return Rotation.from_rotvec(np.multiply.outer(-2.0 * np.pi * turns, [0.0, 0.0, 1.0])).as_matrix() @ to_pole
