"""Which numbers a field may hold: those for which what is proved of it is about what is evaluated."""

import dataclasses
import itertools

import numpy as np

from keepout.core.errors import FieldError
from keepout.core.fields.continuation import RadialContinuation
from keepout.core.fields.field import Field
from keepout.core.fields.grid import STORED, GridField
from keepout.core.fields.neural import NeuralField

NETWORK_TYPES = ("float32", "float64")
"""Float types of a network: the certificate knows the rounding of these alone."""


def require_admissible(field: Field) -> None:
    """Refuse a neural or grid field that cannot be what a certificate speaks of.

    Raises:
        FieldError: a network or a grid of another float type; a number that is not finite; radii out of order; a
            negative allowance; blocks that the coefficients do not have.

    """
    if isinstance(field, NeuralField):
        _require_continuation(field.continuation)
        _require_network(field)
    elif isinstance(field, GridField):
        _require_continuation(field.continuation)
        _require_grid(field)


def _require_continuation(continuation: RadialContinuation) -> None:
    for entry in dataclasses.fields(continuation):
        array = np.asarray(getattr(continuation, entry.name))
        # Squares of float16 radii overflow: then nothing is outside, and the field is asked where it was never made.
        if array.dtype != np.float64:
            raise FieldError(f"continuation.{entry.name} is {array.dtype.name}; it must be float64")
        _require_finite(f"continuation.{entry.name}", array)
    allowance = float(continuation.allowance)
    if not allowance >= 0.0:
        raise FieldError(f"continuation.allowance is {allowance:g} m; it must be at least 0: it may only lower values")
    names = ("target_radius", "domain_radius", "outer_radius")
    radii = [float(getattr(continuation, name)) for name in names]
    if not 0.0 < radii[0] < radii[1] < radii[2]:
        told = ", ".join(f"{name} {radius:g} m" for name, radius in zip(names, radii))
        raise FieldError(f"continuation: {told}; each must be above the one before, and the first above 0")


def _require_network(field: NeuralField) -> None:
    layers = field.layers
    arrays = {
        f"{kind}{i}": np.asarray(array)
        for kind, group in (("W", layers.weights), ("b", layers.biases))
        for i, array in enumerate(group)
    }
    for name, array in arrays.items():
        if array.dtype.name not in NETWORK_TYPES:
            raise FieldError(f"network: {name} is {array.dtype.name}; a network must be float32 or float64")
    if len({array.dtype for array in arrays.values()}) > 1:
        told = ", ".join(f"{name} {array.dtype.name}" for name, array in arrays.items())
        raise FieldError(f"network: {told}; all must be of one type, float32 or float64")
    for name, array in arrays.items():
        _require_finite(f"network: {name}", array)
    for name, value in (("scale", float(field.scale)), ("beta", field.beta)):
        if not (np.isfinite(value) and value > 0.0):
            raise FieldError(f"network: {name} is {value:g}; it must be finite and above 0")
    domain = field.continuation
    least, most = 1e-3 * float(domain.domain_radius), 1e3 * float(domain.outer_radius)
    if not least <= float(field.scale) <= most:
        # The proof's first cubes are a share of the scale: a tiny one would never end, a huge one never begin.
        raise FieldError(
            f"network: scale is {float(field.scale):g} m; in its domain it must be {least:g} to {most:g} m"
        )
    held = np.finfo(layers.weights[0].dtype)
    if not float(held.tiny) <= field.beta <= float(held.max):
        raise FieldError(f"network: beta is {field.beta:g}; a {held.dtype} holds {held.tiny:g} to {held.max:g} in full")


def _require_grid(field: GridField) -> None:
    coefficients = np.asarray(field.coefficients)
    if coefficients.dtype != np.float32 or len(coefficients) % STORED**3:
        raise FieldError(
            f"grid: coefficients are {len(coefficients)} of {coefficients.dtype.name}; "
            f"they must be float32, {STORED**3} a block"
        )
    _require_finite("grid: coefficients", coefficients)
    _require_finite("grid: origin", np.asarray(field.origin))
    spacing = float(field.spacing)
    if not (np.isfinite(spacing) and spacing > 0.0):
        raise FieldError(f"grid: spacing is {spacing:g} m; it must be finite and above 0")
    blocks = len(coefficients) // STORED**3
    tables = [np.asarray(table) for table in field.tables]
    for level, table in enumerate(tables):
        if not np.issubdtype(table.dtype, np.integer) or table.min() < -1 or table.max() >= blocks:
            raise FieldError(
                f"grid: table{level} holds {table.dtype.name} from {table.min()} to {table.max()}; "
                f"they must be integers from -1 to {blocks - 1}"
            )
    for level, (fine, coarse) in enumerate(itertools.pairwise(tables)):
        if fine.shape != tuple(2 * n for n in coarse.shape):
            raise FieldError(
                f"grid: table{level} has {fine.shape} blocks, table{level + 1} {coarse.shape}; each must be half the "
                "one before"
            )


def _require_finite(name: str, array: np.ndarray) -> None:
    bad = array[~np.isfinite(array)]
    if len(bad):
        raise FieldError(f"{name}: {len(bad)} of {array.size} numbers are not finite, the first {bad[0]}; all must be")
