"""What a replay holds against what was recorded: positions, proved clearances, marks, surfaces, refusals."""

import dataclasses
import html

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from truths.invented_flight import record_of
from truths.passing import RADIUS, SPEED, START, STEPS, box_scenario, pass_position, pass_record
from truths.replay_page import ReplayPage

from keepout.core.audit.tube import FlightBounds
from keepout.core.errors import FieldError, FlightError, KeepoutError, MeshError
from keepout.core.fields.field import values
from keepout.core.geometry.target import Target
from keepout.core.mission.bounds import orbit_of
from keepout.core.mission.surroundings import Surroundings
from keepout.core.motion.rotation import vvlh_axes
from keepout.flights.pages import drawn, scene
from keepout.flights.pages.drawn import drawn_surface
from keepout.flights.pages.replay_page import write_replay
from keepout.flights.pages.replayed import of_records, proved_clearance
from keepout.flights.pages.scene import Packing, marks, to_inertial, to_vvlh
from keepout.verbs.files import replay as replay_to_page

pytestmark = [pytest.mark.as_used, pytest.mark.usefixtures("coarse_surfaces")]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("replay")


def passed(folder, name, **columns):
    """A pass 3 m over the box's middle."""
    return pass_record(box_scenario(folder, 3.0, name), 3.0, **columns)


@given(st.lists(st.tuples(*[st.floats(-1e6, 1e6)] * 3), min_size=1, max_size=30))
def test_steps_are_even_and_half_of_one_is_the_largest_error(rows):
    packing = Packing()
    array = np.array(rows)
    reference, after = packing.steps(array), packing.exact(array[:, 0], "float64")
    page = ReplayPage.of({}, packing.text())
    error = np.abs(page.array(reference) - array)
    assert (error <= np.ptp(array, axis=0) / 131068 + 1e-9 * np.abs(array).max()).all()
    np.testing.assert_array_equal(page.array(after), array[:, 0])
    assert after["offset"] % 4 == 0


@pytest.mark.long
@given(
    st.lists(st.tuples(*[st.floats(-0.1, 0.1)] * 3), min_size=3, max_size=12),
    st.integers(0, 2**31),
)
def test_no_point_of_the_true_path_is_nearer_than_the_proved_clearance(box, forces, seed):
    """The truth is integrated in closed form, 50 points a step, with a disturbance that the bounds allow."""
    mass, bound, step = 20.0, 0.01, 2.0
    generator = np.random.default_rng(seed)
    position, velocity = np.array([0.0, 2.5, 0.3]), generator.normal(scale=0.05, size=3)
    rows, paths = [(position, velocity)], []
    for force in forces:
        pushed = generator.normal(size=3)
        acceleration = (np.array(force) + bound * pushed / np.linalg.norm(pushed)) / mass
        at = np.linspace(0.0, step, 50)[:, None]
        paths.append(position + velocity * at + 0.5 * acceleration * at**2)
        position = position + velocity * step + 0.5 * acceleration * step**2
        velocity = velocity + acceleration * step
        rows.append((position, velocity))
    positions, velocities = map(np.array, zip(*rows))
    attitude = np.tile([1.0, 0.0, 0.0, 0.0], (len(rows), 1))
    flown = {"position": positions, "velocity": velocities, "force": np.array([*forces, (0.0, 0.0, 0.0)])}
    record = record_of({}, time=np.arange(len(rows)) * step, attitude=attitude, **flown)
    bounds = FlightBounds(mass, bound, 0.0, 0.0, 0.0)
    proved = proved_clearance(record, box.distance, chaser_radius=RADIUS, bounds=bounds)
    assert np.isfinite(proved).all()
    for path, least in zip(paths, proved, strict=True):
        clearance = box.distance.distance(path) - RADIUS
        assert least <= clearance.min()
        assert least >= clearance.min() - 0.25 * step * (
            np.linalg.norm(np.diff(path, axis=0), axis=1).sum() / step + 0.1
        )


@pytest.mark.long
def test_nothing_is_proved_of_a_step_that_cannot_have_been_flown(box, folder):
    scenario = box_scenario(folder, 3.0, "jump")
    record = pass_record(scenario, 3.0)
    position = record.position.copy()
    position[51:] += [0.0, 0.0, 1.0]
    record = dataclasses.replace(record, position=position)
    proved = proved_clearance(record, box.distance, chaser_radius=RADIUS, bounds=Surroundings(scenario).flight_bounds)
    assert np.isnan(proved[50])
    assert np.isfinite(np.delete(proved, 50)).all()


@pytest.mark.long
def test_marks_are_where_guard_flags_and_law_spoke(folder):
    guard = np.zeros(STEPS + 1, np.int32)
    guard[40:60] = 1  # braking
    guard[50:55] |= 8  # disturbance
    guard[STEPS] = 3  # the last row was not flown
    law = np.zeros(STEPS + 1, np.int32)
    law[100:102] = 1
    record = passed(folder, "marked", guard_status=guard, control_status=law)
    clearance = np.abs(np.arange(STEPS + 1.0) - 120.0)
    error = np.where((np.arange(STEPS + 1) >= 150) | (np.arange(STEPS + 1) == 30), 0.0, 1.0)  # and left again
    found = {mark.words: (mark.kind, mark.start, mark.end) for mark in marks(record, clearance, error, 0.1)}
    assert found == {
        "guard: braking": ("guard", 40.0, 60.0),
        "flag: disturbance": ("flag", 50.0, 55.0),
        "law: saturated": ("law", 100.0, 102.0),
        "least clearance": ("nearest", 120.0, 120.0),
        "goal reached, to stay": ("reached", 150.0, 150.0),
    }


@pytest.mark.long
def test_frames_agree_with_rotations_by_matrices(folder):
    scenario = box_scenario(folder, 3.0, "turning", orbit={"inclination": 0.7, "eccentricity": 0.1})
    record = pass_record(scenario, 3.0, turning=0.05)
    body_from_vvlh = Rotation.from_euler("z", 0.05 * record.time[:, None]).as_matrix()
    vvlh = Rotation.from_quat(to_vvlh(record), scalar_first=True).as_matrix()
    np.testing.assert_allclose(vvlh, np.swapaxes(body_from_vvlh, 1, 2), atol=1e-12)
    inertial = Rotation.from_quat(to_inertial(record, scenario), scalar_first=True).as_matrix()
    for row in (0, 77, STEPS):
        axes = np.asarray(vvlh_axes(*orbit_of(scenario.orbit).inertial_state(jnp.asarray(record.time[row]))))
        np.testing.assert_allclose(inertial[row], axes.T @ vvlh[row], atol=1e-12)
    assert (np.sum(np.diff(to_vvlh(record), axis=0) ** 2, axis=1) < 0.01).all()  # no flip of sign on the way
    orbit = np.tile(np.concatenate([[7e6, 0.0, 0.0], [0.0, 7e3, 0.0]]), (STEPS + 1, 1))
    recorded = to_inertial(dataclasses.replace(record, target_orbit=orbit), scenario)
    axes = np.asarray(vvlh_axes(jnp.asarray(orbit[0, :3]), jnp.asarray(orbit[0, 3:])))
    np.testing.assert_allclose(
        Rotation.from_quat(recorded[3], scalar_first=True).as_matrix(), axes.T @ vvlh[3], atol=1e-12
    )


@pytest.mark.long
def test_a_surface_lies_on_its_level_with_its_normals_outward(box, folder):
    [flight] = of_records({"surface": passed(folder, "surface")})
    envelope, guard = flight.levels
    assert (envelope.kind, guard.kind) == ("envelope", "guard")
    for level in flight.levels:
        drawn = drawn_surface(level.field, box.distance, level.level, steepest=level.steepest)
        off = np.abs(values(level.field, drawn.vertices) - level.level)
        assert off.max() <= level.steepest * drawn.within + 0.02
        assert (np.abs(np.linalg.norm(drawn.normals, axis=1) - 1.0) < 1e-6).all()
        corners = drawn.vertices[drawn.faces]
        outward = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        volume = np.einsum("fi,fi->f", corners[:, 0], outward).sum() / 6.0
        assert volume > 8.0  # of the box alone: so the triangles turn outward, and enclose it
        edges = np.sort(np.concatenate([drawn.faces[:, [k, k - 2]] for k in range(3)]), axis=1)
        assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()  # closed
        assert len(drawn.faces) < 20_000


@pytest.mark.slow
@pytest.mark.long
def test_the_page_says_what_it_leaves_out(folder, tmp_path, monkeypatch, coarse_surfaces):
    records = {"whole": passed(folder, "whole")}
    write_replay(tmp_path / "whole.html", of_records(records), title="whole")
    page = ReplayPage.read(tmp_path / "whole.html")
    assert page.told["target"]["remark"] == page.flights()["whole"]["remark"] == ""
    assert "drawn with" not in (tmp_path / "whole.html").read_text().partition("<script")[0]
    monkeypatch.setattr(drawn, "MOST_TRIANGLES", 10)
    monkeypatch.setattr(scene, "MOST_ROWS", 50)
    write_replay(tmp_path / "thinned.html", of_records(records), title="thinned")
    page = ReplayPage.read(tmp_path / "thinned.html")
    shown = page.array(page.told["target"]["faces"]).shape[0]
    target = f"The target is drawn with {shown} of its 12 triangles; distances are to all of it."
    flight = (
        f"Path and plots are drawn with {len(page.positions('whole'))} of the flight's {STEPS + 1} rows; "
        "verdict, marks and lower bound are of all."
    )
    assert len(page.positions("whole")) < STEPS + 1
    assert page.told["target"]["remark"] == target
    assert page.flights()["whole"]["remark"] == flight
    written = html.unescape((tmp_path / "thinned.html").read_text().partition("<script")[0])
    assert target in written
    assert flight in written


@pytest.mark.long
def test_the_page_holds_what_was_recorded(folder, tmp_path):
    paths = []
    for name, height in (("high", 3.0), ("low", 2.0)):
        record = pass_record(box_scenario(folder, height, name), height)
        paths.append(record.save(tmp_path / f"{name}.parquet"))
    summary = replay_to_page(paths, tmp_path / "replay.html")
    page = ReplayPage.read(tmp_path / "replay.html")
    assert summary["flights"] == ["high", "low"] == list(page.flights())
    assert summary["bytes"] == (tmp_path / "replay.html").stat().st_size
    for name, height in (("high", 3.0), ("low", 2.0)):
        arrays = page.flights()[name]["arrays"]
        np.testing.assert_allclose(page.positions(name)[37], pass_position(37.0, height), atol=1e-5)
        over = np.abs(START_TO_END) <= 1.0  # above the box, whose top is at 1 m
        clearance = page.array(arrays["clearance"])
        np.testing.assert_allclose(clearance[over], height - 1.0 - RADIUS, atol=1e-5)
        bound = page.array(arrays["bound"])
        assert (bound[:-1] <= clearance[:-1]).all()
        assert (bound[:-1] >= clearance[:-1] - 0.05).all()
        assert np.isnan(bound[-1])
        np.testing.assert_allclose(page.array(arrays["speed"]), SPEED, atol=1e-7)
        np.testing.assert_allclose(page.array(arrays["closest"])[100], [0.0, 0.0, 1.0], atol=1e-5)
        assert page.flights()[name]["contact"] == "no"
    target = page.told["target"]
    np.testing.assert_allclose(page.array(target["vertices"]), Target.load("box").vertices, atol=1e-4)
    assert [surface["kind"] for surface in page.told["surfaces"]] == ["envelope", "guard"]  # shared by both flights
    assert page.told["surfaces"][0]["level"] == pytest.approx(RADIUS + page.told["surfaces"][0]["error_bound"])


START_TO_END = START + SPEED * np.arange(STEPS + 1.0)


@pytest.mark.long
def test_what_comes_after_a_position_that_is_not_a_number_is_not_drawn(folder):
    position = passed(folder, "nan").position.copy()
    position[120:] = np.nan
    [flight] = of_records({"nan": passed(folder, "nan", position=position)})
    assert flight.shown.steps == 119
    assert str(flight.verdict.contact) == "undecided"
    position[0] = np.nan
    [flight] = of_records({"nan": passed(folder, "nan", position=position)})
    with pytest.raises(FlightError, match=r"^nan: its first position"):
        _ = flight.shown


def test_refusals_name_the_file_and_leave_no_page(folder, tmp_path):
    out = tmp_path / "replay.html"
    good = passed(folder, "good")
    whole = good.save(tmp_path / "whole.parquet")
    (tmp_path / "damaged.parquet").write_bytes(whole.read_bytes()[:-100])
    dataclasses.replace(good, header={}).save(tmp_path / "bare.npz")
    gone = {"lost": {"target": {"source": "lost.stl"}}, "fieldless": {"field": {"source": "gone.keepout"}}}
    for name, entry in gone.items():
        pass_record(box_scenario(folder, 3.0, name, **entry), 3.0).save(tmp_path / f"{name}.parquet")
    other = passed(folder, "other")
    other.header["target_sha256"] = "0" * 64
    other.save(tmp_path / "other.parquet")
    for name, kind, said in (
        ("missing.parquet", FlightError, "No such file"),
        ("damaged.parquet", FlightError, ""),
        ("bare.npz", FlightError, "holds no scenario"),
        ("lost.parquet", MeshError, "lost.stl"),
        ("fieldless.parquet", FieldError, "gone.keepout"),
        ("other.parquet", FlightError, "is not the one it was flown around"),
    ):
        with pytest.raises(kind) as refusal:
            replay_to_page([whole, tmp_path / name], out)
        assert str(tmp_path / name) in str(refusal.value)
        assert said in str(refusal.value)
        assert "\n" not in str(refusal.value)
        assert not out.exists()
    with pytest.raises(KeepoutError, match=r"ends in \.html"):
        replay_to_page([whole], tmp_path / "replay.pdf")
