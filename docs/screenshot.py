"""Take a picture of a replay for the pages, 1280 × 720, in a headless browser without a graphics card.

    python docs/screenshot.py out/mission/replay.html docs/figures/tutorial-replay.png --at 0.5 --press r

`--at` is the time to show, as a share of the flight; `--press` are keys (docs/flights-out.md), one after another.
"""

import argparse
import io
from pathlib import Path

from PIL import Image

from keepout.flights.pages.filmed import opened, seek


def screenshot(replay: Path, *, at: float, keys: list[str]) -> bytes:
    """Open a replay, show it at a share of its flight with some keys pressed, and give the picture as PNG."""
    with opened(replay) as page:
        seek(page, at)
        for key in keys:
            page.keyboard.press(key)
        page.wait_for_timeout(2000)  # at rest it is drawn finer
        taken = page.screenshot()
    picture = io.BytesIO()
    Image.open(io.BytesIO(taken)).convert("RGB").point(_coarser).save(picture, format="png", optimize=True)
    return picture.getvalue()


def _coarser(shade: int) -> int:
    """Round a shade of 0 to 255, so that the picture takes less room than one of all shades."""
    return min(255, 6 * round(shade / 6))


def main() -> None:
    """Take the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("page", type=Path)
    parser.add_argument("picture", type=Path)
    parser.add_argument("--at", type=float, default=0.5)
    parser.add_argument("--press", nargs="*", default=[])
    given = parser.parse_args()
    given.picture.write_bytes(screenshot(given.page, at=given.at, keys=given.press))


if __name__ == "__main__":
    main()
