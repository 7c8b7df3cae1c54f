"""What a page and a picture hold, read back without the code that wrote them."""

import base64
import html.parser
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import matplotlib.image
import numpy as np


@dataclass
class Page(html.parser.HTMLParser):
    """An HTML page as it was parsed.

    table: the rows of the only table, headings first. images: the bytes of every picture, by its alternative text.
    outside: addresses that the page links to or would fetch. unclosed: elements left open.
    """

    table: list[list[str]] = field(default_factory=list)
    images: dict[str, bytes] = field(default_factory=dict)
    outside: list[str] = field(default_factory=list)
    unclosed: list[str] = field(default_factory=list)

    def __post_init__(self):
        super().__init__()

    def __hash__(self):
        return id(self)

    @classmethod
    def read(cls, path: Path) -> "Page":
        page = cls()
        page.feed(path.read_text(encoding="utf-8"))
        page.close()
        return page

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        if tag not in ("meta", "img", "br", "link"):
            self.unclosed.append(tag)
        if tag == "tr":
            self.table.append([])
        elif tag in ("td", "th"):
            self.table[-1].append("")
        for name in ("src", "href"):
            address = given.get(name)
            if address is None:
                continue
            if tag == "img" and address.startswith("data:image/png;base64,"):
                self.images[given["alt"]] = base64.b64decode(address.split(",", 1)[1], validate=True)
            else:
                self.outside.append(address)

    def handle_endtag(self, tag):
        assert self.unclosed
        assert self.unclosed.pop() == tag

    def handle_data(self, data):
        if self.unclosed and self.unclosed[-1] in ("td", "th"):
            self.table[-1][-1] += data


def check_picture(path: Path) -> None:
    """A PNG of sensible size that shows more than one colour, and not almost only its background."""
    picture = matplotlib.image.imread(path)
    height, width = picture.shape[:2]
    assert 300 <= min(height, width) <= max(height, width) <= 4000
    shades = np.round(picture[..., :3] * 15).astype(int) @ [256, 16, 1]
    colours, counts = np.unique(shades, return_counts=True)
    assert len(colours) > 10
    assert counts.max() < 0.995 * height * width


def check_folder(folder: Path, summary: dict[str, Any], stems: Iterable[str]) -> str:
    """The pictures that there are to see, each in the page and showing something, and a replay; nothing evil in it."""
    assert summary["pictures"] == [str(folder / f"{stem}.png") for stem in stems]
    for path in summary["pictures"]:
        assert matplotlib.image.imread(path)[..., :3].std() > 0.02
    page = (folder / "index.html").read_text()
    assert page.count("data:image/png") == len(summary["pictures"])
    assert "<script>" not in page
    assert "<b>broken" not in page
    assert 'src="replay.html"' in page
    assert (folder / "replay.html").stat().st_size < 4_000_000
    return page
