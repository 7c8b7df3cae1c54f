"""Results of campaigns whose numbers are known because a test wrote them."""

import numpy as np
import pyarrow.parquet as pq
import pytest
from scipy import stats
from truths.campaigns import drawn, flown, scenario, write_campaign

from keepout.core.errors import FlightError, ScenarioError
from keepout.flights.campaign.dataset import read_campaign
from keepout.flights.campaign.results import FIGURES, QUANTILES, compare, results


def world(runs, seed=0, **columns):
    return drawn(runs, seed) | flown(runs, **columns)


@pytest.fixture(scope="module")
def mixed(tmp_path_factory):
    """Of 1000 runs 40 refused, 3 with contact, 2 undecided, 50 that did not reach."""
    runs = 1000
    generator = np.random.default_rng(5)
    columns = world(runs)
    status = np.where(np.arange(runs) % 25 == 0, "refused", "flown")
    contact = np.full(runs, "no", object)
    contact[[1, 2, 3]], contact[[4, 6]] = "yes", "undecided"
    reached = np.ones(runs, bool)
    reached[101:151] = False
    masses = columns["chaser.mass"]
    reason = [f"chaser.mass: {m:.3f} kg at step {k}" if k % 50 else f"J2 of {k}" for k, m in enumerate(masses)]
    columns |= flown(
        runs,
        status=status,
        reason=np.where(status == "refused", reason, ""),
        contact=contact.astype(str),
        reached=reached,
        minimum_clearance=generator.permutation(runs) * 0.001,
        delta_v=masses**3,
        time_to_reach=np.where(reached, 100.0 + (columns["disturbance.kind"] == "paper"), np.inf),
        final_error=generator.random(runs),
    )
    folder = write_campaign(tmp_path_factory.mktemp("mixed") / "out", scenario(runs), columns, chunk=128)
    return results(read_campaign(folder)), columns


def test_rates_by_counting(mixed):
    found, columns = mixed
    fine = (columns["status"] == "flown") & columns["reached"] & (columns["contact"] == "no")
    not_reached = int(np.sum(~columns["reached"] & (columns["status"] == "flown")))
    assert {rate.name: (rate.count, rate.total) for rate in found.rates} == {
        "success: reached, no contact": (int(fine.sum()), 960),
        "reached": (960 - not_reached, 960),
        "contact": (3, 960),
        "undecided": (2, 960),
        "contact or undecided": (5, 960),
        "refused": (40, 1000),
    }
    for rate in found.rates:
        truth = stats.beta.ppf(0.975, rate.count + 1, rate.total - rate.count)
        assert rate.high == pytest.approx(truth)


def test_quantiles_are_those_of_numpy(mixed):
    found, columns = mixed
    for of in found.distributions:
        values = columns[of.figure.column][columns["status"] == "flown"]
        values = values[np.isfinite(values)]
        assert of.flights == len(values)
        assert of.quantiles == pytest.approx(np.quantile(values, QUANTILES, method="inverted_cdf"))
        # At the last of equal values the share is the empirical distribution's.
        last = np.r_[np.diff(of.curve) > 0.0, True]
        if len(np.unique(values)) == len(values):
            assert of.shares[last] == pytest.approx(stats.ecdf(values).cdf.evaluate(of.curve[last]))


def test_influences_are_scipys(mixed):
    columns = mixed[1]
    found = {(one.factor, one.figure): one for one in mixed[0].influences}
    flew = columns["status"] == "flown"
    assert found["chaser.mass", "delta_v"].correlation == pytest.approx(1.0, abs=1e-12)
    truth = stats.spearmanr(columns["start.position.x"][flew], columns["final_error"][flew])
    assert found["start.position.x", "final_error"].correlation == pytest.approx(truth.statistic)
    assert found["start.position.x", "final_error"].p_value == pytest.approx(truth.pvalue)
    assert found["start.position.z", "final_error"].correlation is None  # never varies
    kinds = columns["disturbance.kind"][flew]
    groups = [columns["final_error"][flew][kinds == kind] for kind in np.unique(kinds)]
    assert found["disturbance.kind", "final_error"].p_value == pytest.approx(stats.kruskal(*groups).pvalue)
    assert found["chaser.mass", "time_to_reach"].runs == int(np.sum(columns["reached"] & flew))


def test_a_choice_of_vectors_is_one_factor(tmp_path):
    runs = 300
    goals = np.array([[8.0, 0.0, 0.0], [0.0, 8.0, 0.0], [0.0, 0.0, 8.0]])
    pick = np.random.default_rng(0).integers(0, 3, runs)
    columns = {f"goal.position.{axis}": goals[pick, k] for k, axis in enumerate("xyz")}
    columns |= flown(runs, delta_v=pick.astype(float))
    of = scenario(runs, dispersions={"goal.position": {"choice": goals.tolist()}})
    found = results(read_campaign(write_campaign(tmp_path / "out", of, columns)))
    assert {one.factor for one in found.influences} == {"goal.position"}
    [strong] = [one for one in found.influences if one.figure == "delta_v"]
    assert strong.ratio == pytest.approx(1.0)
    assert found.scatters[0].factor.levels == ("0, 0, 8", "0, 8, 0", "8, 0, 0")


def test_worst_ten_and_refusals(mixed):
    found, columns = mixed
    flew = np.flatnonzero(columns["status"] == "flown")
    truth = flew[np.argsort(columns["minimum_clearance"][flew])[:10]]
    assert [row["run"] for row in found.worst] == truth.tolist()
    for row in found.worst:
        assert row["chaser.mass"] == columns["chaser.mass"][row["run"]]
        assert row["contact"] == columns["contact"][row["run"]]
    refused = np.flatnonzero(columns["status"] == "refused")
    assert {group.reason: group.runs for group in found.refusals} == {
        "J2 of #": tuple(k for k in refused if k % 50 == 0),
        "chaser.mass: # kg at step #": tuple(k for k in refused if k % 50),
    }
    assert found.refusals[0].example == columns["reason"][found.refusals[0].runs[0]]


def test_unfinished_torn_and_foreign_parts_are_left_out(tmp_path):
    folder = write_campaign(tmp_path / "out", scenario(1000), world(1000), chunk=100, done=7)
    torn = folder / "flights" / "part-00002.parquet"
    torn.write_bytes(torn.read_bytes()[:-40])
    (folder / "bands" / "part-00004.npz").write_bytes(b"")
    (folder / "flights" / "part-x.parquet").write_bytes(b"")
    other = write_campaign(tmp_path / "other", scenario(1000, seed=1), world(1000), chunk=100)
    (other / "flights" / "part-00006.parquet").replace(folder / "flights" / "part-00006.parquet")
    reading = read_campaign(folder)
    assert reading.parts == (0, 1, 3, 5)
    assert not reading.complete
    assert results(reading).runs == 400


def test_a_changed_byte_and_a_missing_row_are_damage_and_another_format_is_refused(tmp_path):
    folder = write_campaign(tmp_path / "out", scenario(2000), world(2000), chunk=2000)
    part = folder / "flights" / "part-00000.parquet"
    whole = pq.read_table(part)
    content = bytearray(part.read_bytes())
    content[len(content) // 2] ^= 0xFF
    part.write_bytes(bytes(content))
    with pytest.raises(FlightError, match="damaged"):
        results(read_campaign(folder))
    pq.write_table(whole.slice(0, 1999), part)
    with pytest.raises(FlightError, match="damaged \\(1999 rows for the runs 0 to 1999\\)"):
        results(read_campaign(folder))
    identity = folder / "campaign.json"
    identity.write_text(identity.read_text().replace('"format": 2', '"format": 1'))
    with pytest.raises(ScenarioError, match=r"campaign\.json: format 1; this version of Keepout reads 2"):
        read_campaign(folder)
    with pytest.raises(ScenarioError, match="no campaign was flown here"):
        read_campaign(tmp_path)
    with pytest.raises(FlightError, match="none of its 1 parts is done"):
        results(read_campaign(write_campaign(tmp_path / "none", scenario(10), world(10), done=0)))


@pytest.mark.parametrize("runs", [1, 5])
def test_degenerate_campaigns(tmp_path, runs):
    cases = {
        "fine": world(runs),
        "not reached": world(runs, reached=False, time_to_reach=np.inf),
        "refused": world(runs, status="refused", reason="no"),
        "not finite": world(runs, contact="undecided", minimum_clearance=-np.inf, final_error=np.nan, reached=False),
    }
    for name, columns in cases.items():
        found = results(read_campaign(write_campaign(tmp_path / name, scenario(runs), columns)))
        assert found.flown == (0 if name == "refused" else runs)
        assert len(found.worst) == found.flown
        assert len(found.distributions) == len(FIGURES)


class TestCompare:
    runs = 600

    def write(self, folder, seed=0, of=None, **columns):
        of = scenario(self.runs, seed=seed) if of is None else of
        return read_campaign(write_campaign(folder, of, world(self.runs, seed, **columns), chunk=128))

    def test_pairs_are_found_and_counted(self, tmp_path):
        a_reached = np.arange(self.runs) % 10 != 0
        b_reached = np.arange(self.runs) % 15 != 0
        first = self.write(tmp_path / "a", reached=a_reached, delta_v=np.arange(self.runs) + 1.0)
        second = self.write(tmp_path / "b", reached=b_reached, delta_v=np.arange(self.runs) + 1.5)
        found = compare(first, second)
        assert found.paired == self.runs
        [rate] = [one for one in found.rates if one.first.name == "reached"]
        both, first_only = int(np.sum(a_reached & b_reached)), int(np.sum(a_reached & ~b_reached))
        second_only = int(np.sum(~a_reached & b_reached))
        assert rate.pairs == (both, first_only, second_only, self.runs - both - first_only - second_only)
        assert rate.difference == pytest.approx(a_reached.mean() - b_reached.mean())
        assert rate.p_value == pytest.approx(stats.binomtest(first_only, first_only + second_only).pvalue)
        [by_run] = [one for one in found.differences if one.figure.name == "delta_v"]
        assert {by_run.row[of] for of in ("mean A - B", "median A - B", "mean low", "median high")} == {-0.5}
        assert (by_run.row["A lower"], by_run.row["A higher"]) == (self.runs, 0)
        assert by_run.row["p of sign"] == pytest.approx(2.0**-self.runs * 2.0)

    def test_another_seed_makes_no_pairs(self, tmp_path):
        found = compare(self.write(tmp_path / "a", delta_v=1.0), self.write(tmp_path / "b", seed=1, delta_v=3.0))
        assert found.paired is None
        assert not found.differences
        assert ("seed", 0, 1) in found.differing
        assert [row["A - B"] for row in found.quantiles if row["figure"] == "Δv, m/s"] == [-2.0] * 7

    def test_a_run_that_drew_something_else_is_no_pair(self, tmp_path):
        columns = world(self.runs)
        columns["start.position.x"][7] += 1e-12
        columns["disturbance.kind"] = columns["disturbance.kind"].astype(object)
        columns["disturbance.kind"][9] = "another"
        second = read_campaign(write_campaign(tmp_path / "b", scenario(self.runs), columns, chunk=50))
        found = compare(self.write(tmp_path / "a"), second)
        assert (found.paired, found.unlike) == (self.runs - 2, 2)

    def test_sobol_pairs_need_as_many_runs(self, tmp_path):
        columns = {name: values[:300] for name, values in world(self.runs).items()}
        for sampling, paired in (("sobol", None), ("random", 300)):
            first = self.write(tmp_path / f"{sampling} a", of=scenario(self.runs, sampling=sampling))
            second = write_campaign(tmp_path / f"{sampling} b", scenario(300, sampling=sampling), columns)
            assert compare(first, read_campaign(second)).paired == paired

    def test_only_finished_ones_with_columns_in_common(self, tmp_path):
        first = self.write(tmp_path / "a")
        part = write_campaign(tmp_path / "b", scenario(1000), world(1000), chunk=100, done=3)
        with pytest.raises(ScenarioError, match="3 of 10 parts are done"):
            compare(first, read_campaign(part))
        other = write_campaign(tmp_path / "c", scenario(10), {"status_": np.zeros(10), "status": np.full(10, "x")})
        with pytest.raises((ScenarioError, FlightError), match="column"):
            compare(first, read_campaign(other))


def test_many_parts_are_read_in_their_order_whatever_texts_each_has(tmp_path):
    """More parts than are decoded together, each with texts that the others have not."""
    runs = 420
    columns = world(runs) | {"disturbance.kind": np.array([f"kind {k // 7}" for k in range(runs)])}
    folder = write_campaign(tmp_path / "out", scenario(runs), columns, chunk=3)
    read = read_campaign(folder).arrays(["run", "disturbance.kind", "chaser.mass"])
    kinds = read["disturbance.kind"]
    assert [kinds.values[k] for k in kinds.codes] == columns["disturbance.kind"].tolist()
    np.testing.assert_array_equal(read["chaser.mass"], columns["chaser.mass"])
    np.testing.assert_array_equal(read["run"], np.arange(runs))


def test_a_column_of_before_is_read_by_its_name_of_today(tmp_path):
    columns = world(10) | {"measured_clearance": np.arange(10.0)}
    folder = write_campaign(tmp_path / "old", scenario(10), columns, chunk=4)
    for path in folder.rglob("*.parquet"):
        table = pq.read_table(path)
        before = [{"measured_clearance": "minimum_clearance_found"}.get(name, name) for name in table.column_names]
        pq.write_table(table.rename_columns(before).replace_schema_metadata(table.schema.metadata), path)
    read = read_campaign(folder)
    asked = ["run", "measured_clearance"]
    assert set(asked) <= set(read.names) == set(read.table().column_names)
    np.testing.assert_array_equal(read.arrays(asked)["measured_clearance"], np.arange(10.0))
    assert read.rows([7], asked) == [{"run": 7, "measured_clearance": 7.0}]
    assert read.part(1, ["measured_clearance"]).column_names == ["measured_clearance"]
