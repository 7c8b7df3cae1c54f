"""One look for every figure: colours that survive print and colour blindness, quiet axes."""

import io
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from cycler import cycler

matplotlib.use("Agg")  # figures go to files; no display is needed or opened

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from keepout.core.whole_file import write_whole

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Okabe and Ito's palette, distinguishable by colour-blind readers."""
TARGET_COLOUR = "#9aa3ad"
LINES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1)))
"""Of what is told apart in print without colours."""
COLUMN = 3.5
"""Width of a printed column, inches."""
BANDS = (0.05, 0.25, 0.5, 0.75, 0.95)
"""Quantiles that `draw_bands` shows."""
_LOOK: Any = {
    "axes.grid": True,
    "grid.alpha": 0.3,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.prop_cycle": cycler(color=COLOURS),
    "font.size": 9,
    "legend.frameon": False,
    "figure.dpi": 150,
    "savefig.dpi": "figure",
    "svg.fonttype": "none",
    "svg.hashsalt": "keepout",
}
_SMALL: Any = {
    **{f"axes.{name}size": 8 for name in ("label", "title")},
    **{f"{name}size": 7 for name in ("xtick.label", "ytick.label", "legend.font")},
}
_ONE_AT_A_TIME = threading.RLock()
"""Matplotlib's settings and its list of figures are of the whole process."""


@contextmanager
def drawn(*, width: float, height: float, small: bool = False) -> Iterator[Figure]:
    """Make a figure in the common style, by one thread at a time; sizes in inches, `small`: in small text."""
    with _ONE_AT_A_TIME, plt.rc_context(_LOOK | _SMALL if small else _LOOK):
        drawing = plt.figure(figsize=(width, height), layout="constrained")
        try:
            yield drawing
        finally:
            plt.close(drawing)


@contextmanager
def figure(
    path: Path, *, width: float = 8.0, height: float = 4.5, vector: bool = False, small: bool = False
) -> Iterator[Figure]:
    """Make a figure in the common style and save it to `path` when the block ends.

    Args:
        path: the image file to write (PNG).
        width: inches.
        height: inches.
        vector: also write the same as SVG beside it, with text as text.
        small: in small text.

    """
    with drawn(width=width, height=height, small=small) as drawing:
        yield drawing
        engine = drawing.get_layout_engine()
        if engine is not None:  # saving would draw everything once more, unseen, for each file
            engine.execute(drawing)
            drawing.set_layout_engine(None)
        for form in ("png", "svg") if vector else ("png",):
            image = io.BytesIO()
            drawing.savefig(image, format=form, metadata={"Date": None} if form == "svg" else None)
            write_whole(path.with_suffix(f".{form}"), image.getvalue())


def column(path: Path, height: float, *, width: float = COLUMN) -> AbstractContextManager[Figure]:
    """Make a figure for print, one column wide if not said otherwise (inches), as PNG and SVG."""
    return figure(path, width=width, height=height, vector=True, small=True)


def palette(count: int) -> list[str]:
    """Give that many colours in order; after the last the first comes again."""
    return [COLOURS[place % len(COLOURS)] for place in range(count)]


def draw_bands(axes: Axes, time: np.ndarray, quantiles: np.ndarray) -> None:
    """Draw the quantiles of `BANDS` over time, as bands around the median."""
    lowest, low, middle, high, highest = quantiles
    axes.fill_between(time, lowest, highest, color=COLOURS[5], alpha=0.35, linewidth=0, label="5 to 95 %")
    axes.fill_between(time, low, high, color=COLOURS[0], alpha=0.45, linewidth=0, label="25 to 75 %")
    axes.plot(time, middle, color=COLOURS[0], linewidth=1.2, label="median", zorder=3)
