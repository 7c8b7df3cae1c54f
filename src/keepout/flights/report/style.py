"""One look for every figure: colours that survive print and colour blindness, quiet axes."""

import io
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import matplotlib
from cycler import cycler

matplotlib.use("Agg")  # figures go to files; no display is needed or opened

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from keepout.core.whole_file import write_whole

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Okabe and Ito's palette, distinguishable by colour-blind readers."""

TARGET_COLOUR = "#9aa3ad"


_ONE_AT_A_TIME = threading.RLock()
"""Matplotlib's settings and its list of figures are of the whole process."""


@contextmanager
def style() -> Iterator[None]:
    """Set the common style for what is drawn within the block, by one thread at a time."""
    with (
        _ONE_AT_A_TIME,
        plt.rc_context(
            {
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
        ),
    ):
        yield


@contextmanager
def figure(path: Path, *, width: float = 8.0, height: float = 4.5, vector: bool = False) -> Iterator[Figure]:
    """Make a figure in the common style and save it to `path` when the block ends.

    Args:
        path: the image file to write (PNG).
        width: inches.
        height: inches.
        vector: also write the same as SVG beside it, with text as text.

    """
    with style():
        drawing = plt.figure(figsize=(width, height), layout="constrained")
        try:
            yield drawing
            engine = drawing.get_layout_engine()
            if engine is not None:  # saving would draw everything once more, unseen, for each file
                engine.execute(drawing)
                drawing.set_layout_engine(None)
            for form in ("png", "svg") if vector else ("png",):
                image = io.BytesIO()
                drawing.savefig(image, format=form, metadata={"Date": None} if form == "svg" else None)
                write_whole(path.with_suffix(f".{form}"), image.getvalue())
        finally:
            plt.close(drawing)
