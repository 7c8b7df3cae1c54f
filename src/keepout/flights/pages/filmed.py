"""A replay as a film, or as a row of pictures, taken from a browser without a window.

It needs Chromium, Chrome or Edge on the machine, and Playwright, which drives it; a film in MP4 needs PyAV too. The
extra `video` brings the last two. Frames are taken at times of the flight, not of the clock: a slow machine drops none.
"""

import io
import os
import shutil
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
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
_SETTLED = 600
"""Milliseconds after which a picture at rest is drawn finer where there is no graphics card."""


@dataclass(frozen=True)
class Film:
    """How a replay is filmed.

    Attributes:
        seconds: that the film lasts, whatever the flight lasts.
        rate: frames a second.
        size: width and height, pixels.
        pictures: in a row, where the file is a PNG.
        keys: pressed before, as in docs/flights-out.md.

    """

    seconds: float = 10.0
    rate: int = 12
    size: tuple[int, int] = (1280, 720)
    pictures: int = 5
    keys: Sequence[str] = ()


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
def opened(replay: Path, size: tuple[int, int] = (1280, 720)) -> Iterator[Any]:
    """Open a replay in a browser without a window, and give Playwright's page once it is drawn.

    Raises:
        ExchangeError: the browser does not start, or draws nothing.

    """
    from playwright.sync_api import Error, sync_playwright

    with sync_playwright() as playwright:
        try:
            browser = playwright.chromium.launch(executable_path=chromium(), args=list(SOFTWARE))
            page = browser.new_page(viewport={"width": size[0], "height": size[1]})
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


def film(replay: Path, out: Path, how: Film = Film(), *, progress: Progress = silent) -> Path:
    """Film a replay from its start to its end, or take a row of pictures of it.

    A flight that stays at its goal is followed for a tenth of its way longer.

    Args:
        replay: the page, as `write_replay` writes it.
        out: .mp4, .gif or .webp for a film, .png for pictures in a row.
        how: how long, how large.
        progress: told after each frame.

    Raises:
        UsageError: another ending.
        ExchangeError: a browser or a library is missing, or the file cannot be written.

    """
    require_film(out)
    with ThreadPoolExecutor(
        1
    ) as apart:  # as a notebook's thread has a loop of its own, in which Playwright does not run
        apart.submit(_film, replay, out, how, progress).result()
    progress(1.0, "")
    return out


def _film(replay: Path, out: Path, how: Film, progress: Progress) -> None:
    still = out.suffix.lower() == ".png"
    count = how.pictures if still else max(round(how.seconds * how.rate), 2)
    with opened(replay, how.size) as page:
        for key in how.keys:
            page.keyboard.press(key)
        page.evaluate("document.querySelector('.controls').open = false")
        frames = _frames(page, np.linspace(0.0, _last(page), count), progress, settle=_SETTLED if still else 0)
        {".mp4": _write_mp4, ".png": _write_row}.get(out.suffix.lower(), _write_moving)(out, frames, how)


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


def _write_mp4(out: Path, frames: "Iterator[Image]", how: Film) -> None:
    av: Any = import_module("av")
    stored = io.BytesIO()
    with av.open(stored, "w", format="mp4") as container:
        stream: Any = container.add_stream("libx264", rate=Fraction(how.rate), options={"crf": "20"})
        stream.width, stream.height = (side - side % 2 for side in how.size)  # as yuv420p wants them
        stream.pix_fmt = "yuv420p"
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_image(frame)))
        container.mux(stream.encode())
    write_whole(out, stored.getvalue(), refusal=ExchangeError)


def _write_moving(out: Path, frames: "Iterator[Image]", how: Film) -> None:
    stored, first = io.BytesIO(), next(frames)
    kind = out.suffix.lower().lstrip(".")
    first.save(stored, kind, save_all=True, append_images=frames, duration=round(1000 / how.rate), loop=0)
    write_whole(out, stored.getvalue(), refusal=ExchangeError)


def _write_row(out: Path, frames: "Iterator[Image]", how: Film) -> None:
    from PIL import Image

    width, height = how.size
    row = Image.new("RGB", (width * how.pictures, height))
    for place, frame in enumerate(frames):
        row.paste(frame, (place * width, 0))
    stored = io.BytesIO()
    row.save(stored, "png", optimize=True)
    write_whole(out, stored.getvalue(), refusal=ExchangeError)
