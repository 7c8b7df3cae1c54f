"""One HTML page that holds everything: a turnable replay, the table and the figures. It needs no network to open."""

import base64
import functools
import html
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull

from keepout.flight.record import FlightRecord
from keepout.geometry.target import Target
from keepout.mission.flight import Flight
from keepout.report.style import COLOURS, TARGET_COLOUR
from keepout.report.terminal import FLIGHT_COLUMNS, broken_assumptions, shown
from keepout.whole_file import write_whole

_FRAMES = 150
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
    return drawing.to_html(full_html=False, include_plotlyjs=with_library)


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
) -> go.Figure:
    end = max(float(record.time[-1]) for record in records.values())
    times = np.linspace(0.0, end, _FRAMES)
    mesh = go.Mesh3d(
        x=vertices[:, 0],
        y=vertices[:, 1],
        z=vertices[:, 2],
        i=faces[:, 0],
        j=faces[:, 1],
        k=faces[:, 2],
        color=TARGET_COLOUR,
        flatshading=True,
        hoverinfo="skip",
        name="target",
    )
    paths, chasers = [], []
    for colour, (name, record) in zip(COLOURS, records.items()):
        x, y, z = record.position.T
        paths.append(go.Scatter3d(x=x, y=y, z=z, mode="lines", line={"color": colour, "width": 4}, name=name))
        chasers.append((colour, np.column_stack([np.interp(times, record.time, axis) for axis in (x, y, z)])))
    # A point chaser is drawn as a small ball, so that there is something to see.
    radius = chaser_radius if chaser_radius > 0.0 else 0.1
    frames = [
        go.Frame(
            name=f"{time:.0f}",
            data=[_ball(centres[k], radius, colour) for colour, centres in chasers],
            traces=list(range(1 + len(paths), 1 + len(paths) + len(chasers))),
        )
        for k, time in enumerate(times)
    ]
    start = [_ball(centres[0], radius, colour) for colour, centres in chasers]
    drawing = go.Figure(data=[mesh, *paths, *start], frames=frames)
    step = {"frame": {"duration": 40, "redraw": True}, "fromcurrent": True, "transition": {"duration": 0}}
    drawing.update_layout(
        height=640,
        margin={"l": 0, "r": 0, "t": 0, "b": 40},
        legend={"x": 0.0, "y": 1.0},
        scene={"aspectmode": "data", "xaxis_title": "x m", "yaxis_title": "y m", "zaxis_title": "z m"},
        updatemenus=[
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
        sliders=[
            {
                "currentvalue": {"prefix": "time s: "},
                "x": 0.15,
                "len": 0.85,
                "steps": [
                    {
                        "label": frame.name,
                        "method": "animate",
                        "args": [[frame.name], {"mode": "immediate", "frame": {"duration": 0, "redraw": True}}],
                    }
                    for frame in frames
                ],
            }
        ],
    )
    return drawing


def _ball(centre: Float[np.ndarray, "3"], radius: float, colour: str) -> go.Mesh3d:
    vertices, (i, j, k) = _sphere()
    x, y, z = np.round(centre + radius * vertices, 4).T
    return go.Mesh3d(x=x, y=y, z=z, i=i, j=j, k=k, color=colour, hoverinfo="skip", showlegend=False)


@functools.cache
def _sphere() -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "3 faces"]]:
    """Vertices and corners of the faces of a unit icosahedron with its faces cut in four."""
    golden = (1.0 + 5.0**0.5) / 2.0
    one = np.array([[0.0, y, z] for y in (-1.0, 1.0) for z in (-golden, golden)])
    corners = np.concatenate([np.roll(one, axis, axis=1) for axis in range(3)])
    first, second = np.nonzero(np.triu(np.isclose(np.linalg.norm(corners[:, None] - corners, axis=-1), 2.0)))
    vertices = np.concatenate([corners, 0.5 * (corners[first] + corners[second])])
    vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    return vertices, ConvexHull(vertices).simplices.T


def _base64(path: Path) -> str:
    return base64.b64encode(path.read_bytes()).decode("ascii")
