"""Who flies a campaign's chunks, as it is written on the command line; a light import stays light."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from truths.command_line import keepout_command

from keepout.campaign import scheduler
from keepout.campaign.scheduler import Scheduler, flyer_on
from keepout.errors import ClusterError


@pytest.mark.parametrize("address", ["tcp://10.0.0.1:8786", "tls://head.example.org:1", "tcp://[::1]:65535"])
def test_an_address_is_taken_as_it_is(address):
    assert Scheduler.parse(address) == Scheduler(address=address)


def test_local_takes_every_core_or_as_many_as_said(monkeypatch):
    monkeypatch.setattr(scheduler, "available_cores", lambda: 6)
    assert Scheduler.parse("local").workers == 6
    assert Scheduler.parse("local:4").workers == 4


@pytest.mark.parametrize(
    "text", ["", "here", "10.0.0.1:8786", "tcp://host", "tcp://host:0", "tcp://host:65536", "tcp://:1"]
)
def test_what_is_no_scheduler_is_refused_with_what_would_be(text):
    with pytest.raises(ClusterError, match=r"scheduler: .* is not valid; valid are tcp://HOST:PORT.* local:N"):
        Scheduler.parse(text)


@pytest.mark.parametrize("text", ["local:0", "local:7", "local:", "local:-1", "local:two", "local:²"])
def test_more_processes_than_cores_are_refused(text, monkeypatch):
    monkeypatch.setattr(scheduler, "available_cores", lambda: 6)
    with pytest.raises(ClusterError, match="this process may use 6 cores; N must be 1 to 6"):
        Scheduler.parse(text)


def test_without_dask_the_line_that_installs_it_is_named(monkeypatch):
    monkeypatch.setattr(scheduler.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ClusterError, match=r"distributed is not installed; pip install 'keepout\[cluster\]'"):
        flyer_on("local:1")


def test_the_command_refuses_in_a_line_before_it_builds_anything(tmp_path):
    example = Path(__file__).parents[2] / "examples" / "case1.toml"
    answer = keepout_command("campaign", example, "-o", tmp_path / "out", "--scheduler", "host:8786")
    assert answer.code == 2
    assert "scheduler: 'host:8786' is not valid; valid are tcp://HOST:PORT" in " ".join(answer.err.split())
    assert not (tmp_path / "out").exists()


@pytest.mark.long
def test_nothing_imports_dask_unless_a_scheduler_is_given():
    modules = "keepout.cli, keepout.commands.campaign, keepout.campaign.scheduler"
    said = f"import sys, {modules}; print('distributed' in sys.modules)"
    answer = subprocess.run([sys.executable, "-c", said], capture_output=True, text=True, check=True, env=os.environ)
    assert answer.stdout.strip() == "False"
