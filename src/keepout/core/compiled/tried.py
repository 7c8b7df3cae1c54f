"""A part that somebody else wrote, asked for one example: what it answers, or a refusal that says what it should."""

from collections.abc import Callable
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


def tried(call: Callable[..., Any], *example: Any, part: str, wanted: str, refusal: type[KeepoutError]) -> Any:
    """Trace a call of somebody else's, without computing anything: arrays come as their shapes and kinds.

    Args:
        call: of the part.
        example: its arguments.
        part: what is asked, as `law: Mine.step`.
        wanted: what it should give, for a refusal.
        refusal: the error to raise.

    Raises:
        KeepoutError: of the kind `refusal`: the call fails, whatever the error is.

    """
    return _answer(lambda: eqx.filter_eval_shape(call, *example), part, wanted, refusal)


def computed(call: Callable[..., Any], *example: Any, part: str, wanted: str, refusal: type[KeepoutError]) -> Any:
    """Compute a call of somebody else's; the arguments are those of `tried`, and what raises as well."""
    return _answer(lambda: jax.block_until_ready(eqx.filter_jit(call)(*example)), part, wanted, refusal)


def _answer(ask: Callable[[], Any], part: str, wanted: str, refusal: type[KeepoutError]) -> Any:
    try:
        return ask()
    except KeepoutError:
        raise
    except Exception as error:
        lines = [line.strip() for line in str(error).splitlines() if line.strip()] or [""]
        # What a callback raised comes with its traceback, which ends with what it was.
        said = lines[-1] if any(line.startswith("Traceback") for line in lines) else lines[0]
        raise refusal(f"{part}: {type(error).__name__}: {said[:160]}; it must give {wanted}") from error


def require_numbers(
    answer: Any,
    shape: tuple[int, ...],
    *,
    kind: type = np.floating,
    part: str,
    wanted: str,
    refusal: type[KeepoutError],
) -> None:
    """Refuse an answer, traced or computed, that is no array of this shape and kind, or has a number without end.

    Args:
        answer: of the part.
        shape: that it must have.
        kind: of its numbers, as NumPy names it.
        part: as of `tried`.
        wanted: likewise.
        refusal: likewise.

    Raises:
        KeepoutError: of the kind `refusal`: it is another.

    """
    if not eqx.is_array_like(answer) and not isinstance(answer, jax.ShapeDtypeStruct):
        right = False
    else:
        right = np.shape(answer) == shape and np.issubdtype(jnp.result_type(answer), kind)
    shown = described(answer)
    if right and isinstance(answer, jax.Array | np.ndarray | np.generic):
        numbers = np.asarray(answer)
        right, shown = bool(np.isfinite(numbers).all()), f"{numbers.tolist()}"
    if not right:
        raise refusal(f"{part}: gives {shown}; it must give {wanted}")


def require_same(after: Any, before: Any, *, part: str, refusal: type[KeepoutError]) -> None:
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
        raise refusal(f"{part}: gives the memory {described(after)}; it must stay as it began, {described(before)}")


def described(value: Any) -> str:
    """Say in a few words what an answer is: the shape and kind of arrays, the class of everything else."""
    if isinstance(value, jax.ShapeDtypeStruct | jax.Array | np.ndarray | np.generic):
        return f"{value.dtype}[{','.join(map(str, np.shape(value)))}]"
    if isinstance(value, tuple) and value and not hasattr(value, "_fields"):
        return f"({', '.join(map(described, value))})"
    return type(value).__name__
