"""What a page and a picture hold, read back without the code that wrote them."""

import base64
import html.parser
import json
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import matplotlib.image
import numpy as np


@dataclass
class Page(html.parser.HTMLParser):
    """An HTML page as it was parsed.

    table: the rows of the only table, headings first. images: the bytes of every picture, by its alternative text.
    outside: addresses that the page would fetch. unclosed: elements left open. scripts: the text of each.
    """

    table: list[list[str]] = field(default_factory=list)
    images: dict[str, bytes] = field(default_factory=dict)
    outside: list[str] = field(default_factory=list)
    scripts: list[str] = field(default_factory=list)
    headings: list[str] = field(default_factory=list)
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
        elif tag == "script":
            self.scripts.append("")
        elif tag in ("h1", "h2"):
            self.headings.append("")
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
        within = self.unclosed[-1] if self.unclosed else ""
        if within in ("td", "th"):
            self.table[-1][-1] += data
        elif within == "script":
            self.scripts[-1] += data
        elif within in ("h1", "h2"):
            self.headings[-1] += data

    @property
    def replay(self) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
        """Traces and frames of the replay."""
        [script] = [text for text in self.scripts if "Plotly.addFrames(" in text]
        traces = _first_list(script[script.rindex("Plotly.newPlot(") :])
        return traces, _first_list(script[script.rindex("Plotly.addFrames(") :])


def _first_list(text: str) -> list[dict[str, Any]]:
    return json.JSONDecoder().raw_decode(text, re.search(r",\s*(?=\[)", text).end())[0]


def numbers(values: Any) -> np.ndarray:
    """The array that a Plotly trace holds, as plain JSON or as its typed bytes."""
    if not isinstance(values, dict):
        return np.asarray(values)
    kind = {"f8": np.float64, "f4": np.float32, "i1": np.int8, "u1": np.uint8, "i2": np.int16, "u2": np.uint16}
    kind |= {"i4": np.int32, "u4": np.uint32}
    return np.frombuffer(base64.b64decode(values["bdata"]), kind[values["dtype"]])


def check_picture(path: Path, *, least: int = 300) -> None:
    """A PNG of sensible size that shows more than one colour, and not almost only its background."""
    picture = matplotlib.image.imread(path)
    height, width = picture.shape[:2]
    assert least <= min(height, width)
    assert max(height, width) <= 4000
    shades = np.round(picture[..., :3] * 15).astype(int) @ [256, 16, 1]
    colours, counts = np.unique(shades, return_counts=True)
    assert len(colours) > 10
    assert counts.max() < 0.995 * height * width
