"""A headless browser for pages: Debian's chromium, or the one that KEEPOUT_CHROMIUM names."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

SOFTWARE = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
"""Draws without a graphics card."""


def chromium() -> str | None:
    """The browser's path, if there is one."""
    return os.environ.get("KEEPOUT_CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser")


@contextmanager
def browsers() -> Iterator[Any]:
    """Give a function that starts the browser with some arguments; a test is skipped where there is no browser."""
    path = chromium()
    if path is None:
        pytest.skip("no chromium: install Debian's, or name one in KEEPOUT_CHROMIUM")
    playwright = pytest.importorskip("playwright.sync_api", reason="the test extra brings playwright")
    with playwright.sync_playwright() as running:
        yield lambda *arguments: running.chromium.launch(executable_path=path, args=list(arguments))
