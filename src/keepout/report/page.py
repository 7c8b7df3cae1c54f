"""One HTML page that holds everything: a turnable replay, the table and the figures. It needs no network to open."""

import base64
import functools
import html
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import plotly.io
from jaxtyping import Float, Int

from keepout.flight.record import FlightRecord
from keepout.geometry.target import Target
from keepout.mission.flight import Flight
from keepout.report.style import COLOURS, TARGET_COLOUR
from keepout.report.terminal import FLIGHT_COLUMNS, broken_assumptions, shown
from keepout.whole_file import write_whole

_FRAMES = 150
_WALL = {
    "backgroundcolor": "#E5ECF6",
    "gridcolor": "white",
    "gridwidth": 2,
    "linecolor": "white",
    "showbackground": True,
    "ticks": "",
    "zerolinecolor": "white",
}
"""Look of the walls behind a replay."""
STYLE = """
body{font:15px/1.5 system-ui,sans-serif;max-width:1100px;margin:2em auto;padding:0 1em;color:#1c2430}
table{border-collapse:collapse;margin:1em 0}th,td{border-bottom:1px solid #d5dae0;padding:.35em .8em;text-align:right}
th:first-child,td:first-child{text-align:left}img{max-width:100%}.bad{color:#b00020;font-weight:600}
.wide{overflow-x:auto}.wide td,.wide th{white-space:nowrap}
code.line{display:block;white-space:pre;overflow-x:auto;user-select:all;background:#f3f5f7}
code.line{padding:.35em .6em;margin:.3em 0}
"""


def write_page(
    path: Path,
    *,
    title: str,
    introduction: str,
    summaries: Sequence[Mapping[str, Any]],
    flights: Mapping[str, Flight],
    figures: Sequence[Path],
) -> None:
    """Write a self-contained page with a replay of the flights around the target's mesh.

    Args:
        path: the HTML file to write.
        title: heading.
        introduction: what was flown and what the table says, plain text.
        summaries: one row a flight, as `fly` reports it.
        flights: to replay, by name; all around the same target.
        figures: PNG files to embed, in order.

    """
    images = "\n".join(
        f'<p><img alt="{html.escape(image.stem)}" src="data:image/png;base64,{_base64(image)}"></p>'
        for image in figures
    )
    write_whole(
        path,
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{html.escape(title)}</title>'
        f"<style>{STYLE}</style><h1>{html.escape(title)}</h1><p>{html.escape(introduction)}</p>"
        f"{_table(summaries)}<h2>Replay</h2>{replay(flights)}<h2>Figures</h2>{images}</html>",
    )


def replay(flights: Mapping[str, Flight], *, with_library: bool = True) -> str:
    """Give the HTML of a replay of flights around one target's mesh.

    Args:
        flights: by name; all around the same target.
        with_library: whether the drawing library comes with it; the first replay of a page brings it for all.

    """
    first = next(iter(flights.values()))
    records = {name: flight.record for name, flight in flights.items()}
    return replay_records(records, first.target, first.scenario.chaser.radius, with_library=with_library)


def replay_records(
    records: Mapping[str, FlightRecord], target: Target, chaser_radius: float, *, with_library: bool = True
) -> str:
    """Give the HTML of a replay of what was recorded around a target's mesh; see `replay`."""
    drawing = _replay(records, target.vertices, target.faces, chaser_radius)
    # Plotly's own classes look at every number of every frame, for a quarter of a second.
    return plotly.io.to_html(drawing, full_html=False, include_plotlyjs=with_library, validate=False)


def _table(summaries: Sequence[Mapping[str, Any]]) -> str:
    head = "".join(f"<th>{html.escape(label)}</th>" for label in ("flight", *FLIGHT_COLUMNS.values()))
    rows = []
    for summary in summaries:
        cells = [f"<td>{html.escape(str(summary['name']))}</td>"]
        for key in FLIGHT_COLUMNS:
            bad = (key == "contact" and summary[key]) or (key == "reached" and not summary[key])
            cells.append(f"<td{' class=bad' if bad else ''}>{html.escape(shown(summary[key]))}</td>")
        rows.append(f"<tr>{''.join(cells)}</tr>")
    notes = "".join(f"<p class=bad>{html.escape(line)}</p>" for line in broken_assumptions(summaries))
    return f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>{notes}"


def _replay(
    records: Mapping[str, FlightRecord], vertices: np.ndarray, faces: np.ndarray, chaser_radius: float
) -> dict[str, Any]:
    end = max(float(record.time[-1]) for record in records.values())
    times = np.linspace(0.0, end, _FRAMES)
    mesh = _mesh(vertices, faces, TARGET_COLOUR) | {"flatshading": True, "name": "target"}
    paths, chasers = [], []
    for colour, (name, record) in zip(COLOURS, records.items()):
        line = {"type": "scatter3d", "mode": "lines", "line": {"color": colour, "width": 4}, "name": name}
        paths.append(line | {axis: _packed(column) for axis, column in zip("xyz", record.position.T, strict=True)})
        chasers.append((colour, np.column_stack([np.interp(times, record.time, axis) for axis in record.position.T])))
    # A point chaser is drawn as a small ball, so that there is something to see.
    radius = chaser_radius if chaser_radius > 0.0 else 0.1
    moving = list(range(1 + len(paths), 1 + len(paths) + len(chasers)))
    frames = [
        {
            "name": f"{time:.0f}",
            "data": [_ball(centres[k], radius, colour) for colour, centres in chasers],
            "traces": moving,
        }
        for k, time in enumerate(times)
    ]
    start = [_ball(centres[0], radius, colour) for colour, centres in chasers]
    step = {"frame": {"duration": 40, "redraw": True}, "fromcurrent": True, "transition": {"duration": 0}}
    layout = {
        "height": 640,
        "margin": {"l": 0, "r": 0, "t": 0, "b": 40},
        "font": {"color": "#2a3f5f"},
        "legend": {"x": 0.0, "y": 1.0},
        "scene": {"aspectmode": "data"} | {f"{axis}axis": {"title": {"text": f"{axis} m"}} | _WALL for axis in "xyz"},
        "updatemenus": [
            {
                "type": "buttons",
                "direction": "left",
                "x": 0.0,
                "y": 0.0,
                "buttons": [
                    {"label": "play", "method": "animate", "args": [None, step]},
                    {"label": "pause", "method": "animate", "args": [[None], {"mode": "immediate"}]},
                ],
            }
        ],
        "sliders": [
            {
                "currentvalue": {"prefix": "time s: "},
                "x": 0.15,
                "len": 0.85,
                "steps": [
                    {
                        "label": frame["name"],
                        "method": "animate",
                        "args": [[frame["name"]], {"mode": "immediate", "frame": {"duration": 0, "redraw": True}}],
                    }
                    for frame in frames
                ],
            }
        ],
    }
    return {"data": [mesh, *paths, *start], "frames": frames, "layout": layout}


def _ball(centre: Float[np.ndarray, "3"], radius: float, colour: str) -> dict[str, Any]:
    vertices, faces = _sphere()
    return _mesh(np.round(centre + radius * vertices, 4), faces, colour) | {"showlegend": False}


def _mesh(vertices: np.ndarray, faces: np.ndarray, colour: str) -> dict[str, Any]:
    arrays = zip("xyzijk", (*vertices.T, *faces.T), strict=True)
    return {"type": "mesh3d", "color": colour, "hoverinfo": "skip"} | {name: _packed(array) for name, array in arrays}


def _packed(numbers: np.ndarray) -> dict[str, str]:
    """Give an array as Plotly reads it fastest: its memory, little-endian, in base 64."""
    kind = "<f8" if numbers.dtype.kind == "f" else "<u2" if numbers.max() < 2**16 else "<u4"
    return {"dtype": kind[1:], "bdata": base64.b64encode(numbers.astype(kind).tobytes()).decode("ascii")}


@functools.cache
def _sphere() -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]:
    """Vertices and faces, their corners in any turn, of a unit icosahedron with its faces cut in four."""
    golden = (1.0 + 5.0**0.5) / 2.0
    one = np.array([[0.0, y, z] for y in (-1.0, 1.0) for z in (-golden, golden)])
    corners = np.concatenate([np.roll(one, axis, axis=1) for axis in range(3)])
    joined = np.triu(np.isclose(np.linalg.norm(corners[:, None] - corners, axis=-1), 2.0))
    first, second = np.nonzero(joined)
    vertices = np.concatenate([corners, 0.5 * (corners[first] + corners[second])])
    vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    middle = np.zeros_like(joined, dtype=int)
    middle[first, second] = len(corners) + np.arange(len(first))
    faces = []
    for a, b in zip(first, second, strict=True):
        for c in np.nonzero(joined[a] & joined[b])[0]:
            ab, bc, ac = middle[a, b], middle[b, c], middle[a, c]
            faces += [(a, ab, ac), (b, ab, bc), (c, ac, bc), (ab, bc, ac)]
    return vertices, np.array(faces)


def _base64(path: Path) -> str:
    return base64.b64encode(path.read_bytes()).decode("ascii")
