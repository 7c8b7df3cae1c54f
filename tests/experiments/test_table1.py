"""Table I and the surfaces, by the quick run around one target."""

import csv

import pytest

from keepout.experiments import surfaces, table1
from keepout.experiments.work import Work
from keepout.fields.shipped import load_shipped
from keepout.report.reproduction import write_table

pytestmark = [pytest.mark.long, pytest.mark.xdist_group("table1")]


@pytest.fixture
def one_target(monkeypatch):
    for module in (table1, surfaces):
        monkeypatch.setattr(module, "TARGETS", {"intelsat30": "Intersat-30"})


def test_table_1_of_one_target_and_its_kept_numbers(one_target, tmp_path, monkeypatch):
    part = table1.table1(Work(tmp_path, quick=True))
    errors = {(row["field"], row["points"]): row for row in part.rows if row["table"] == "errors"}
    printed, shipped = errors["paper, no units", "all"], errors["shipped, δ = 30 mm", "all"]
    assert (printed["epsilon"], printed["epsilon_plus"], printed["e_h_sampled"]) == (0.0015, 0.0014, 0.031)
    back = errors["shipped, δ = 30 mm, added back", "all"]
    proved = load_shipped("intelsat30").certificate(0.0)
    assert shipped["e_h_proved"] == proved.error_bound
    for key in ("e_h_sampled", "e_h_found", "e_h_proved"):
        assert back[key] == pytest.approx(shipped[key] + 0.03)
    assert shipped["e_h_sampled"] <= shipped["e_h_found"] <= shipped["e_h_proved"]
    assert shipped["epsilon"] == pytest.approx(0.038, abs=0.001)  # docs/results.md
    assert back["epsilon"] < 0.3 * shipped["epsilon"]
    gradient = next(row for row in part.rows if row["table"] == "gradient_error")
    assert 0.0 < gradient["mean"] < gradient["percentile_95"] < gradient["maximum"] <= 2.5
    with write_table(tmp_path, part.tables[0]).open(encoding="utf-8") as stream:
        assert len(list(csv.DictReader(stream))) == len(errors)
    monkeypatch.setattr(table1, "values", lambda *_: pytest.fail("computed anew"))
    monkeypatch.setattr(table1, "gradient_errors", lambda *_, **__: pytest.fail("computed anew"))
    assert table1.table1(Work(tmp_path, quick=True)).rows == part.rows
    with pytest.raises(BaseException, match="computed anew"):
        table1.table1(Work(tmp_path, quick=True, seed=1))


def test_surfaces_are_cut_once_measured_and_drawn(one_target, tmp_path, monkeypatch):
    done: list[float] = []
    part = surfaces.surfaces(Work(tmp_path, quick=True, progress=lambda fraction, _: done.append(fraction)))
    assert 0.0 == done[0] < done[-1] < 1.0  # the figures are drawn after the last of it
    assert done == sorted(done)
    (row,) = part.rows
    assert 0.5 * 0.03 < row["Chamfer m"] < row["p95 m"] < row["Hausdorff m"] < 0.5
    for drawing in part.drawings:
        for form in ("png", "svg"):
            assert (tmp_path / f"{drawing.name}.{form}").stat().st_size > 10_000
    monkeypatch.setattr(surfaces, "extract_surface", lambda *_, **__: pytest.fail("cut again"))
    monkeypatch.setattr(surfaces, "surface_distance", lambda *_, **__: pytest.fail("measured again"))
    assert surfaces.surfaces(Work(tmp_path, quick=True)).rows == part.rows
