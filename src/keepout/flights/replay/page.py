"""The page of a replay: the scene, the viewer that comes with the package, and figures for where no script runs."""

import hashlib
import html
import json
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path

from keepout.core.whole_file import write_whole
from keepout.flights.replay.scene import Scene

_POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:"
"""What the page may fetch: nothing."""


def viewer(name: str) -> str:
    """Give a file of the bundled viewer: `replay.js`, `replay.css`, `manifest.json` or `LICENCES.txt`."""
    return (resources.files("keepout") / "data" / "replay" / name).read_text(encoding="utf-8")


def sha256(text: str) -> str:
    """Give the digest by which the viewer's manifest names a file."""
    return hashlib.sha256(text.encode()).hexdigest()


def write_page(path: Path, scene: Scene, *, title: str, words: Sequence[str], figures: Mapping[str, str]) -> None:
    """Write a replay as one file that opens from a disk without a network.

    Args:
        path: the HTML file.
        scene: what it shows.
        title: of the page, plain text.
        words: a paragraph each, plain text, shown with the figures.
        figures: what is shown where no script runs, and in print: by caption (plain text), an `img` or `svg` element.

    """
    told = json.dumps(scene.told | {"title": title}, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    paragraphs = "".join(f"<p>{html.escape(paragraph)}</p>" for paragraph in words)
    drawn = "".join(
        f"<figure>{element}<figcaption>{html.escape(caption)}</figcaption></figure>"
        for caption, element in figures.items()
    )
    libraries = json.loads(viewer("manifest.json"))["libraries"]
    licences = ", ".join(f"{entry['name']} {entry['version']} ({entry['licence']})" for entry in libraries)
    write_whole(
        path,
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<title>{html.escape(title)}</title><style>{viewer('replay.css')}</style>"
        "<noscript><style>#replay{display:none}#figures{display:block!important}</style></noscript></head><body>"
        '<main id="replay"></main>'
        f'<section id="figures"><h1>{html.escape(title)}</h1>{paragraphs}{drawn}'
        f"<p>Made by Keepout; the viewer holds {html.escape(licences)}.</p></section>"
        f'<script type="application/json" id="scene">{told}</script>'
        f'<script type="text/plain" id="content">{scene.content}</script>'
        f"<script>{viewer('replay.js')}</script></body></html>\n",
    )
