"""Scalar JAX functions as expressions, and expressions as source text for NumPy-like libraries.

A function is traced once (`jax.make_jaxpr`) and its equations are evaluated on symbols in place of numbers. So the
text of a law follows from the code of the model, and a user's own effect needs no second definition.
"""

from __future__ import annotations

import contextlib
import functools
import math
import operator
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from calibration.data import Json
from calibration.data.input_errors import BadConfiguration

#: Operators with their precedence and notation.
_INFIX = {
    "lt": (1, "<"), "le": (1, "<="), "gt": (1, ">"), "ge": (1, ">="), "eq": (1, "=="), "ne": (1, "!="),
    "or": (2, "|"), "and": (3, "&"),
    "add": (5, "+"), "sub": (5, "-"), "mul": (6, "*"), "div": (6, "/"), "neg": (7, "-"), "pow": (8, "**"),
}  # fmt: skip
_LOGICAL = frozenset(("or", "and", "not", "lt", "le", "gt", "ge", "eq", "ne"))
#: Operations, by the names of JAX's primitives.
_OPERATIONS: dict[str, Callable[..., Any]] = {
    "sqrt": math.sqrt, "exp": math.exp, "log": math.log, "log1p": math.log1p, "expm1": math.expm1, "sin": math.sin,
    "cos": math.cos, "tan": math.tan, "asin": math.asin, "acos": math.acos, "atan": math.atan, "tanh": math.tanh,
    "abs": abs, "floor": math.floor, "max": max, "min": min, "sign": lambda x: float(np.sign(x)),
    "not": operator.not_, "atan2": math.atan2,
    "add": operator.add, "sub": operator.sub, "mul": operator.mul, "div": operator.truediv, "neg": operator.neg,
    "pow": operator.pow, "lt": operator.lt, "le": operator.le, "gt": operator.gt, "ge": operator.ge,
    "eq": operator.eq, "ne": operator.ne, "and": operator.and_, "or": operator.or_,
}  # fmt: skip


class Symbol:
    """A node of an expression: a number, a name, or an operation on other nodes. Equal nodes are the same object.

    Attributes:
        op: `const`, `name`, or an operation.
        args: operands.
        value: the number or the name.
    """

    __slots__ = ("args", "op", "value")
    _known: ClassVar[dict[Any, Symbol]] = {}

    def __init__(self, op: str, args: tuple[Symbol, ...], value: Any) -> None:
        self.op, self.args, self.value = op, args, value

    @classmethod
    def of(cls, op: str, args: tuple[Symbol, ...] = (), value: Any = None) -> Symbol:
        key = (op, args, value, type(value))
        if key not in cls._known:
            cls._known[key] = cls(op, args, value)
        return cls._known[key]

    @property
    def is_const(self) -> bool:
        return self.op == "const"

    def __add__(self, other: Symbol) -> Symbol:
        return apply_operation("add", self, other)

    def __sub__(self, other: Symbol) -> Symbol:
        return apply_operation("sub", self, other)

    def __mul__(self, other: Symbol) -> Symbol:
        return apply_operation("mul", self, other)

    def __truediv__(self, other: Symbol) -> Symbol:
        return apply_operation("div", self, other)

    def __neg__(self) -> Symbol:
        return apply_operation("neg", self)


def constant_symbol(value: Any) -> Symbol:
    """Symbol of a number or a truth value."""
    return Symbol.of("const", (), bool(value) if isinstance(value, bool | np.bool_) else float(value))


ZERO, ONE, MINUS_ONE = map(constant_symbol, (0.0, 1.0, -1.0))


def apply_operation(op: str, *args: Symbol) -> Symbol:
    """Symbol of an operation, simplified if an operand is 0 or 1, or if all are numbers."""
    if all(a.is_const for a in args):
        with contextlib.suppress(ArithmeticError, ValueError):
            return constant_symbol(_OPERATIONS[op](*(a.value for a in args)))
        return Symbol.of(op, args)
    a, b = (*args, ZERO)[:2]
    if (op == "add" and a is ZERO) or (op == "mul" and a is ONE):
        return b
    if (op in ("add", "sub") and b is ZERO) or (op in ("mul", "div", "pow") and b is ONE):
        return a
    if (op == "mul" and ZERO in args) or (op == "div" and a is ZERO):
        return ZERO
    if (op == "sub" and a is ZERO) or (op == "mul" and a is MINUS_ONE):
        return -b
    if op == "mul" and b is MINUS_ONE:
        return -a
    if op == "neg" and a.op == "neg":
        return a.args[0]
    if op == "add" and b.op == "neg":
        return a - b.args[0]
    if op == "add" and a.op == "neg":
        return b - a.args[0]
    if op == "sub" and b.op == "neg":
        return a + b.args[0]
    if op in ("and", "or") and (a.is_const or b.is_const):
        constant, other = (a, b) if a.is_const else (b, a)
        return other if constant.value == (op == "and") else constant
    return Symbol.of(op, args)


def choice_symbol(condition: Symbol, yes: Symbol, no: Symbol) -> Symbol:
    """Returns the symbol of a choice. If both branches are equal or the condition is known, it is the symbol of
    one branch."""
    if condition.is_const:
        return yes if condition.value else no
    return yes if yes is no else Symbol.of("where", (condition, yes, no))


def _power(x: Symbol, n: int) -> Symbol:
    return ONE / _power(x, -n) if n < 0 else apply_operation("pow", x, constant_symbol(n))


def _select(condition: Symbol, no: Symbol, yes: Symbol, *others: Symbol) -> Symbol:
    if others:
        raise NotImplementedError
    return choice_symbol(condition, yes, no)


def _convert_kind(x: Symbol, kind: Any) -> Symbol:
    if x.op in _LOGICAL and np.issubdtype(kind, np.number):
        return choice_symbol(x, ONE, ZERO)
    if x.is_const:
        return constant_symbol(bool(x.value) if kind == np.bool_ else float(x.value))
    return x


def _element_function(name: str, p: Json) -> Callable[..., Symbol] | None:
    """Function of one element of each operand that a primitive with parameters `p` applies. None for others."""
    if name in _OPERATIONS:
        return functools.partial(apply_operation, name)
    functions: dict[str, Callable[..., Symbol]] = {
        "add_any": operator.add,
        "integer_pow": lambda a: _power(a, p["y"]),
        "square": lambda a: _power(a, 2),
        "rsqrt": lambda a: ONE / apply_operation("sqrt", a),
        "logistic": lambda a: ONE / (ONE + apply_operation("exp", -a)),
        "select_n": _select,
        "clamp": lambda low, a, high: apply_operation("min", apply_operation("max", a, low), high),
        "convert_element_type": lambda a: _convert_kind(a, p["new_dtype"]),
    }
    return functions.get(name)


#: Primitives that leave their operands as they are.
_SAME = frozenset(("copy", "copy_p", "stop_gradient", "optimization_barrier", "reduce_precision"))


def _broadcast(x: np.ndarray, shape: tuple[int, ...], axes: tuple[int, ...]) -> np.ndarray:
    return np.broadcast_to(np.expand_dims(x, tuple(k for k in range(len(shape)) if k not in axes)), shape)


def _dot(a: np.ndarray, b: np.ndarray, dimensions: Any) -> Any:
    contracted, batches = dimensions
    if any(batches):
        raise NotImplementedError
    return np.tensordot(a, b, contracted)


def _slices(p: Json) -> tuple[slice, ...]:
    strides = p["strides"] or (None,) * len(p["start_indices"])
    return tuple(map(slice, p["start_indices"], p["limit_indices"], strides))


#: Primitives that move, join or sum elements: functions of their operands and parameters.
_ARRAY_FUNCTIONS: dict[str, Callable[[list[np.ndarray], Json], Any]] = {
    "broadcast_in_dim": lambda x, p: _broadcast(x[0], p["shape"], p["broadcast_dimensions"]),
    "reshape": lambda x, p: x[0].reshape(p["new_sizes"]),
    "squeeze": lambda x, p: np.squeeze(x[0], p["dimensions"]),
    "expand_dims": lambda x, p: np.expand_dims(x[0], p["dimensions"]),
    "stack": lambda x, p: np.stack(x, p["axis"]),
    "transpose": lambda x, p: x[0].transpose(p["permutation"]),
    "concatenate": lambda x, p: np.concatenate(x, p["dimension"]),
    "slice": lambda x, p: x[0][_slices(p)],
    "iota": lambda x, p: _constant_array(np.indices(p["shape"], float)[p["dimension"]]),
    "reduce_sum": lambda x, p: np.sum(x[0], p["axes"]),
    "dot_general": lambda x, p: _dot(x[0], x[1], p["dimension_numbers"]),
}


def _evaluate_jaxpr(jaxpr: Any, consts: Sequence[Any], arguments: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Symbols of the outputs of a jaxpr, as arrays of objects."""
    values: dict[Any, np.ndarray] = {}

    def read(atom: Any) -> np.ndarray:
        return _constant_array(atom.val) if hasattr(atom, "val") else values[atom]

    values.update(zip(jaxpr.constvars, map(_constant_array, consts), strict=True))
    values.update(zip(jaxpr.invars, arguments, strict=True))
    for eqn in jaxpr.eqns:
        x, name, p = [read(v) for v in eqn.invars], eqn.primitive.name, eqn.params
        inner_jaxpr = next((p[key] for key in ("jaxpr", "call_jaxpr", "fun_jaxpr") if key in p), None)
        if name in _SAME:
            results = x
        elif (function := _element_function(name, p)) is not None:
            results = [np.frompyfunc(function, len(x), 1)(*x)]
        elif name in _ARRAY_FUNCTIONS:
            results = [_ARRAY_FUNCTIONS[name](x, p)]
        elif inner_jaxpr is not None:
            closed = hasattr(inner_jaxpr, "consts")
            results = _evaluate_jaxpr(
                inner_jaxpr.jaxpr if closed else inner_jaxpr, inner_jaxpr.consts if closed else (), x
            )
        else:
            raise NotImplementedError(name)
        # NumPy returns the single element of an array without dimensions
        values.update(zip(eqn.outvars, (np.asarray(r, object) for r in results), strict=True))
    return [read(v) for v in jaxpr.outvars]


def _constant_array(value: Any) -> np.ndarray:
    return np.asarray(np.frompyfunc(constant_symbol, 1, 1)(value), object)


def trace_function(function: Callable[..., Any], names: Sequence[str], what: str) -> Symbol:
    """Returns a scalar function of scalars as an expression of their names.

    Args:
        function: traceable function of as many positional scalars.
        what: beginning of the error message.

    Raises:
        BadConfiguration: the function has a loop, or another operation that has no form as an expression.
    """
    closed = jax.make_jaxpr(lambda *x: jnp.asarray(function(*x)))(*(jnp.zeros(()) for _ in names))
    arguments = [np.asarray(Symbol.of("name", (), name), object) for name in names]
    try:
        (result,) = _evaluate_jaxpr(closed.jaxpr, closed.consts, arguments)
    except NotImplementedError as error:
        raise BadConfiguration(
            f"{what}: its equation uses {error or 'an operation'} of JAX; rewrite it with scalar functions"
        ) from error
    symbol: Any = result[()]
    return symbol


def names_in(*symbols: Symbol) -> list[str]:
    """Names that expressions depend on, in the order of their first use."""
    visited: dict[Symbol, None] = {}

    def visit(x: Symbol) -> None:
        if x not in visited:
            visited[x] = None
            for a in x.args:
                visit(a)

    for symbol in symbols:
        visit(symbol)
    return [x.value for x in visited if x.op == "name"]


class Dialect:
    """Notation of functions: `jnp.sqrt(x)`. Subclasses change single functions."""

    def __init__(self, prefix: str) -> None:
        self.prefix = prefix

    def call(self, op: str, args: Sequence[str], constants: Sequence[bool]) -> str:
        """Text of a function of arguments in text. `constants`: true for each number."""
        name = {"max": "maximum", "min": "minimum", "asin": "arcsin", "acos": "arccos", "atan": "arctan",
                "atan2": "arctan2", "not": "logical_not"}.get(op, op)  # fmt: skip
        return f"{self.prefix}.{name}({', '.join(args)})"


class Torch(Dialect):
    """PyTorch, whose `maximum` accepts only tensors."""

    def __init__(self) -> None:
        super().__init__("torch")

    def call(self, op: str, args: Sequence[str], constants: Sequence[bool]) -> str:
        if op in ("max", "min") and any(constants):
            tensor, number = (args[1], args[0]) if constants[0] else (args[0], args[1])
            bound = "min" if op == "max" else "max"  # max(x, number) clamps x from below
            return f"torch.clamp({tensor}, {bound}={number})"
        name = {"max": "maximum", "min": "minimum", "not": "logical_not"}.get(op, op)
        return f"torch.{name}({', '.join(args)})"


JAX, TORCH = Dialect("jnp"), Torch()


def number_text(value: Any) -> str:
    """Shortest text of a number that reads back as the same number."""
    return repr(value if isinstance(value, bool) else float(value))


def lines_of(result: Symbol, dialect: Dialect, spelled: Callable[[str], str]) -> list[str]:
    """Lines of a function body that returns an expression. Repeated subexpressions become local variables.

    Args:
        spelled: function that returns the text of a name.
    """
    uses = Counter[Symbol]()

    def count(x: Symbol) -> None:
        uses[x] += 1
        if uses[x] == 1:
            for a in x.args:
                count(a)

    count(result)
    lines: list[str] = []
    local: dict[Symbol, str] = {}

    def text(x: Symbol, outer: int = 0) -> str:
        if x in local:
            return local[x]
        if x.is_const:
            number = number_text(x.value)
            return f"({number})" if number.startswith("-") and outer >= 7 else number
        if x.op == "name":
            return spelled(x.value)
        own_rank, written = _operation_text(x, text, dialect)
        if uses[x] > 1:
            local[x] = f"x{len(local) + 1}"
            lines.append(f"    {local[x]} = {written}")
            return local[x]
        return f"({written})" if own_rank < outer else written

    last_text = text(result)
    return [*lines, f"    return {last_text}"]


def _operation_text(x: Symbol, text: Callable[..., str], dialect: Dialect) -> tuple[int, str]:
    """Precedence and text of an operation."""
    if x.op == "neg":
        return 7, f"-{text(x.args[0], 7)}"
    if x.op in _INFIX:
        own_rank, sign = _INFIX[x.op]
        tighter = x.op in ("sub", "div") or own_rank <= 3
        left_text = text(x.args[0], own_rank + 1 if x.op == "pow" or own_rank <= 3 else own_rank)
        if x.op == "pow" and x.args[1].is_const and float(x.args[1].value).is_integer():
            return own_rank, f"{left_text} ** {int(x.args[1].value)}"
        return own_rank, f"{left_text} {sign} {text(x.args[1], own_rank + 1 if tighter else own_rank)}"
    return 9, dialect.call(x.op, [text(a) for a in x.args], [a.is_const for a in x.args])
