"""What a rival is to `benchmarks/rivals.py`: a name, what must be installed, and a law for each start and goal."""

import abc
import dataclasses
import importlib.util
from typing import ClassVar

from keepout.core.control.law import Law
from rivals_laws.rival_case import Point, RivalCase


@dataclasses.dataclass(frozen=True)
class Rival(abc.ABC):
    """One method beside Keepout's, tuned: its numbers are its fields, and a row is flown again only if they change.

    A batch is flown in one compiled program, in which arrays that differ between its laws vary and all others are
    shared: the laws of a case must have the same tree (shapes, types and static fields), and what is common to them
    must be the same array object (build one prototype a case and replace what varies with `equinox.tree_at`).

    Attributes:
        name: in the rows.
        packages: modules that must be importable.
        recipe: raised where the code would fly otherwise with the same numbers.
        batch: flights in one compiled batch, where a law's arrays are large.
        choices: of its numbers by name, those that `rivals.py --sweep` flies, each with each.
        swept: pairs that a sweep flies, fewer where the rival is slow.
        more_seconds: that its flights may take longer than the others', where it slows down early.

    """

    name: ClassVar[str]
    packages: ClassVar[tuple[str, ...]] = ()
    recipe: ClassVar[int] = 1
    batch: ClassVar[int] = 128
    choices: ClassVar[dict[str, tuple[float, ...]]] = {}
    swept: ClassVar[int] = 64
    more_seconds: ClassVar[int] = 0

    @abc.abstractmethod
    def law(self, case: RivalCase, start: Point, goal: Point) -> Law:
        """Make the law of one flight, with all its planning: the time that this takes is the row's `plan_s`.

        Raises:
            KeepoutError: the rival cannot fly this pair; it counts as `refused`, with the message in `note`.

        """

    def flights(self, target: str) -> int | None:
        """Give the most flights round a target where the rival is slow; None for all."""
        return None

    def note(self, case: RivalCase) -> str:
        """Say in a few words what a reader of the row must know."""
        return ""

    @property
    def missing(self) -> str | None:
        """The pip line that installs what is missing; None where nothing is."""
        absent = [name for name in self.packages if importlib.util.find_spec(name) is None]
        return f"{', '.join(absent)} missing: pip install 'keepout-gnc[rivals]'" if absent else None

    @property
    def settings(self) -> dict:
        """What the row depends on, beside case and guard."""
        return {"rival": self.name, "recipe": self.recipe, **dataclasses.asdict(self)}
