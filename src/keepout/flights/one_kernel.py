"""A program of many small operations as one compiled kernel: the shortest time of a single call on a CPU.

XLA runs a program as a row of kernels over a table of buffers. Where every array holds a few numbers, filling the table
and going from kernel to kernel take several times as long as the arithmetic. Three rewrites, which leave the arithmetic
alone, and its order too but for products of matrices, in the branches of conditions as well. (Compiled in one piece, a
product may be contracted with the sum that it goes into, and so differ in its last bit.)

- a sum, product, extreme or conjunction over a few elements becomes a row of binary operations: every reduction brings
  three buffers of its own, those of its binary function;
- constants become parts of one: each is a buffer, which is allocated at every call, as is all that XLA would work out
  from them beforehand;
- the program becomes one call with the mark by which XLA:CPU knows its own outlined small loops, and is compiled in one
  piece. Where XLA does not know the mark, the program is as correct, and slower.
"""

import contextlib
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal

from keepout.core.compiled.xla import NO_LIBRARIES

FEW = 16
"""Largest number of elements whose reduction is written out."""
_SMALL = 64
"""Largest number of elements of a constant that is put into one array with others."""

_REDUCTIONS: dict[str, Callable[[Any, Any], Any]] = {
    "reduce_sum": lax.add,
    "reduce_prod": lax.mul,
    "reduce_max": lax.max,
    "reduce_min": lax.min,
    "reduce_and": lax.bitwise_and,
    "reduce_or": lax.bitwise_or,
}
_INLINED = {
    "jit": "jaxpr",
    "closed_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
    "custom_vmap_call": "call",
}
"""Primitives that only call a program, and their parameter that holds it.

What is differentiated or batched has been so by now.
"""


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
        leaves = _evaluated(program.jaxpr, _joined(program.consts), jax.tree.leaves(args))
        return jax.tree.unflatten(jax.tree.structure(shapes), leaves)

    return rewritten


def _joined(constants: Sequence[Any]) -> list[Any]:
    """Give constants, those of a few numbers as parts of one array a type; barriers keep XLA from taking it apart."""
    found = list(lax.optimization_barrier(tuple(constants)))
    # A random key is no array of NumPy's.
    few = [k for k, one in enumerate(constants) if isinstance(one.dtype, np.dtype) and one.size <= _SMALL]
    for kind in dict.fromkeys(constants[place].dtype for place in few):
        places = [place for place in few if constants[place].dtype == kind]
        whole = lax.optimization_barrier(np.concatenate([np.ravel(constants[place]) for place in places]))
        parts = jnp.split(whole, np.cumsum([constants[place].size for place in places])[:-1])
        for place, part in zip(places, parts, strict=True):
            found[place] = part.reshape(constants[place].shape)
    return found


def _evaluated(program: Jaxpr, constants: Sequence[Any], arguments: Sequence[Any]) -> list[Any]:
    known = dict(zip([*program.constvars, *program.invars], [*constants, *arguments], strict=True))
    for equation in program.eqns:
        values = [v.val if isinstance(v, Literal) else known[v] for v in equation.invars]
        known.update(zip(equation.outvars, _applied(equation, values), strict=True))
    return [v.val if isinstance(v, Literal) else known[v] for v in program.outvars]


def _called(program: ClosedJaxpr, *arguments: Any) -> list[Any]:
    return _evaluated(program.jaxpr, program.consts, arguments)


def _applied(equation: JaxprEqn, values: list[Any]) -> Sequence[Any]:
    name, parameters = equation.primitive.name, equation.params
    if name in _INLINED:
        return _called(parameters[_INLINED[name]], *values)
    if name == "cond":
        chosen, *operands = values
        return lax.switch(chosen, [functools.partial(_called, branch) for branch in parameters["branches"]], *operands)
    # Over nothing there is nothing to write out: the plain reduction is a constant.
    if name in _REDUCTIONS and 0 < math.prod(values[0].shape[axis] for axis in parameters["axes"]) <= FEW:
        return [_reduced(_REDUCTIONS[name], values[0], [int(axis) for axis in parameters["axes"]])]
    with equation.ctx.manager:
        answer = equation.primitive.bind(*values, **equation.primitive.get_bind_params(parameters))
    return answer if equation.primitive.multiple_results else [answer]


def _reduced(operation: Callable[[Any, Any], Any], x: Any, axes: Sequence[int]) -> Any:
    for axis in sorted(axes, reverse=True):
        x = functools.reduce(operation, [lax.index_in_dim(x, i, axis, keepdims=False) for i in range(x.shape[axis])])
    return x
