"""A part that somebody else wrote, asked for one example: what it answers, or a refusal that says what it should."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from keepout.core.errors import KeepoutError

THREE_NUMBERS = "three finite numbers, an array (3,) of floats"


def is_own(part: Any) -> bool:
    """Whether a part is of a class that somebody else wrote."""
    return type(part).__module__.partition(".")[0] != "keepout"


@dataclass(frozen=True)
class Asked:
    """What a part is asked, and what it should answer.

    Attributes:
        part: what is asked, as `law: Mine.step`.
        wanted: what it should give, for a refusal.
        refusal: the error to raise.

    """

    part: str
    wanted: str
    refusal: type[KeepoutError]

    def tried(self, call: Callable[..., Any], *example: Any) -> Any:
        """Trace a call of the part, without computing anything: arrays come as their shapes and kinds.

        Raises:
            KeepoutError: of the kind `refusal`: the call fails, whatever the error is.

        """
        return self._answer(lambda: eqx.filter_eval_shape(call, *example))

    def computed(self, call: Callable[..., Any], *example: Any) -> Any:
        """Compute a call of the part; what raises is that of `tried`."""
        return self._answer(lambda: jax.block_until_ready(eqx.filter_jit(call)(*example)))

    def _answer(self, ask: Callable[[], Any]) -> Any:
        try:
            return ask()
        except KeepoutError:
            raise
        except Exception as error:
            lines = [line.strip() for line in str(error).splitlines() if line.strip()] or [""]
            # What a callback raised comes with its traceback, which ends with what it was.
            said = lines[-1] if any(line.startswith("Traceback") for line in lines) else lines[0]
            raise self.wrong(f"{type(error).__name__}: {said[:160]}") from error

    def wrong(self, found: str) -> KeepoutError:
        """Give the refusal of an answer: what was found, and what was wanted."""
        return self.refusal(f"{self.part}: {found}; it must give {self.wanted}")

    def require_numbers(self, answer: Any, shape: tuple[int, ...], kind: type = np.floating) -> None:
        """Refuse an answer, traced or computed, that is no array of this shape and kind, or has a number without end.

        Args:
            answer: of the part.
            shape: that it must have.
            kind: of its numbers, as NumPy names it.

        Raises:
            KeepoutError: of the kind `refusal`: it is another.

        """
        right = eqx.is_array_like(answer) or isinstance(answer, jax.ShapeDtypeStruct)
        right = right and np.shape(answer) == shape and np.issubdtype(jnp.result_type(answer), kind)
        shown = described(answer)
        if right and isinstance(answer, jax.Array | np.ndarray | np.generic):
            numbers = np.asarray(answer)
            right, shown = bool(np.isfinite(numbers).all()), f"{numbers.tolist()}"
        if not right:
            raise self.wrong(f"gives {shown}")

    def parts(self, answer: Any, count: int, last: type = object) -> tuple[Any, ...]:
        """Give the parts of an answer, refused where they are not so many, or the last one is of another class."""
        if not (isinstance(answer, tuple) and len(answer) == count and isinstance(answer[-1], last)):
            raise self.wrong(f"gives {described(answer)}")
        return answer

    def require_same(self, after: Any, before: Any) -> None:
        """Refuse a memory that is not made as the one before it, which a compiled flight cannot carry on.

        Raises:
            KeepoutError: of the kind `refusal`.

        """
        same = jax.tree.structure(after) == jax.tree.structure(before) and all(
            np.shape(now) == np.shape(then)
            and (jnp.result_type(now) == jnp.result_type(then) or getattr(then, "weak_type", False))
            for now, then in zip(jax.tree.leaves(after), jax.tree.leaves(before))
        )
        if not same:
            raise self.refusal(
                f"{self.part}: gives the memory {described(after)}; it must stay as it began, {described(before)}"
            )


def described(value: Any) -> str:
    """Say in a few words what an answer is: the shape and kind of arrays, the class of everything else."""
    if isinstance(value, jax.ShapeDtypeStruct | jax.Array | np.ndarray | np.generic):
        return f"{value.dtype}[{','.join(map(str, np.shape(value)))}]"
    if isinstance(value, tuple) and value and not hasattr(value, "_fields"):
        return f"({', '.join(map(described, value))})"
    return type(value).__name__
