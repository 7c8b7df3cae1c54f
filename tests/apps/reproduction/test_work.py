"""What a reproduction keeps: computed once, computed anew when anything it depends on changes, never half written."""

import numpy as np
import pytest

from keepout.apps.reproduction.work import Work
from keepout.core.errors import KeepoutError


class Counted:
    """A computation that counts how often it is made."""

    def __init__(self, value):
        self.value, self.times = value, 0

    def __call__(self):
        self.times += 1
        return self.value


def test_numbers_are_computed_once_and_anew_for_another_seed(tmp_path):
    make = Counted([{"a": 1.5, "b": None}])
    for _ in range(2):
        assert Work(tmp_path).numbers("rows", {"seed": 0}, make) == make.value
    assert make.times == 1
    Work(tmp_path).numbers("rows", {"seed": 1}, make)
    assert make.times == 2


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
