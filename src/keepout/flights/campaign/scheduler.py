"""Who flies a campaign's chunks, as `--scheduler` names it; what needs no cluster never imports one."""

import importlib.util
import re
from dataclasses import dataclass

from keepout.core.cores import available_cores
from keepout.core.errors import ClusterError
from keepout.flights.campaign.run import Flyer

VALID = "valid are tcp://HOST:PORT, tls://HOST:PORT, local and local:N"
_ADDRESS = re.compile(r"(?:tcp|tls)://(?:\[[0-9a-fA-F:.]+\]|[^\s/:\[\]]+):(\d{1,5})")


@dataclass(frozen=True)
class Scheduler:
    """Where chunks are handed to.

    Attributes:
        address: of a running `dask.distributed` scheduler; empty where workers are started here.
        workers: processes to start here.

    """

    address: str = ""
    workers: int = 0

    @classmethod
    def parse(cls, text: str) -> "Scheduler":
        """Read an address, or `local` (a process for each core that this one may use) or `local:N`.

        Raises:
            ClusterError: neither, or more processes than cores.

        """
        kind, colon, count = text.partition(":")
        if kind == "local":
            cores = available_cores()
            if colon and not (count.isascii() and count.isdigit() and 1 <= int(count) <= cores):
                raise ClusterError(f"scheduler: {text}: this process may use {cores} cores; N must be 1 to {cores}")
            return cls(workers=int(count) if colon else cores)
        found = _ADDRESS.fullmatch(text)
        if found is None or not 1 <= int(found[1]) <= 65535:
            raise ClusterError(f"scheduler: {text!r} is not valid; {VALID}")
        return cls(address=text)


def flyer_on(scheduler: str, *, mixed_processors: bool = False) -> Flyer:
    """Give who flies chunks on a cluster, or on processes started here.

    Args:
        scheduler: as for `Scheduler.parse`.
        mixed_processors: whether workers with processors of several kinds may fly one campaign. The same chunk then
            has other last bits on another kind; each part of the table names its own (`Dataset.processors`).

    Raises:
        ClusterError: not valid, or `dask.distributed` is not installed.

    """
    parsed = Scheduler.parse(scheduler)
    missing = [name for name in ("distributed", "cryptography") if importlib.util.find_spec(name) is None]
    if missing:
        raise ClusterError(f"scheduler: {missing[0]} is not installed; pip install 'keepout[cluster]'")
    from keepout.flights.campaign.cluster import Cluster

    return Cluster(parsed.address, workers=parsed.workers, mixed_processors=mixed_processors)
