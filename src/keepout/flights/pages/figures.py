"""One look for every figure: colours that survive print and colour blindness, quiet axes."""

import io
import threading
from collections.abc import Callable, Iterator
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
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator

from keepout.core.whole_file import write_whole
from keepout.flights.pages.page import Markup, embedded

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
_BINS = 300
"""Across a panel: more cannot be told apart. What has more than twice as many samples is drawn as a band."""
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
def figure(path: Path, *, width: float = 8.0, height: float = 4.5, printed: bool = False) -> Iterator[Figure]:
    """Make a figure in the common style and save it to `path` when the block ends.

    Args:
        path: the image file to write (PNG).
        width: inches.
        height: inches.
        printed: in small text, and written as SVG beside it too, with text as text.

    """
    with drawn(width=width, height=height, small=printed) as drawing:
        yield drawing
        engine = drawing.get_layout_engine()
        if engine is not None:  # saving would draw everything once more, unseen, for each file
            engine.execute(drawing)
            drawing.set_layout_engine(None)
        for form in ("png", "svg") if printed else ("png",):
            content = image(drawing, form, metadata={"Date": None} if form == "svg" else None)
            write_whole(path.with_suffix(f".{form}"), content)


def image(drawing: Figure, form: str = "png", **how: Any) -> bytes:
    """Give the content of a file of a figure, "png", "svg" or "pdf"."""
    stream = io.BytesIO()
    drawing.savefig(stream, format=form, **how)
    return stream.getvalue()


def picture(paint: Callable[[Figure], Any], words: str, *, height: float = 5.0) -> Markup:
    """Give what `paint` draws (height in inches) as an element that holds it, with words for who cannot see it."""
    with drawn(width=8.0, height=height) as drawing:
        paint(drawing)
        return embedded(image(drawing, dpi=100), words)


def column(path: Path, height: float, *, width: float = COLUMN) -> AbstractContextManager[Figure]:
    """Make a figure for print, one column wide if not said otherwise (inches), as PNG and SVG."""
    return figure(path, width=width, height=height, printed=True)


def looks(count: int, *, printed: bool = False) -> list[dict[str, Any]]:
    """Give so many looks, all different: colours first, then other lines; `printed`: both change, for print in grey.

    There are 35; the 36th is the first again.
    """
    turns = (place if printed else place // len(COLOURS) for place in range(count))
    lines = [LINES[turn % len(LINES)] for turn in turns]
    return [{"color": COLOURS[place % len(COLOURS)], "linestyle": line} for place, line in enumerate(lines)]


def draw_signal(axes: Axes, time: np.ndarray, values: np.ndarray, *, label: str | None = None, **look: Any) -> None:
    """Draw a quantity over time; one of many samples as the band from its least to its largest, with its mean within.

    Args:
        axes: the panel.
        time: s.
        values: one a time; those that are not finite are left out.
        label: in the legend.
        **look: of the line.

    """
    look = {"linewidth": 0.9} | look
    if len(time) <= 2 * _BINS:
        axes.plot(time, values, label=label, **look)
        return
    first = np.linspace(0, len(time), _BINS, endpoint=False).astype(int)
    values = np.where(np.isfinite(values), values, np.nan)
    low, high = np.fmin.reduceat(values, first), np.fmax.reduceat(values, first)
    known = np.isfinite(values)
    with np.errstate(invalid="ignore"):
        mean = np.add.reduceat(np.where(known, values, 0.0), first) / np.add.reduceat(known.astype(float), first)
    middle = 0.5 * (time[first] + time[np.append(first[1:], len(time)) - 1])
    axes.fill_between(middle, low, high, color=look["color"], alpha=0.25, linewidth=0.0)
    axes.plot(middle, mean, label=label, **look)


def logarithmic(axes: Axes, which: str = "y", *, ticks: int = 6, least: float = 0.0) -> None:
    """Make an axis that has been drawn on logarithmic, with so many labels at most, none over another.

    Where all that is drawn is within a tenth of itself, it stays linear: powers of ten would say nothing of it. The
    axis begins at `least` at the lowest.
    """
    axis, limit = getattr(axes, f"{which}axis"), getattr(axes, f"set_{which}lim")
    low, high = (float(end) for end in getattr(axes.dataLim, f"interval{which}"))
    axis.set_major_formatter(lambda value, _: f"{value:g}")
    if 0.0 < low <= high <= 1.1 * low:
        axis.set_major_locator(MaxNLocator(3))
        limit(0.9 * low, 1.1 * high)
        return
    getattr(axes, f"set_{which}scale")("log")
    low, high = (float(end) for end in axis.get_view_interval())
    low = max(low, least) if least < high else low
    limit(low, high)
    decades = np.log10(high / low) if 0.0 < low < high else np.inf
    # Formulas for powers of ten, and ticks between them, would take as long as all the rest of the figure.
    powers = LogLocator(subs=(1, 2, 5) if decades < 2.0 else (1,), numticks=ticks)
    axis.set_major_locator(MaxNLocator(ticks - 1) if decades < 1.0 else powers)
    axis.set_major_formatter(lambda value, _: f"{value:g}")
    axis.set_minor_locator(NullLocator())


def draw_bands(axes: Axes, time: np.ndarray, quantiles: np.ndarray) -> None:
    """Draw the quantiles of `BANDS` over time, as bands around the median."""
    lowest, low, middle, high, highest = quantiles
    axes.fill_between(time, lowest, highest, color=COLOURS[5], alpha=0.35, linewidth=0, label="5 to 95 %")
    axes.fill_between(time, low, high, color=COLOURS[0], alpha=0.45, linewidth=0, label="25 to 75 %")
    axes.plot(time, middle, color=COLOURS[0], linewidth=1.2, label="median", zorder=3)
