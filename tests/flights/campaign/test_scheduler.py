"""Who flies a campaign's chunks, as it is written on the command line."""

import pytest

from keepout.core.errors import ClusterError
from keepout.flights.campaign import run
from keepout.flights.campaign.run import flyer_on, scheduler_of


@pytest.mark.parametrize(
    ("text", "meant"),
    [
        ("tcp://10.0.0.1:8786", ("tcp://10.0.0.1:8786", 0)),
        ("tcp://[::1]:65535", ("tcp://[::1]:65535", 0)),
        ("local", ("", 6)),
        ("local:4", ("", 4)),
        *((text, r"scheduler: .* is not valid; valid are tcp://HOST:PORT.* local:N") for text in ("", "10.0.0.1:8786")),
        *((f"tcp://{end}", "is not valid; valid are tcp") for end in ("host", "host:0", "host:65536", ":1")),
        *((f"local:{n}", "may use 6 cores; N must be 1 to 6") for n in ("0", "7", "", "-1", "two", "²")),
    ],
)
def test_an_address_is_taken_as_it_is_and_local_as_so_many_cores_or_refused(text, meant, monkeypatch):
    monkeypatch.setattr(run, "available_cores", lambda: 6)
    if isinstance(meant, tuple):
        assert scheduler_of(text) == meant
    else:
        with pytest.raises(ClusterError, match=meant):
            scheduler_of(text)


def test_without_dask_the_line_that_installs_it_is_named(monkeypatch):
    monkeypatch.setattr(run.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ClusterError, match=r"distributed is not installed; pip install 'keepout-gnc\[cluster\]'"):
        flyer_on("local:1")
