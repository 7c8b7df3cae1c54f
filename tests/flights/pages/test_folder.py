"""The folder of results: there before anything is flown, and gone again where nothing came of it."""

import pytest

from keepout.core.errors import ScenarioError
from keepout.flights.pages.folder import results_in


def test_folders_made_for_nothing_go_again_and_others_stay(tmp_path):
    with pytest.raises(ScenarioError, match="refused"), results_in(tmp_path / "a" / "b"):
        raise ScenarioError("refused")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "a").mkdir()
    with pytest.raises(ScenarioError, match="refused"), results_in(tmp_path / "a"):
        raise ScenarioError("refused")
    assert (tmp_path / "a").is_dir()


def test_what_was_written_before_a_failure_stays(tmp_path):
    def stopped() -> None:
        (tmp_path / "out" / "flight.parquet").write_bytes(b"rows")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), results_in(tmp_path / "out"):
        stopped()
    assert (tmp_path / "out" / "flight.parquet").read_bytes() == b"rows"


def test_a_file_in_its_place_is_refused(tmp_path):
    (tmp_path / "out").write_text("")
    with pytest.raises(ScenarioError, match="give another folder"), results_in(tmp_path / "out"):
        pass
