"""Least and greatest values of an image in squares of pixels, by which a window of any size costs a few look-ups."""

import numpy as np
from jaxtyping import Float


def pyramid(image: Float[np.ndarray, "rows columns"], *, greatest: bool = False) -> Float[np.ndarray, "k rows columns"]:
    """Give at [k, i, j] the least value in the square of 2^k pixels from pixel (i, j) on; the greatest, where asked."""
    levels = [image]
    side = 1
    pick = np.maximum if greatest else np.minimum
    while 2 * side <= min(image.shape):
        below = levels[-1]
        level = below.copy()
        level[:-side] = pick(level[:-side], below[side:])
        across = level.copy()
        level[:, :-side] = pick(level[:, :-side], across[:, side:])
        levels.append(level)
        side *= 2
    return np.stack(levels)
