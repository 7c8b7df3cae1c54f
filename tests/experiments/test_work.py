"""What a reproduction keeps: computed once, computed anew when anything it depends on changes, never half written."""

import numpy as np
import pytest

from keepout import experiments
from keepout.errors import KeepoutError, ScenarioError, UsageError
from keepout.experiments.part import Part, Table
from keepout.experiments.work import Work
from keepout.report.reproduction import Drawing
from keepout.report.style import figure


class Counted:
    """A computation that counts how often it is made."""

    def __init__(self, value):
        self.value, self.times = value, 0

    def __call__(self):
        self.times += 1
        return self.value


def test_numbers_are_computed_once(tmp_path):
    make = Counted([{"a": 1.5, "b": None}])
    for _ in range(2):
        assert Work(tmp_path).numbers("rows", {"seed": 0}, make) == make.value
    assert make.times == 1


def test_another_seed_is_computed_anew(tmp_path):
    make = Counted([1])
    Work(tmp_path).numbers("rows", {"seed": 0}, make)
    Work(tmp_path).numbers("rows", {"seed": 1}, make)
    assert make.times == 2


def test_arrays_come_back_to_the_bit(tmp_path):
    make = Counted({"path": np.random.default_rng(0).normal(size=(7, 3)), "flag": np.array([True, False])})
    first = Work(tmp_path).arrays("flight", 0, make)
    again = Work(tmp_path).arrays("flight", 0, make)
    assert make.times == 1
    for name, array in make.value.items():
        np.testing.assert_array_equal(first[name], array)
        np.testing.assert_array_equal(again[name], array)
        assert again[name].dtype == array.dtype


def test_work_that_fails_leaves_nothing_kept(tmp_path):
    def fails():
        raise RuntimeError("killed")

    with pytest.raises(RuntimeError):
        Work(tmp_path).numbers("rows", 0, fails)
    make = Counted([2])
    assert Work(tmp_path).numbers("rows", 0, make) == [2]
    assert make.times == 1


@pytest.mark.parametrize("kind", ["numbers", "arrays"])
def test_a_damaged_file_is_named(tmp_path, kind):
    """Such as one cut short by a disk that lost power."""
    value = [1] if kind == "numbers" else {"a": np.zeros(2)}
    getattr(Work(tmp_path), kind)("rows", 0, Counted(value))
    [path] = (tmp_path / "kept").iterdir()
    path.write_bytes(path.read_bytes()[:2])
    with pytest.raises(KeepoutError, match=path.name):
        getattr(Work(tmp_path), kind)("rows", 0, Counted(value))


def small(work: Work) -> Part:
    with figure(work.folder / "line.png", width=2.0, height=2.0, vector=True) as drawing:
        drawing.add_subplot().plot([0.0, 1.0])
    table = Table("numbers", "Numbers, m", [{"name": "one", "value": 1.25}, {"name": "<two>", "value": None}])
    return Part(
        "small", "A small part", "The paper says one.", ["Ours says 1.25."], [{"name": "one", "trapped": False}],
        tables=[table], drawings=[Drawing("line", "A line")],
    )  # fmt: skip


def test_a_run_leaves_a_page_its_tables_and_its_figures(tmp_path, monkeypatch):
    monkeypatch.setattr(experiments, "PARTS", {"small": small})
    [part] = experiments.reproduce(["all"], tmp_path, quick=True)
    assert part.rows == [{"name": "one", "trapped": False}]
    assert (tmp_path / "small" / "numbers.csv").read_text() == "name,value\none,1.25\n<two>,\n"
    assert (tmp_path / "small" / "line.svg").read_text().startswith("<?xml")
    page = (tmp_path / "index.html").read_text(encoding="utf-8")
    for said in ("The paper says one.", "Ours says 1.25.", "&lt;two&gt;", "quick run", 'href="small/numbers.csv"'):
        assert said in page
    assert "http" not in page.replace("http://www.w3.org", "")


def test_an_unknown_part_names_those_that_there_are(tmp_path, monkeypatch):
    monkeypatch.setattr(experiments, "PARTS", {"small": small})
    with pytest.raises(UsageError, match="'case7' is not known; valid: all, small"):
        experiments.reproduce(["case7"], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_folder_of_fields_that_is_not_there_is_told_first(tmp_path, monkeypatch):
    monkeypatch.setattr(experiments, "PARTS", {"small": small})
    with pytest.raises(ScenarioError, match="--fields"):
        experiments.reproduce(["all"], tmp_path / "out", fields=tmp_path / "absent")
    assert not (tmp_path / "out").exists()
