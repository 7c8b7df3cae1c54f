"""Draw the three pictures of the first page into docs/figures: frames, error bound and the guard's tube.

python docs/pictures.py [frames] [error-bound] [guard-tube] [--png FOLDER]

The last two are computed: from the field that ships for `intelsat30`, its certificate and the exact distance, and from
a flight of `examples/faults.toml`. All three are SVG files whose letters are text, on a white ground.
"""

import argparse
import re
from collections.abc import Callable
from pathlib import Path

import jax.numpy as jnp
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import trimesh
from contourpy import contour_generator
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Arc, Circle, Polygon, Rectangle

import keepout
from keepout.core.guard import braking

FIGURES = Path(__file__).parent / "figures"
INK, GREY, BLUE, RED, GREEN = "#111111", "#777777", "#1f5fbf", "#c0392b", "#1d7f3b"
RADIUS = 0.5
"""Of the chaser's ball, m."""


def arrow(axes: Axes, start, end, text: str, colour: str, offset=(0.0, 0.0), **settings) -> None:
    """Draw a vector with its name at its end."""
    style = {"arrowstyle": "-|>", "color": colour, "lw": 1.8, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 13}
    axes.annotate("", xy=end, xytext=start, arrowprops=style)
    place = {"ha": "center", "va": "center", "color": colour, "fontsize": 11} | settings
    axes.text(end[0] + offset[0], end[1] + offset[1], text, **place)


def satellite(axes: Axes, centre, turned: float, size: float) -> None:
    """Draw a satellite with two wings, turned by an angle, rad."""
    c, s = np.cos(turned), np.sin(turned)
    for half, at in (((0.55, 0.4), (0.0, 0.0)), ((0.75, 0.12), (-1.4, 0.0)), ((0.75, 0.12), (1.4, 0.0))):
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half + at
        axes.add_patch(Polygon(corners * size @ np.array([[c, s], [-s, c]]) + centre, fc="#d5d8de", ec=INK, lw=1.0))


def frames() -> Figure:
    """Draw the three frames, seen against the orbit normal: the target goes round counter-clockwise."""
    figure, (orbit, near) = plt.subplots(1, 2, figsize=(10.2, 5.0), width_ratios=(1.0, 1.15))
    for axes in (orbit, near):
        axes.set_aspect("equal")
        axes.axis("off")
    orbit.set(xlim=(-1.55, 1.55), ylim=(-1.5, 1.72))
    orbit.set_title("The orbit, seen against its normal", fontsize=12)
    orbit.add_patch(Circle((0, 0), 0.42, fc="#cfe3f5", ec=INK))
    orbit.text(-0.1, -0.27, "Earth", ha="center", va="center", fontsize=11)
    orbit.add_patch(Circle((0, 0), 1.15, fill=False, ec=GREY, ls="--"))
    orbit.text(-0.95, -1.12, "orbit", color=GREY, fontsize=11, ha="center")
    arrow(orbit, (0, 0), (0.75, 0.0), "x", GREY, (0.09, 0.0))
    arrow(orbit, (0, 0), (0.0, 0.75), "y", GREY, (0.0, 0.09))
    orbit.text(0.47, -0.17, "inertial\nframe", color=GREY, fontsize=11, ha="left", va="center")
    for angle in (0.9, 2.6, 4.9):
        out = np.array([np.cos(angle), np.sin(angle)])
        along = np.array([-out[1], out[0]])
        place = 1.15 * out
        if angle == 0.9:
            orbit.text(*(place + 0.12 * out + (0.05, 0.0)), "target", fontsize=11, ha="left")
        orbit.plot(*place, "o", color=INK, ms=5)
        arrow(orbit, place, place + 0.45 * along, "x", BLUE, 0.08 * along)
        arrow(orbit, place, place - 0.45 * out, "z", BLUE, -0.08 * out)
    orbit.text(-0.1, 1.43, "orbital frame (VVLH)\nturns once in an orbit", color=BLUE, fontsize=11, ha="right")

    near.set(xlim=(-4.0, 5.4), ylim=(-4.6, 4.0))
    near.set_title("Near the target", fontsize=12)
    turned = 0.42
    satellite(near, (0, 0), turned, 1.0)
    zero = np.zeros(2)
    arrow(near, zero, np.array([-3.2, 0.0]), "x  along the velocity", BLUE, (-0.6, 0.32), ha="left")
    arrow(near, zero, np.array([0.0, -3.4]), "z  to the Earth", BLUE, (0.0, -0.35))
    near.add_patch(Circle((0, 0), 0.16, fc="white", ec=BLUE, lw=1.6, zorder=4))
    near.plot([0], [0], "x", color=BLUE, ms=6, zorder=5)
    near.text(-3.9, 2.2, "y  into the page:\nagainst the orbit normal", color=BLUE, fontsize=11, ha="left", va="center")
    near.annotate("", (-0.12, 0.16), (-1.6, 1.75), arrowprops={"arrowstyle": "-", "color": BLUE, "lw": 0.8})
    c, s = np.cos(turned), np.sin(turned)
    arrow(near, zero, 3.0 * np.array([-c, -s]), "x", GREEN, (-0.2, -0.2))
    arrow(near, zero, 3.0 * np.array([s, -c]), "z", GREEN, (0.2, -0.2))
    near.text(
        1.6,
        -2.2,
        "the target's body frame:\nfixed to the mesh; positions\nof start, goal and flight",
        color=GREEN,
        fontsize=11,
    )
    near.add_patch(Arc((0, 0), 4.4, 4.4, theta1=180, theta2=180 + np.degrees(turned), color=INK))
    near.text(-2.3, -0.48, "attitude", fontsize=11, ha="right", va="center")
    chaser = np.array([3.0, 2.2])
    near.add_patch(Circle(chaser, 0.75, fill=False, ec=RED, ls="--", lw=1.2))
    near.add_patch(Rectangle(chaser - 0.38, 0.76, 0.76, fc="#f3d9d5", ec=INK))
    arrow(near, zero, chaser, "", RED)
    near.text(1.0, 1.55, "position", color=RED, fontsize=11, ha="right")
    near.text(3.0, 3.25, "chaser, in a ball of radius R", color=RED, fontsize=11, ha="center")
    figure.tight_layout()
    return figure


def cut(axes: Axes, target: keepout.Target, origin, first, second) -> None:
    """Draw the target where a plane cuts it."""
    mesh = trimesh.Trimesh(target.vertices, target.faces, process=True)
    for body in mesh.split(only_watertight=False):
        section = body.section(plane_origin=origin, plane_normal=np.cross(first, second))
        for line in () if section is None else section.discrete:
            flat = (line - origin) @ np.stack([first, second], axis=1)
            if np.ptp(flat, axis=0).max() > 0.05:
                axes.plot(*flat.T, color="#4a4a4a", lw=1.1)


def over(axes: Axes, origin, first, second, window, points: int = 181):
    """Places of a plane, to be asked, and their coordinates in it."""
    u, v = np.meshgrid(np.linspace(*window[:2], points), np.linspace(*window[2:], points))
    axes.set(xlim=window[:2], ylim=window[2:])
    axes.set_aspect("equal")
    return u, v, origin + u[..., None] * first + v[..., None] * second


def asked(question: Callable[[np.ndarray], object], places: np.ndarray) -> np.ndarray:
    """Ask a field or a distance at places (…, 3)."""
    return np.asarray(question(places.reshape(-1, 3))).reshape(places.shape[:-1])


def level(axes: Axes, u, v, numbers, at: float, **look) -> list[np.ndarray]:
    """Draw one level as simplified lines, and give them."""
    lines = contour_generator(u, v, numbers).lines(at)
    for line in lines:
        axes.plot(*line.T, **look)
    return lines


def error_bound() -> Figure:
    """Draw the certified field beside the exact distance, and what e_h bounds."""
    target, model = keepout.Target.load("intelsat30"), keepout.load_shipped("intelsat30")
    certificate = model.certificate(RADIUS)

    def field(points):
        return model.field.value(jnp.asarray(points))

    origin, first, second = np.array([0.05, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
    figure, (whole, close, along) = plt.subplots(1, 3, figsize=(13.0, 4.9), width_ratios=(1.1, 0.95, 1.05))

    u, v, places = over(whole, origin, first, second, (-4.7, 4.7, -4.5, 4.9), 151)
    d, f = asked(target.distance.distance, places), asked(field, places)
    inside = f < -0.05
    for line in contour_generator(u, v, f).lines(-0.05):
        whole.fill(*line.T, color="#d5d8de")
    cut(whole, target, origin, first, second)
    outside = np.where(inside, np.nan, d)
    paths = level(whole, u, v, outside, RADIUS, color=INK, lw=2.0)
    level(whole, u, v, outside, 1.0, color=INK, lw=0.8)
    level(whole, u, v, f, RADIUS, color=BLUE, lw=1.6, ls="--")
    level(whole, u, v, f, 1.0, color=BLUE, lw=0.8, ls="--")
    whole.set(xlabel="y, m", ylabel="z, m")
    whole.set_title("A cut through intelsat30\nlevels R = 0.5 m and 1 m", fontsize=11)
    whole.plot([], [], color=INK, label="exact distance d")
    whole.plot([], [], color=BLUE, ls="--", label="learned field f")
    whole.legend(loc="lower left", fontsize=9, framealpha=1.0)

    middle, half = np.array([1.72, -2.35]), 0.12
    window = (middle[0] - half, middle[0] + half, middle[1] - half, middle[1] + half)
    whole.add_patch(Rectangle(middle - half, 2 * half, 2 * half, fill=False, ec=RED, lw=1.8, zorder=5))
    u, v, places = over(close, origin, first, second, window, 61)
    d, f = asked(target.distance.distance, places), asked(field, places)
    level(close, u, v, d, RADIUS, color=INK, lw=2.0)
    level(close, u, v, f, RADIUS, color=BLUE, lw=1.6, ls="--")
    level(close, u, v, f, RADIUS + certificate.error_bound, color=RED, lw=1.8)
    for colour, style, text in (
        (INK, "-", "{d = R}: the chaser touches"),
        (RED, "-", "{f = R + e_h}: never inside it"),
        (BLUE, "--", "{f = R}"),
    ):
        close.plot([], [], color=colour, ls=style, label=text)
    close.legend(loc="upper right", fontsize=9, framealpha=1.0)
    close.text(1.61, -2.45, "towards\nthe target", fontsize=10)
    close.text(1.75, -2.45, "free space", fontsize=10)
    close.set(xlabel="y, m")
    close.set_title("The red square, larger", fontsize=11)

    path = max(paths, key=len)
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    every = np.linspace(0.0, length[-1], 380)
    on = (
        origin
        + np.interp(every, length, path[:, 0])[:, None] * first
        + np.interp(every, length, path[:, 1])[:, None] * second
    )
    distance, gradient = target.distance.distance_and_gradient(on)
    for _ in range(3):  # onto {d = R}: the contour is drawn on a lattice
        on = on + (RADIUS - distance)[:, None] * gradient
        distance, gradient = target.distance.distance_and_gradient(on)
    kept = np.abs(distance - RADIUS) < 1e-6
    says = 1000.0 * (np.asarray(field(on)) - RADIUS)
    says[~kept] = np.nan
    bound = 1000.0 * certificate.error_bound
    along.axhspan(bound, 12.0, color="#f6dcd8", lw=0)
    along.axhline(0.0, color=INK, lw=1.0)
    along.axhline(bound, color=RED, lw=1.8)
    along.plot(every, says, color=BLUE, lw=1.3)
    along.text(0.5, 3.0, "above 0 the field would say too much", fontsize=10)
    along.text(0.5, bound + 3.0, f"proved: never above e_h = {bound:.1f} mm", color=RED, fontsize=10)
    along.text(
        0.5,
        -146.0,
        "f - R: by so much the field says too much.\nBelow 0 it says too little, which is safe.",
        color=BLUE,
        fontsize=10,
    )
    along.set(xlim=(0.0, every[-1]), ylim=(-150.0, 12.0), xlabel="way along {d = R}, m", ylabel="f - R, mm")
    along.set_title("Along the black curve", fontsize=11)
    figure.tight_layout()
    return figure


def guard_tube() -> Figure:
    """Draw a braking path that the guard accepted, its tube, and the next one, which it refused."""
    folder = Path(__file__).parents[1] / "examples"
    mission = keepout.prepare(keepout.Scenario.load(folder / "faults.toml").replace(duration=90.0))
    guard, record, target = mission.guard, mission.fly().record, mission.target
    assumed, design, T = guard.assumptions, guard.braking, float(guard.assumptions.period)
    rho, mass, limit = float(design.position_radius), float(assumed.mass), float(assumed.force_limit)
    wall, rail = float(guard.threshold + guard.evaluation_error), float(guard.least_value)

    def field(points):
        return guard.field.value(jnp.asarray(points))

    def motion(step: int) -> np.ndarray:
        """Where the chaser is, where its next command takes effect, where that leads in a step, where it would rest."""
        under_way = jnp.asarray(record.guarded_force[step - 1 : step]) / mass
        told = jnp.asarray(record.estimated_position[step]), jnp.asarray(record.estimated_velocity[step])
        path, speeds = braking.predict(assumed, *told, under_way)
        push = jnp.clip(jnp.asarray(record.commanded_force[step]), -limit, limit) / mass
        end, speed = path[-1] + T * speeds[-1] + 0.5 * T**2 * push, speeds[-1] + T * push
        return np.stack([*path, end, end + braking.stop(assumed, design, speed)])

    passed = np.asarray(record.guard_status) == 0
    step = next(k for k in range(1, 90) if not passed[k] and np.min(field(motion(k))) < rail)
    step -= (
        1  # the last command passed on before the field refused one; the others between were refused for their speed
    )
    assert passed[step]
    good, bad = motion(step), motion(step + 1)

    # A plane that holds the accepted braking path, nearly that of y and z.
    first = (good[-1] - good[-2]) / np.linalg.norm(good[-1] - good[-2])
    second = np.cross(np.array([1.0, 0.0, 0.0]), first)
    second /= np.linalg.norm(second)
    angle = np.arctan2(first[2], first[1])
    right, up = np.cos(angle) * first - np.sin(angle) * second, np.sin(angle) * first + np.cos(angle) * second
    origin = good[-1] - (good[-1] @ right) * right - (good[-1] @ up) * up

    def flat(points):
        return (np.asarray(points) - origin) @ np.stack([right, up], axis=1)

    rest = flat(good[-1])
    figure, (whole, close) = plt.subplots(1, 2, figsize=(11.0, 5.6), width_ratios=(1.0, 1.1))
    east, north = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
    beside = np.array([good[-1][0], 0.0, 0.0])
    u, v, places = over(whole, beside, east, north, (-4.8, 8.2, -4.4, 8.6), 131)
    f = asked(field, places)
    for line in contour_generator(u, v, f).lines(0.0):
        whole.fill(*line.T, color="#d5d8de")
    level(whole, u, v, f, wall, color=RED, lw=1.7)
    cut(whole, target, beside, east, north)
    flown = np.asarray(record.position)[: step + 1, 1:]
    whole.plot(*flown.T, color=INK, lw=1.4, label="the way flown")
    whole.plot(*good[-2:, 1:].T, color=GREEN, lw=2.4, label="the plan: brake to rest")
    whole.add_patch(Circle(flown[-1], 0.5, fill=False, ec=INK, lw=1.0))
    whole.plot(*flown[-1], "o", color=INK, ms=4)
    whole.text(*(flown[-1] + np.array([-0.7, 0.3])), "chaser, in its\nball of radius R", fontsize=10, ha="right")
    whole.plot([], [], color=RED, lw=1.7, label="level of the field: contact is possible from here on")
    whole.add_patch(Rectangle(good[-1][1:] - (0.42, 0.35), 0.8, 0.8, fill=False, ec=GREY, lw=1.4))
    whole.set(xlabel="y, m", ylabel="z, m")
    whole.legend(loc="upper left", fontsize=9.5, framealpha=1.0)
    whole.set_title("A law steers into the target", fontsize=11)

    window = (rest[0] - 0.42, rest[0] + 0.38, rest[1] - 0.35, rest[1] + 0.45)
    u, v, places = over(close, origin, right, up, window, 61)
    f = asked(field, places)
    level(close, u, v, f, wall, color=RED, lw=1.7)
    level(close, u, v, f, rail, color=RED, lw=1.1, ls="--")
    close.set(xlabel="m, nearly along y")
    for path, colour in ((bad, GREY), (good, GREEN)):
        points = flat(path)
        ways = points[-1] - points[-2]
        side = rho * np.array([-ways[1], ways[0]]) / np.linalg.norm(ways)
        ends = np.arctan2(*side[::-1]) - np.linspace(0.0, np.pi, 24)
        cap = points[-1] + rho * np.stack([np.cos(ends), np.sin(ends)], axis=1)
        outline = np.vstack([points[-2] + side, cap, points[-2] - side])
        close.add_patch(Polygon(outline, fc=colour, alpha=0.22, lw=0))
        close.plot(*outline.T, color=colour, lw=1.0)
        close.plot(*points[-2:].T, color=colour, lw=2.0)
        close.plot(*points[-1], "o", color=colour, ms=5)
    tip = flat(bad[-1])
    close.text(
        *(rest + np.array([0.07, -0.02])),
        "The plan that is kept:\nits tube is free, so its\ncommand is passed on.",
        color=GREEN,
        fontsize=10,
        va="top",
    )
    close.text(
        *(tip + np.array([0.2, 0.06])),
        "The next command: its tube\nwould cross. It is replaced\nby a step of the plan.",
        color="#444444",
        fontsize=10,
        va="top",
    )
    close.plot([], [], color=RED, lw=1.7, label="the tube stays outside this level")
    close.plot([], [], color=RED, lw=1.1, ls="--", label="its middle line outside this one: L ρ more")
    close.legend(loc="upper left", fontsize=9.5, framealpha=1.0)
    close.set_title(f"The grey square, larger: tube of radius ρ = {1000.0 * rho:.0f} mm", fontsize=11)
    figure.tight_layout()
    return figure


PICTURES = {"frames": frames, "error-bound": error_bound, "guard-tube": guard_tube}


def main() -> None:
    """Draw the pictures asked for, all by default."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(PICTURES)}")
    parser.add_argument("--png", type=Path, help="a folder for PNG files to look at")
    asked_for = parser.parse_args()
    look = {
        "svg.fonttype": "none",
        "svg.hashsalt": "keepout",
        "font.family": "sans-serif",
        "path.simplify_threshold": 0.3,
    }
    matplotlib.rcParams.update(look)
    for name in asked_for.names or PICTURES:
        figure = PICTURES[name]()
        figure.savefig(FIGURES / f"{name}.svg", facecolor="white", metadata={"Date": None, "Title": name})
        drawn = (FIGURES / f"{name}.svg").read_text(encoding="utf-8")
        drawn = re.sub(r"(\d\.\d\d)\d+", r"\1", drawn)  # hundredths of a point are fine enough
        drawn = re.sub(r"\s*\n\s*L ", "L", re.sub(r"\n +", "\n", drawn))
        (FIGURES / f"{name}.svg").write_text(drawn, encoding="utf-8")
        print(f"{name}.svg: {(FIGURES / f'{name}.svg').stat().st_size} bytes")
        if asked_for.png:
            figure.savefig(asked_for.png / f"{name}.png", facecolor="white", dpi=100)


if __name__ == "__main__":
    main()
