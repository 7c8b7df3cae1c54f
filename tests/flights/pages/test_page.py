"""Head and foot of every page, and the axes of its figures: what they say, and what they do not draw over."""

import html
import itertools
import re
import tomllib

import numpy as np
import pytest
from truths.passing import box_scenario
from truths.results import Page as Read

from keepout.core.errors import ExchangeError, UsageError
from keepout.core.mission.scenario import Scenario
from keepout.flights.pages.figures import drawn, logarithmic, looks
from keepout.flights.pages.filmed import require_film
from keepout.flights.pages.page import Page, Provenance, as_toml, verdict_of

FREE = {"contact_verdict": "no", "minimum_clearance_m": 0.25, "start_certified": True, "guard": {"R": 1.0}}


@pytest.mark.parametrize(
    ("changed", "good", "said", "theorem"),
    [
        ({}, True, "at least 0.250 m", "The guard's theorem held"),
        ({"guard_flags": {"command": 2}}, True, "No contact, proved", "The guard's theorem held"),
        ({"guard_flags": {"off_plan": 2}}, True, "No contact, proved", "saw an assumption fail: off plan in 2 steps"),
        ({"assumptions_broken": ["noise 2 > 1"]}, True, "No contact, proved", "does not hold: it was flown beyond"),
        ({"start_certified": False}, True, "No contact, proved", "does not hold: the start"),
        ({"guard": None, "start_certified": None}, True, "No contact, proved", "No guard flew"),
        ({"contact_verdict": "yes"}, False, "Contact.", "The guard's theorem held"),
        ({"contact_verdict": "undecided"}, False, "Contact not excluded.", "The guard's theorem held"),
    ],
)
def test_the_head_tells_every_case_apart(changed, good, said, theorem):
    verdict = verdict_of(FREE | changed)
    assert verdict.good is good
    assert said in verdict.said
    assert theorem in verdict.theorem


@pytest.mark.long
def test_the_foot_holds_the_whole_scenario_and_is_the_same_at_the_same_time(tmp_path, monkeypatch):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "86400")
    dispersions = {"chaser.mass": {"uniform": [18.0, 22.0]}, "goal.position": {"choice": [[0, -9, 1], [1, -9, 1]]}}
    scenario = box_scenario(
        tmp_path,
        3.0,
        "named",
        campaign={"runs": 4, "dispersions": dispersions},
        field={"source": 'a "b" </pre>.keepout'},
    )
    written = []
    for name in ("one.html", "other.html"):
        made = Provenance({"": scenario}, {"mesh": "ab" * 32}, scenario.seed)
        page = Page(tmp_path / name, "A title", verdict_of(FREE), made)
        page.heading("Part")
        page.write()
        written.append((tmp_path / name).read_text(encoding="utf-8"))
    assert written[0] == written[1]
    assert Read.read(tmp_path / "one.html").unclosed == []
    [told] = re.findall("<pre>(.*?)</pre>", written[0], re.DOTALL)
    assert html.unescape(told) == as_toml(scenario)
    assert Scenario.parse(tomllib.loads(html.unescape(told))) == scenario
    for words in ("1970-01-02 00:00 UTC", "ab" * 32, "keepout 0", "machine", "command"):
        assert words in written[0]


def test_ten_flights_have_ten_looks_and_so_have_35():
    for printed in (False, True):
        assert len({(look["color"], look["linestyle"]) for look in looks(35, printed=printed)}) == 35


@pytest.mark.parametrize("range_", [(1.508e-5, 1.5081e-5), (0.11, 0.19), (0.02, 0.9), (3e-7, 40.0), (2.0, 2.0)])
def test_labels_of_a_logarithmic_axis_do_not_lie_over_each_other(range_):
    with drawn(width=1.7, height=1.6, small=True) as drawing:
        axes = drawing.add_subplot()
        axes.plot(np.linspace(*range_, 9), np.linspace(0.0, 1.0, 9))
        logarithmic(axes, "x", ticks=4)
        drawing.canvas.draw()
        boxes = [label.get_window_extent() for label in axes.get_xticklabels() if label.get_text()]
        shown = sorted(
            (box.x0, box.x1) for box in boxes if axes.bbox.x0 - 1 <= 0.5 * (box.x0 + box.x1) <= axes.bbox.x1 + 1
        )
    assert shown
    assert all(one[1] < other[0] for one, other in itertools.pairwise(shown))


def test_a_film_is_refused_before_any_work_where_there_is_no_browser(tmp_path, monkeypatch):
    with pytest.raises(UsageError, match=r"film\.mov.*\.mp4, \.gif, \.webp, \.png"):
        require_film(tmp_path / "film.mov")
    monkeypatch.delenv("KEEPOUT_CHROMIUM", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ExchangeError, match=r"film\.gif: no browser to film in .*KEEPOUT_CHROMIUM"):
        require_film(tmp_path / "film.gif")
