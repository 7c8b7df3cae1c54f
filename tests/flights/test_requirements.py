"""What a scenario requires, judged: each entry met and not met, at its limit; shares by their interval."""

import numpy as np
import pyarrow as pa
import pytest

from keepout.core.mission.scenario import Scenario
from keepout.core.mission.task_entries import RequireEntry
from keepout.flights.campaign.dataset import Words
from keepout.flights.requirements import failed, judged, judged_campaign, told

GOOD = {
    "contact_verdict": "no",
    "start_certified": True,
    "minimum_clearance_m": 0.0,
    "delta_v_mps": 0.0,
    "time_to_reach_s": 600.0,
    "reached": True,
}


@pytest.mark.parametrize(
    ("entry", "asked", "figure", "bad"),
    [
        ("contact", "proved", "contact_verdict", ("yes", "undecided")),
        ("certified", True, "start_certified", (False, None)),
        ("clearance_m", 0.0, "minimum_clearance_m", (-1e-12, float("nan"), -np.inf)),
        ("delta_v_mps", 0.0, "delta_v_mps", (1e-12, float("nan"))),
        ("time_s", 600.0, "time_to_reach_s", (600.1, None)),
        ("reached", True, "reached", (False,)),
    ],
)
def test_a_requirement_is_met_at_its_limit_and_not_beyond(entry, asked, figure, bad):
    scenario = Scenario(require={entry: asked})
    [row] = judged(scenario, GOOD)
    assert (row["entry"], row["met"], failed([row])) == (f"require.{entry}", True, [])
    for value in bad:
        [row] = judged(scenario, GOOD | {figure: value})
        [line] = failed([row])
        assert line.startswith(f"require.{entry}: ")
        assert told([row])[0]["verdict"] == "FAIL"
    [row] = judged(scenario, {key: value for key, value in GOOD.items() if key not in (figure, "reached")})
    assert row["met"] is None  # an inspection has no goal: that is neither met nor failed, and said


def test_nothing_is_required_unless_it_is_given():
    assert judged(Scenario(), {}) == judged(Scenario(require={"certified": False, "reached": False}), {}) == []


class Rows:
    """The columns of a campaign of `runs`, of which the last was refused."""

    def __init__(self, runs: int) -> None:
        flown = np.arange(runs) < runs - 1
        self.columns = {
            "status": Words.of(pa.chunked_array([np.where(flown, "flown", "refused")]).dictionary_encode(), str),
            "contact": Words.of(pa.chunked_array([["no"] * (runs - 1) + [None]]).dictionary_encode(), str),
            "reached": np.where(flown, 1.0, np.nan),
            "time_to_reach": np.where(flown, np.arange(runs, dtype=float), np.nan),
            "minimum_clearance": np.where(flown, 1.0, np.nan),
        }

    def arrays(self, names):
        return {name: self.columns[name] for name in names}


def test_a_share_is_judged_by_the_lower_end_of_its_interval_and_a_refused_run_meets_nothing():
    runs = 101
    asked = {"contact": "proved", "reached": True, "clearance_m": 0.5, "time_s": 1e6}
    # Of n runs of which all but one meet it, the lower end solves P(X >= n - 1) = 0.025: n p^(n-1) - (n-1) p^n.
    low = float(judged_campaign(RequireEntry(**asked), Rows(runs))[0]["low"])
    assert runs * low ** (runs - 1) - (runs - 1) * low**runs == pytest.approx(0.025)
    for share, met in ((None, False), (low - 1e-9, True), (low + 1e-9, False)):
        rows = judged_campaign(RequireEntry(**asked, share=share), Rows(runs))
        assert [row["met"] for row in rows] == [met] * 4
        assert {(row["count"], row["of"]) for row in rows} == {(runs - 1, runs)}
    [late] = judged_campaign(RequireEntry(time_s=50.0), Rows(runs))
    assert late["count"] == 51
