"""A headless browser for pages: Debian's chromium, or the one that KEEPOUT_CHROMIUM names."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from keepout.flights.pages.filmed import SOFTWARE, chromium


@contextmanager
def browsers() -> Iterator[Any]:
    """Give a function that starts the browser with some arguments; a test is skipped where there is no browser."""
    path = chromium()
    if path is None:
        pytest.skip("no chromium: install Debian's, or name one in KEEPOUT_CHROMIUM")
    playwright = pytest.importorskip("playwright.sync_api", reason="the test extra brings playwright")
    with playwright.sync_playwright() as running:
        yield lambda *arguments: running.chromium.launch(executable_path=path, args=list(arguments))


@contextmanager
def shown(path: Path) -> Iterator[Any]:
    """Open a replay from the disk at 1280 × 720; it may say nothing on the console."""
    with browsers() as start:
        browser = start(*SOFTWARE)
        page = browser.new_page(viewport={"width": 1280, "height": 720})
        said = []
        page.on("console", lambda message: said.append(message.text))
        page.on("pageerror", lambda error: said.append(str(error)))
        page.goto(path.as_uri())
        page.wait_for_selector("#replay[data-ready]", timeout=60_000)
        yield page
        assert said == []
        browser.close()


def slide(page: Any, time: float) -> None:
    """Move a replay to a time and wait for the next picture."""
    page.locator("input[type=range]").evaluate(
        "(of, time) => { of.value = time; of.dispatchEvent(new Event('input', {bubbles: true})) }", time
    )
    page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
