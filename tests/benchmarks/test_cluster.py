"""The plan on paper in docs/clusters.md is what the benchmark says of its kept figures."""

import json
from pathlib import Path

import pytest

pytest.importorskip("distributed", reason="needs keepout[cluster]")

import cluster

ROOT = Path(__file__).parents[2]
KEPT = ROOT / "benchmarks" / "results" / "cluster.json"


def test_the_plan_of_the_docs_is_that_of_the_kept_figures(capsys):
    measured = json.loads(KEPT.read_text())["measured"]
    cluster.show(measured, cluster.plan_of(measured, 1e9, 32))
    page = (ROOT / "docs" / "clusters.md").read_text()
    assert f"```text\n{capsys.readouterr().out}```" in page


def test_a_plan_by_hand():
    measured = {
        "runs_a_chunk": 100,
        "core_seconds_a_flight": 0.36,
        "table_bytes_a_flight": 200.0,
        "bands_bytes_a_chunk": 1000.0,
        "write_seconds_a_chunk": 0.036,
        "first_chunk_core_seconds": 36.0,
    }
    plan = cluster.plan_of(measured, 1e6, 10)
    assert plan["core_hours"] == pytest.approx(100.0)
    assert (plan["table_bytes"], plan["bands_bytes"], plan["files"]) == pytest.approx((2e8, 1e7, 2e4))
    assert plan["hours_of_writing"] == pytest.approx(0.1)
    assert [row["machines"] for row in plan["in"]] == [10, 1, 1]
    assert plan["in"][0]["share_of_compiling"] == pytest.approx(0.01)
