"""A replay as a film, or as a row of pictures, taken from a browser without a window.

It needs Chromium, Chrome or Edge on the machine, and Playwright, which drives it; a film in MP4 needs PyAV too. The
extra `video` brings the last two. Frames are taken at times of the flight, not of the clock: a slow machine drops none.
"""

import io
import os
import shutil
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from fractions import Fraction
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from keepout.core.errors import ExchangeError, UsageError
from keepout.core.progress import Progress, silent
from keepout.core.whole_file import require_place, write_whole

if TYPE_CHECKING:
    from PIL.Image import Image

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome", "microsoft-edge")
"""Commands that are looked for; `KEEPOUT_CHROMIUM` names another."""
SOFTWARE = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
"""Draws without a graphics card."""
ENDINGS = (".mp4", ".gif", ".webp", ".png")
SECONDS, RATE = 10.0, 12
"""That a film lasts, whatever the flight lasts, and its frames a second."""
SIZE = (1280, 720)
"""Width and height, pixels."""
PICTURES = 5
"""In a row, where the file is a PNG."""
_SETTLED = 600
"""Milliseconds after which a picture at rest is drawn finer where there is no graphics card."""


def chromium() -> str | None:
    """Give the path of a browser, if there is one."""
    return os.environ.get("KEEPOUT_CHROMIUM") or next(filter(None, map(shutil.which, BROWSERS)), None)


def require_film(out: Path) -> None:
    """Refuse what cannot be filmed to a file, before the work for it.

    Raises:
        UsageError: its name ends otherwise than a film's or a picture's.
        ExchangeError: a browser or a library is missing, or the file cannot be written.

    """
    if out.suffix.lower() not in ENDINGS:
        raise UsageError(f"{out}: a film or a row of pictures ends in {', '.join(ENDINGS)}")
    if chromium() is None:
        raise ExchangeError(
            f"{out}: no browser to film in (looked for {', '.join(BROWSERS)}); install Chromium, or name a browser of "
            "its kind in KEEPOUT_CHROMIUM"
        )
    for name, what in (("playwright", "Playwright"), ("av", "PyAV")):
        if find_spec(name) is None and (name == "playwright" or out.suffix.lower() == ".mp4"):
            raise ExchangeError(f"{out}: needs {what}; install it with pip install 'keepout-gnc[video]'")
    require_place(out, refusal=ExchangeError)


@contextmanager
def opened(replay: Path) -> Iterator[Any]:
    """Open a replay in a browser without a window, and give Playwright's page once it is drawn.

    Raises:
        ExchangeError: the browser does not start, or draws nothing.

    """
    from playwright.sync_api import Error, sync_playwright

    with sync_playwright() as playwright:
        try:
            browser = playwright.chromium.launch(executable_path=chromium(), args=list(SOFTWARE))
            page = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
            page.goto(replay.absolute().as_uri())
            page.wait_for_selector("#replay[data-ready]", timeout=120_000)
        except Error as error:
            raise ExchangeError(f"{replay}: {chromium()} shows nothing: {str(error).splitlines()[0]}") from None
        yield page
        browser.close()


def seek(page: Any, share: float) -> None:
    """Move a replay to a share of its flight, and wait until that is drawn."""
    page.evaluate("(share) => { const of = keepoutReplay.transport; of.seek(share * of.end); }", share)
    page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")


def film(replay: Path, out: Path, *, progress: Progress = silent) -> Path:
    """Film a replay from its start to its end, or take a row of pictures of it.

    A flight that stays at its goal is followed for a tenth of its way longer.

    Args:
        replay: the page, as `write_replay` writes it.
        out: .mp4, .gif or .webp for a film, .png for pictures in a row.
        progress: told after each frame.

    Raises:
        UsageError: another ending.
        ExchangeError: a browser or a library is missing, or the file cannot be written.

    """
    require_film(out)
    with ThreadPoolExecutor(1) as apart:  # Playwright does not run in a notebook's thread, which has a loop of its own
        apart.submit(_film, replay, out, progress).result()
    progress(1.0, "")
    return out


def _film(replay: Path, out: Path, progress: Progress) -> None:
    ending, stored = out.suffix.lower(), io.BytesIO()
    still = ending == ".png"
    count = PICTURES if still else max(round(SECONDS * RATE), 2)
    with opened(replay) as page:
        page.evaluate("document.querySelector('.controls').open = false")
        frames = _frames(page, np.linspace(0.0, _last(page), count), progress, settle=_SETTLED if still else 0)
        if still:
            _write_row(stored, frames)
        elif ending == ".mp4":
            _write_mp4(stored, frames)
        else:
            first, step = next(frames), round(1000 / RATE)
            first.save(stored, ending.lstrip("."), save_all=True, append_images=frames, duration=step, loop=0)
    write_whole(out, stored.getvalue(), refusal=ExchangeError)


def _last(page: Any) -> float:
    """Give the share of the flight that is filmed."""
    state = page.evaluate("keepoutReplay.state()")
    arrived = [mark["start"] for mark in state["marks"] if mark["kind"] == "reached" and mark["start"] > 0.0]
    return min([1.0, *(1.1 * time / state["end"] for time in arrived)])


def _frames(page: Any, shares: np.ndarray, progress: Progress, *, settle: int) -> "Iterator[Image]":
    from PIL import Image

    for number, share in enumerate(shares.tolist()):
        seek(page, share)
        page.wait_for_timeout(settle)
        yield Image.open(io.BytesIO(page.screenshot())).convert("RGB")
        progress((number + 1) / len(shares), f"frame {number + 1} of {len(shares)}")


def _write_mp4(stored: io.BytesIO, frames: "Iterator[Image]") -> None:
    av: Any = import_module("av")
    with av.open(stored, "w", format="mp4") as container:
        stream: Any = container.add_stream("libx264", rate=Fraction(RATE), options={"crf": "20"})
        stream.width, stream.height = (side - side % 2 for side in SIZE)  # as yuv420p wants them
        stream.pix_fmt = "yuv420p"
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_image(frame)))
        container.mux(stream.encode())


def _write_row(stored: io.BytesIO, frames: "Iterator[Image]") -> None:
    from PIL import Image

    width, height = SIZE
    row = Image.new("RGB", (width * PICTURES, height))
    for place, frame in enumerate(frames):
        row.paste(frame, (place * width, 0))
    row.save(stored, "png", optimize=True)
