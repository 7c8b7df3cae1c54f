"""CZML, tables and scenes of a flight: what their own readers find in them is what was flown."""

import csv
import datetime
import json
import struct

import erfa
import numpy as np
import pyarrow.parquet as pq
import pytest
import trimesh
from czml3 import Document
from scipy.spatial.transform import Rotation
from truths.boxes import LEARNED
from truths.command_line import keepout_command
from truths.messages import GEOSTATIONARY, TUMBLING, toy_flight

from keepout.core.fields.field import values
from keepout.core.fields.model import FieldModel
from keepout.core.flight.loop import FlightLog
from keepout.core.flight.record import FlightRecord
from keepout.core.geometry.target import Target
from keepout.core.mission.epoch import parse_instant
from keepout.flights.exchange.flight_files import UNITS, earth_from_inertial, inertial_flight

pytestmark = [pytest.mark.as_used, pytest.mark.usefixtures("coarse_surfaces")]


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    scenario, record = toy_flight(TUMBLING, steps=60)
    return scenario, record, record.save(tmp_path_factory.mktemp("flown") / "flight.parquet")


@pytest.mark.filterwarnings("ignore::erfa.ErfaWarning")  # no leap seconds are known for the years to come
def test_the_earth_is_turned_as_by_the_full_conventions():
    """Against ERFA with nutation, UT1 = UTC and no polar motion: within 30 arc seconds from 1995 to 2045."""
    for year in range(1995, 2046, 10):
        instant = f"{year}-{1 + year % 12:02}-17T0{year % 10}:34:56.25"
        found = earth_from_inertial(np.array([parse_instant(instant)]))[0]
        one, two = erfa.dtf2d("UTC", year, 1 + year % 12, 17, year % 10, 34, 56.25)
        terrestrial = erfa.taitt(*erfa.utctai(one, two))
        truth = erfa.c2t06a(*terrestrial, one, two, 0.0, 0.0)
        angle = Rotation.from_matrix(found @ truth.T).magnitude()
        assert np.degrees(angle) * 3600.0 < 30.0, year


def test_czml_read_back_is_the_flight(flown, tmp_path):
    scenario, record, path = flown
    out = tmp_path / "a.czml"
    summary = keepout_command("export", path, "--to", "czml", "-o", out, "--json").json
    assert summary["frame"] == "EME2000"
    document, target, chaser = json.loads(out.read_text())
    packets = Document.model_validate(json.loads(out.read_text())).packets
    assert [packet.id for packet in packets] == ["document", "target", "chaser"]
    assert document["clock"]["interval"] == "2027-03-04T05:06:07.500000Z/2027-03-04T05:07:07.500000Z"
    flight = inertial_flight(record, scenario)
    for packet, position, velocity in (
        (target, flight.target_position, flight.target_velocity),
        (chaser, flight.chaser_position, flight.chaser_velocity),
    ):
        place = packet["position"]
        assert place["referenceFrame"] == "INERTIAL"
        assert place["epoch"] == "2027-03-04T05:06:07.500000Z"
        rows = np.array(place["cartesianVelocity"]).reshape(-1, 7)
        assert np.array_equal(rows[:, 0], record.time)
        assert np.abs(rows[:, 1:4] - position).max() <= 1e-6
        assert np.abs(rows[:, 4:] - velocity).max() <= 1e-9
    turns = np.array(target["orientation"]["unitQuaternion"]).reshape(-1, 5)[:, 1:]
    assert np.sum(turns[1:] * turns[:-1], axis=1).min() > 0.9
    # Body to Earth-fixed and on to inertial: the chaser's place in the body frame leads to its inertial place.
    earth = earth_from_inertial(flight.epochs)
    away = np.einsum("nji,nj->ni", earth, Rotation.from_quat(turns).apply(record.position - flight.centre_of_mass))
    assert np.abs(away - (flight.chaser_position - flight.target_position)).max() < 1e-6
    assert chaser["ellipsoid"]["radii"]["cartesian"] == [0.5, 0.5, 0.5]


def of_csv(path):
    head, *rows = csv.reader(path.read_text().splitlines())
    return dict(zip(head, zip(*rows))), None


def of_parquet(path):
    table = pq.read_table(path)
    return table.to_pydict(), table.schema.metadata[b"keepout"].decode()


def of_npz(path):
    columns = dict(np.load(path, allow_pickle=False))
    return columns, columns.pop("keepout")


TABLES = {"csv": of_csv, "parquet": of_parquet, "npz": of_npz}


@pytest.mark.parametrize("to", TABLES)
def test_tables_hold_every_number_with_its_unit(flown, to, tmp_path):
    scenario, record, path = flown
    out = tmp_path / f"a.{to}"
    summary = keepout_command("export", path, "--to", to, "-o", out, "--json").json
    columns, told = TABLES[to](out)
    assert list(columns) == summary["columns"]
    start = datetime.datetime(2027, 3, 4, 5, 6, 7, 500_000)
    assert [datetime.datetime.fromisoformat(str(text)).replace(tzinfo=None) for text in columns["utc"]] == [
        start + datetime.timedelta(seconds=float(seconds)) for seconds in record.time
    ]

    def numbers(*names):
        return np.stack([np.asarray(columns[name]).astype(float) for name in names], axis=-1)

    for names, flown in (
        (("position_x_m", "position_y_m", "position_z_m"), record.position),
        (("velocity_x_mps", "velocity_y_mps", "velocity_z_mps"), record.velocity),
        (("attitude_w", "attitude_x", "attitude_y", "attitude_z"), record.attitude),
        (("target_orbit_x_m", "target_orbit_y_m", "target_orbit_z_m"), record.target_orbit[:, :3]),
        (("time_s",), record.time[:, None]),
    ):
        assert np.array_equal(numbers(*names), flown)
    assert len(columns) == 1 + sum(1 if a.ndim == 1 else a.shape[1] for a in record.columns.values())
    assert UNITS.keys() == FlightLog.__annotations__.keys()
    if told is not None:
        told = json.loads(str(told))
        assert (told["epoch"], told["scenario"]["name"]) == (scenario.epoch, "toy-tumbling")
        assert "body frame" in told["frames"]


def glb_tree(path):
    content = path.read_bytes()
    length = struct.unpack("<I", content[12:16])[0]
    return json.loads(content[20 : 20 + length])


@pytest.mark.long
def test_a_scene_holds_mesh_envelope_and_path_in_metres(tmp_path, coarse_surfaces):
    target, model = Target.load("box"), FieldModel.load(LEARNED)
    around = {"target": {"source": "box"}, "field": {"source": str(LEARNED)}}
    _, record = toy_flight({**GEOSTATIONARY, **around}, start=(0.0, 10.0, 6.0), goal=(3.0, 8.0, 6.0), steps=20)
    record = FlightRecord({**record.header, "target_sha256": target.sha256}, **record.columns)
    path, out = record.save(tmp_path / "flight.npz"), tmp_path / "a.glb"
    summary = keepout_command("export", path, "--to", "glb", "-o", out, "--json").json
    extras = glb_tree(out)["scenes"][0]["extras"]["keepout"]
    assert (extras["units"], extras["target_sha256"]) == ("m", target.sha256)
    assert extras["frame"].startswith("the target's body frame")
    assert extras["envelope_level_m"] == 0.5 + model.certificate(0.5).error_bound
    assert extras["chaser_radius_m"] == 0.5
    scene = trimesh.load_scene(out)
    mesh, envelope, way = (scene.geometry[name] for name in ("target", "envelope", "path"))
    assert len(mesh.faces) == summary["target_triangles"]
    assert np.abs(mesh.bounds - [target.vertices.min(axis=0), target.vertices.max(axis=0)]).max() < 1e-5
    pieces = np.repeat(record.position, 2, axis=0)[1:-1]  # a path is kept as its pieces, end to end
    assert np.abs(np.asarray(way.vertices) - pieces).max() < 1e-5
    # On its level of the field, and so outside of all that a chaser may touch, as far as triangles tell.
    corners = np.asarray(envelope.vertices, float)[::50]
    assert np.abs(values(model.field, corners) - extras["envelope_level_m"]).max() < 0.05
    assert target.distance.distance(corners).min() > 0.45
    # Keepout's own strict reader takes the mesh back for the same target.
    trimesh.Scene({"target": mesh}).export(tmp_path / "mesh.glb")
    again = Target.load(tmp_path / "mesh.glb", units="m")
    assert np.abs(again.vertices.max(axis=0) - target.vertices.max(axis=0)).max() < 1e-5
    # A field alone has no path.
    alone = tmp_path / "field.glb"
    of = ("export", LEARNED, "--to", "glb", "--chaser-radius", 0.5)
    told = keepout_command(*of, "-o", alone, "--json").json
    assert set(trimesh.load_scene(alone).geometry) == {"target", "envelope"}
    assert (told["path_points"], told["envelope_kind"]) == (0, "certified")


@pytest.mark.parametrize(
    ("header", "arguments", "said"),
    [
        ({"target_sha256": "f" * 64}, ("--to", "glb", "--mesh", "sphere"), "was flown around another mesh"),
        ({}, ("--to", "oem"), "flight.npz: its header has no scenario"),
    ],
)
def test_what_cannot_be_exported_of_a_flight(flown, header, arguments, said, tmp_path):
    record = flown[1]
    path = FlightRecord({**record.header, **header} if header else {}, **record.columns).save(tmp_path / "flight.npz")
    answer = keepout_command("export", path, *arguments, "-o", tmp_path / "out")
    assert answer.code == 1
    assert said in answer.err
    assert answer.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == [path]
