"""A program of many small operations as one compiled kernel: the shortest time of a single call on a CPU.

XLA runs a program as a row of kernels over a table of buffers. Where every array holds a few numbers, filling the table
and going from kernel to kernel take several times as long as the arithmetic. Two rewrites, which leave the arithmetic
alone, and its order too but for products of matrices:

- a sum, product, extreme or conjunction over a few elements becomes a row of binary operations: every reduction brings
  three buffers of its own, those of its binary function;
- the program becomes one call with the mark by which XLA:CPU knows its own outlined small loops, and is compiled in one
  piece. Where XLA does not know the mark, the program is as correct, and slower.
"""

import contextlib
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
from jax import lax
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend.core import Jaxpr, JaxprEqn, Literal

from keepout.core.compiled.xla import NO_LIBRARIES

FEW = 16
"""Largest number of elements whose reduction is written out."""

_REDUCTIONS: dict[str, Callable[[Any, Any], Any]] = {
    "reduce_sum": lax.add,
    "reduce_prod": lax.mul,
    "reduce_max": lax.max,
    "reduce_min": lax.min,
    "reduce_and": lax.bitwise_and,
    "reduce_or": lax.bitwise_or,
}
_INLINED = ("jit", "closed_call", "custom_jvp_call", "custom_vjp_call")
"""Primitives that only call a program; what is differentiated has been differentiated by now."""


def compiled(function: Callable[..., Any], *arguments: Any) -> tuple[Callable[..., Any], bool]:
    """Compile a function for arguments of these shapes, in one kernel where that can be.

    Args:
        function: of arrays or trees of them.
        arguments: examples; only shapes and types count.

    Returns:
        The compiled function, and whether it is one kernel: on a CPU, and without operations that XLA hands to
        libraries (sorting, factorising, scattering) and cannot put into one.

    """
    if jax.default_backend() == "cpu":

        def marked(*args: Any) -> Any:
            with set_xla_metadata(xla_cpu_small_call="true", inlineable="false"):
                return jax.jit(written_out(function), inline=False)(*args)

        # What XLA refuses it says in several ways; an error of the function itself comes again below.
        with contextlib.suppress(jax.errors.JaxRuntimeError):
            return jax.jit(marked).lower(*arguments).compile(NO_LIBRARIES), True
    return jax.jit(function).lower(*arguments).compile(), False


def written_out(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the same function with its reductions over 1 to `FEW` elements written out."""

    @functools.wraps(function)
    def rewritten(*args: Any) -> Any:
        program, shapes = jax.make_jaxpr(function, return_shape=True)(*args)
        leaves = _evaluated(program.jaxpr, program.consts, jax.tree.leaves(args))
        return jax.tree.unflatten(jax.tree.structure(shapes), leaves)

    return rewritten


def _evaluated(program: Jaxpr, constants: Sequence[Any], arguments: Sequence[Any]) -> list[Any]:
    known = dict(zip([*program.constvars, *program.invars], [*constants, *arguments], strict=True))
    for equation in program.eqns:
        values = [v.val if isinstance(v, Literal) else known[v] for v in equation.invars]
        known.update(zip(equation.outvars, _applied(equation, values), strict=True))
    return [v.val if isinstance(v, Literal) else known[v] for v in program.outvars]


def _applied(equation: JaxprEqn, values: list[Any]) -> Sequence[Any]:
    name, parameters = equation.primitive.name, equation.params
    if name in _INLINED:
        inner = parameters["jaxpr"] if "jaxpr" in parameters else parameters["call_jaxpr"]
        return _evaluated(inner.jaxpr, inner.consts, values)
    # Over nothing there is nothing to write out: the plain reduction is a constant.
    if name in _REDUCTIONS and 0 < math.prod(values[0].shape[axis] for axis in parameters["axes"]) <= FEW:
        return [_reduced(_REDUCTIONS[name], values[0], parameters["axes"])]
    with equation.ctx.manager:
        answer = equation.primitive.bind(*values, **equation.primitive.get_bind_params(parameters))
    return answer if equation.primitive.multiple_results else [answer]


def _reduced(operation: Callable[[Any, Any], Any], x: Any, axes: Sequence[int]) -> Any:
    for axis in sorted(axes, reverse=True):
        x = functools.reduce(operation, [lax.index_in_dim(x, i, axis, keepdims=False) for i in range(x.shape[axis])])
    return x
