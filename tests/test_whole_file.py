"""The small machinery that every room uses: files written whole, digests, and progress of a part."""

import os
import threading

import pytest

from keepout.core.errors import FlightError, KeepoutError
from keepout.core.progress import moving, never_back, silent
from keepout.core.whole_file import write_whole
from keepout.flights.pages.folder import write_summary


def test_a_file_is_written_into_a_new_folder_with_the_permissions_of_any_new_file(tmp_path):
    path = tmp_path / "new" / "file.txt"
    write_whole(path, "κ\n")
    assert path.read_bytes() == "κ\n".encode()
    (tmp_path / "other").touch()
    assert path.stat().st_mode == (tmp_path / "other").stat().st_mode
    write_whole(path, b"second")
    assert path.read_bytes() == b"second"
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("broken", ["fsync", "replace"])
def test_a_disk_that_fails_halfway_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch, broken):
    path = tmp_path / "file"
    write_whole(path, b"old")

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(*((os, "fsync") if broken == "fsync" else (type(path), "replace")), fail)
    with pytest.raises(FlightError, match="file: cannot be written: No space left on device"):
        write_whole(path, b"new and longer", refusal=FlightError)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_place_that_is_no_folder_is_refused_in_one_line(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(KeepoutError, match="cannot be written") as refusal:
        write_whole(tmp_path / "file" / "inside", b"")
    assert "\n" not in str(refusal.value)


def test_a_summary_that_json_does_not_hold_leaves_the_old_one(tmp_path):
    write_summary(tmp_path, {"reached": True})
    with pytest.raises(ValueError, match="JSON compliant"):
        write_summary(tmp_path, {"reached": float("nan")})
    assert (tmp_path / "summary.json").read_text() == '{\n  "reached": true\n}\n'


def test_progress_never_goes_back():
    told = []
    progress = never_back(lambda fraction, message: told.append((fraction, message)))
    for fraction, message in ((0.2, "a"), (0.1, "b"), (0.5, "c")):
        progress(fraction, message)
    assert told == [(0.2, "a"), (0.2, "b"), (0.5, "c")]


def test_progress_moves_while_work_cannot_say_how_far_it_is():
    told, enough = [], threading.Event()

    def report(fraction, message):
        told.append((fraction, message))
        if len(told) == 3:
            enough.set()

    with moving(report, 0.2, 0.4, "compiled", usual=1.0):
        assert enough.wait(60.0)
    fractions = [fraction for fraction, _ in told]
    assert fractions[0] == 0.2
    assert fractions == sorted(set(fractions))
    assert fractions[-1] < 0.4
    assert told[1][1].startswith("compiled, ")
    before = threading.active_count()
    with moving(silent, 0.0, 1.0, "", usual=1.0):
        assert threading.active_count() == before
