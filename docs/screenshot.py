"""Take a picture of a replay for the pages, 1280 × 720, in a headless browser without a graphics card.

    python docs/screenshot.py out/mission/replay.html docs/figures/tutorial-replay.png --at 0.5 --press r

`--at` is the time to show, as a share of the flight; `--press` are keys (docs/replay.md), one after another.
"""

import argparse
import io
import os
import shutil
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

SOFTWARE = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


def screenshot(page: Path, *, at: float, keys: list[str]) -> bytes:
    """Open a replay, show it at a share of its flight with some keys pressed, and give the picture as PNG."""
    chromium = os.environ.get("KEEPOUT_CHROMIUM") or shutil.which("chromium")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=SOFTWARE)
        opened = browser.new_page(viewport={"width": 1280, "height": 720})
        opened.goto(page.absolute().as_uri())
        opened.wait_for_selector("#replay[data-ready]", timeout=120_000)
        opened.evaluate("(share) => { const of = keepoutReplay.transport; of.seek(share * of.end); }", at)
        for key in keys:
            opened.keyboard.press(key)
        opened.wait_for_timeout(2000)  # at rest it is drawn finer
        taken = opened.screenshot()
        browser.close()
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
