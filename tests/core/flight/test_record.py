import pickle

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from keepout.core.errors import FlightError
from keepout.core.flight import record
from keepout.core.flight.loop import FlightLog
from keepout.core.flight.record import _DECLARED, FlightRecord

ENDINGS = ["parquet", "npz"]
FINITE = st.floats(allow_nan=False, allow_infinity=False)
relaxed = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


def make_record(rows=5, seed=0, header=None, orbit=False):
    generator = np.random.default_rng(seed)
    arrays = {}
    for name in FlightLog.__annotations__:
        if name == "target_orbit" and not orbit:
            continue
        shape, kind = (rows, *_DECLARED[name][0]), _DECLARED[name][1]
        arrays[name] = (generator.standard_normal(shape) * 10).astype(kind)
    return FlightRecord({"seed": seed} if header is None else header, **arrays)


def assert_same_bits(a, b):
    assert a.header == b.header
    assert a.columns.keys() == b.columns.keys()
    for name, array in a.columns.items():
        other = b.columns[name]
        assert array.dtype == other.dtype
        assert array.shape == other.shape
        assert array.tobytes() == other.tobytes(), name


@pytest.mark.long
@pytest.mark.parametrize("ending", ENDINGS)
@relaxed
@given(
    data=st.data(),
    rows=st.integers(1, 20),
    header=st.dictionaries(st.text(max_size=8), st.one_of(st.text(), st.integers(), st.none(), FINITE)),
    orbit=st.booleans(),
)
def test_round_trip_bit_for_bit(tmp_path, ending, data, rows, header, orbit):
    record = make_record(rows, 1, header, orbit)
    # any bits at all in two of the columns: infinities, every NaN, subnormal numbers, negative zero
    bits = data.draw(npst.arrays(np.uint64, (rows, 3)))
    columns = record.columns | {"force": bits.view(np.float64), "barrier": bits[:, 0].copy().view(np.float64)}
    record = FlightRecord(header, **columns)
    path = record.save(tmp_path / f"flight.{ending}")
    assert_same_bits(FlightRecord.load(path), record)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]  # no temporary file is left


@pytest.mark.parametrize("ending", ENDINGS)
@relaxed
@given(where=st.floats(0, 1, exclude_max=True), flip=st.integers(1, 255))
def test_a_damaged_byte_is_refused_or_harmless(tmp_path, ending, where, flip):
    record = make_record()
    path = record.save(tmp_path / f"flight.{ending}")
    content = bytearray(path.read_bytes())
    content[int(where * len(content))] ^= flip
    path.write_bytes(content)
    loaded, refusal = None, ""
    try:
        loaded = FlightRecord.load(path)
    except FlightError as error:
        refusal = str(error)
    if loaded is None:
        assert str(path) in refusal
        assert "\n" not in refusal
    else:
        assert_same_bits(loaded, record)


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("kept", [0.0, 0.01, 0.3, 0.7, 0.99, 0.9999])
def test_a_truncated_file_is_refused(tmp_path, ending, kept):
    path = make_record(200).save(tmp_path / f"flight.{ending}")
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content))])
    with pytest.raises(FlightError, match="damaged, truncated or not a flight file"):
        FlightRecord.load(path)


FOREIGN = {
    "parquet": lambda path: pq.write_table(pa.table({"position_x": [1.0, 2.0]}), path),
    "npz": lambda path: np.savez(path, position=np.zeros(3)),
    "pickled npz": lambda path: np.savez(path, keepout_flight=np.array([{"format": "keepout-flight"}], dtype=object)),
    "text": lambda path: path.write_text("time,position\n0,1\n"),
    "pickle": lambda path: path.write_bytes(pickle.dumps({"time": [0.0]})),
}


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("kind", FOREIGN)
def test_a_foreign_file_is_refused_in_one_line(tmp_path, kind, ending):
    made, path = tmp_path / ("made.npz" if "npz" in kind else "made"), tmp_path / f"flight.{ending}"
    FOREIGN[kind](made)
    made.rename(path)
    with pytest.raises(FlightError) as caught:
        FlightRecord.load(path)
    assert "\n" not in str(caught.value)


def test_missing_files_and_other_endings_are_refused(tmp_path):
    (tmp_path / "folder.npz").mkdir()
    (tmp_path / "file").write_text("")
    for name, said in (
        ("none.npz", "cannot be read"),
        ("folder.npz", "cannot be read"),
        ("a.csv", r"parquet or \.npz"),
    ):
        with pytest.raises(FlightError, match=said):
            FlightRecord.load(tmp_path / name)
    for name, said in (("a.pkl", r"parquet or \.npz"), ("file/flight.npz", "cannot be written")):
        with pytest.raises(FlightError, match=said):
            make_record().save(tmp_path / name)


@pytest.mark.parametrize("ending", ENDINGS)
def test_edited_and_later_files_are_refused(tmp_path, ending, monkeypatch):
    record = make_record()
    path = tmp_path / f"flight.{ending}"
    monkeypatch.setattr("keepout.core.flight.record.VERSION", 2)
    record.save(path)
    monkeypatch.undo()
    with pytest.raises(FlightError, match="format 2; this version of keepout reads format 1"):
        FlightRecord.load(path)
    monkeypatch.setattr("keepout.core.flight.record._digest", lambda *_: "0" * 64)
    record.save(path)
    monkeypatch.undo()
    with pytest.raises(FlightError, match="checksum"):
        FlightRecord.load(path)


def test_files_whose_columns_are_not_a_flight_are_refused(tmp_path):
    columns = make_record().columns
    for broken, match in [
        ({k: v for k, v in columns.items() if k != "force"}, "no column force"),
        (columns | {"extra": columns["time"]}, "unknown column extra"),
        (columns | {"force": columns["force"][:3]}, "force: float64 of shape"),
        (columns | {"time": columns["time"].astype(np.float32)}, "time: float32"),
    ]:
        path = record.write(tmp_path / "flight.npz", {}, broken)
        with pytest.raises(FlightError, match=match):
            FlightRecord.load(path)


@pytest.mark.parametrize("header", [{"a": object()}, {"a": float("nan")}, {"a": (1, 2)}, {"a": {1: 2}}])
def test_headers_that_json_does_not_hold_are_refused(tmp_path, header):
    with pytest.raises(FlightError, match="header"):
        make_record(header=header).save(tmp_path / "flight.npz")
    assert list(tmp_path.iterdir()) == []


def test_a_small_file_that_holds_much_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(record, "_MOST_BYTES", 2**20)
    np.savez_compressed(tmp_path / "bomb.npz", force=np.zeros(2**18))
    once = pa.DictionaryArray.from_arrays(pa.array(np.zeros(2**18, np.int8)), pa.array([0.0]))
    pq.write_table(pa.table({"time": once}), tmp_path / "bomb.parquet")
    for path in tmp_path.iterdir():
        assert path.stat().st_size < 2**16
        with pytest.raises(FlightError, match="bytes when inflated; at most 1048576 are read"):
            FlightRecord.load(path)
