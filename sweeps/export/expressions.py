"""Scalar JAX functions as expressions, and expressions as source text for NumPy-like libraries.

A function is traced once (`jax.make_jaxpr`) and its equations are evaluated on symbols in place of numbers. So the
text of a law follows from the code of the model, and a user's own effect needs no second definition.
"""

from __future__ import annotations

import math
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
_FUNCTIONS: dict[str, Callable[..., float]] = {
    "sqrt": math.sqrt, "exp": math.exp, "log": math.log, "log1p": math.log1p, "expm1": math.expm1, "sin": math.sin,
    "cos": math.cos, "tan": math.tan, "asin": math.asin, "acos": math.acos, "atan": math.atan, "tanh": math.tanh,
    "abs": abs, "floor": math.floor, "max": max, "min": min, "sign": lambda x: float(np.sign(x)),
    "not": lambda x: not x, "atan2": math.atan2,
}  # fmt: skip
_FOLDED: dict[str, Callable[..., Any]] = {
    **_FUNCTIONS,
    "add": lambda a, b: a + b, "sub": lambda a, b: a - b, "mul": lambda a, b: a * b, "div": lambda a, b: a / b,
    "neg": lambda a: -a, "pow": lambda a, b: a**b, "lt": lambda a, b: a < b, "le": lambda a, b: a <= b,
    "gt": lambda a, b: a > b, "ge": lambda a, b: a >= b, "eq": lambda a, b: a == b, "ne": lambda a, b: a != b,
    "and": lambda a, b: a and b, "or": lambda a, b: a or b,
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


def constant_symbol(value: Any) -> Symbol:
    """Symbol of a number or a truth value."""
    return Symbol.of("const", (), bool(value) if isinstance(value, bool | np.bool_) else float(value))


def _is_constant(x: Symbol, value: float) -> bool:
    return x.is_const and x.value == value and not isinstance(x.value, bool)


def apply_operation(op: str, *args: Symbol) -> Symbol:
    """Symbol of an operation, simplified if an operand is 0 or 1, or if all are numbers."""
    if all(a.is_const for a in args):
        try:
            return constant_symbol(_FOLDED[op](*(a.value for a in args)))
        except (ArithmeticError, ValueError):
            return Symbol.of(op, args)
    if (op == "add" and _is_constant(args[0], 0)) or (op == "mul" and _is_constant(args[0], 1)):
        return args[1]
    if (op in ("add", "sub") and _is_constant(args[1], 0)) or (
        op in ("mul", "div", "pow") and _is_constant(args[1], 1)
    ):
        return args[0]
    if (op == "mul" and (_is_constant(args[0], 0) or _is_constant(args[1], 0))) or (
        op == "div" and _is_constant(args[0], 0)
    ):
        return constant_symbol(0.0)
    if (op == "sub" and _is_constant(args[0], 0)) or (op == "mul" and _is_constant(args[0], -1)):
        return apply_operation("neg", args[1])
    if op == "mul" and _is_constant(args[1], -1):
        return apply_operation("neg", args[0])
    if op == "neg" and args[0].op == "neg":
        return args[0].args[0]
    if op == "add" and args[1].op == "neg":
        return apply_operation("sub", args[0], args[1].args[0])
    if op == "add" and args[0].op == "neg":
        return apply_operation("sub", args[1], args[0].args[0])
    if op == "sub" and args[1].op == "neg":
        return apply_operation("add", args[0], args[1].args[0])
    if op in ("and", "or") and any(a.is_const for a in args):
        constant, other = args if args[0].is_const else args[::-1]
        return (other if constant.value else constant) if op == "and" else (constant if constant.value else other)
    return Symbol.of(op, args)


def choice_symbol(condition: Symbol, yes: Symbol, no: Symbol) -> Symbol:
    """Returns the symbol of a choice. If both branches are equal or the condition is known, it is the symbol of
    one branch."""
    if condition.is_const:
        return yes if condition.value else no
    return yes if yes is no else Symbol.of("where", (condition, yes, no))


def _map_elements(function: Callable[..., Symbol], *arrays: np.ndarray) -> np.ndarray:
    arrays = np.broadcast_arrays(*arrays)
    results = np.empty(arrays[0].shape, object)
    for k in np.ndindex(results.shape):
        results[k] = function(*(a[k] for a in arrays))
    return results


def _power(x: Symbol, n: int) -> Symbol:
    return (
        apply_operation("div", constant_symbol(1.0), _power(x, -n))
        if n < 0
        else apply_operation("pow", x, constant_symbol(n))
    )


def _logistic(x: Symbol) -> Symbol:
    return apply_operation(
        "div",
        constant_symbol(1.0),
        apply_operation("add", constant_symbol(1.0), apply_operation("exp", apply_operation("neg", x))),
    )


def _convert_kind(x: Symbol, kind: Any) -> Symbol:
    if x.op in _LOGICAL and np.issubdtype(kind, np.number):
        return choice_symbol(x, constant_symbol(1.0), constant_symbol(0.0))
    if x.is_const:
        return constant_symbol(bool(x.value) if kind == np.bool_ else float(x.value))
    return x


def _dot(a: np.ndarray, b: np.ndarray, dimensions: Any) -> np.ndarray:
    ((left, right), (batch, _)) = dimensions
    if batch or len(left) != 1:
        raise NotImplementedError
    a, b = np.moveaxis(a, left[0], -1), np.moveaxis(b, right[0], -1)
    products = np.empty(a.shape[:-1] + b.shape[:-1], object)
    for i in np.ndindex(a.shape[:-1]):
        for j in np.ndindex(b.shape[:-1]):
            products[i + j] = _sum_of_symbols([apply_operation("mul", x, y) for x, y in zip(a[i], b[j], strict=True)])
    return products


def _sum_of_symbols(terms: Sequence[Symbol]) -> Symbol:
    total = constant_symbol(0.0)
    for term in terms:
        total = apply_operation("add", total, term)
    return total


#: Primitives that apply one operation to each element.
_SIMPLE = {
    "add": "add", "add_any": "add", "sub": "sub", "mul": "mul", "div": "div", "neg": "neg", "pow": "pow",
    "max": "max", "min": "min", "exp": "exp", "log": "log", "log1p": "log1p", "expm1": "expm1", "sin": "sin",
    "cos": "cos", "tan": "tan", "asin": "asin", "acos": "acos", "atan": "atan", "atan2": "atan2", "tanh": "tanh",
    "sqrt": "sqrt",
    "abs": "abs", "floor": "floor", "sign": "sign", "lt": "lt", "le": "le", "gt": "gt", "ge": "ge", "eq": "eq",
    "ne": "ne", "and": "and", "or": "or", "not": "not",
}  # fmt: skip
_SAME = frozenset(("copy", "copy_p", "stop_gradient", "optimization_barrier", "reduce_precision"))


def _shape_primitive(name: str, x: list[np.ndarray], p: Json) -> np.ndarray:
    """Result of a primitive that only moves or joins elements."""
    if name == "broadcast_in_dim":
        shape = [1] * len(p["shape"])
        for axis, size in zip(p["broadcast_dimensions"], x[0].shape, strict=True):
            shape[axis] = size
        return np.broadcast_to(x[0].reshape(shape), p["shape"])
    if name in ("reshape", "squeeze", "expand_dims"):
        return (
            x[0].reshape(p["new_sizes"])
            if name == "reshape"
            else x[0].reshape(_axes_that_remain(name, x[0].shape, p))
        )
    if name == "stack":
        return np.stack(x, p["axis"])
    if name == "transpose":
        return x[0].transpose(p["permutation"])
    if name == "concatenate":
        return np.concatenate(x, p["dimension"])
    if name == "slice":
        strides = p["strides"] or (1,) * x[0].ndim
        return x[0][tuple(slice(*s) for s in zip(p["start_indices"], p["limit_indices"], strides, strict=True))]
    raise NotImplementedError(name)


def _axes_that_remain(name: str, shape: tuple[int, ...], p: Json) -> tuple[int, ...]:
    if name == "squeeze":
        return tuple(n for k, n in enumerate(shape) if k not in p["dimensions"])
    sizes = list(shape)
    for axis in sorted(p["dimensions"]):
        sizes.insert(axis, 1)
    return tuple(sizes)


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
        if name in _SIMPLE:
            results = [_map_elements(lambda *a, op=_SIMPLE[name]: apply_operation(op, *a), *x)]
        elif name in _SAME:
            results = list(x)
        elif name == "integer_pow":
            results = [_map_elements(lambda a, n=p["y"]: _power(a, n), x[0])]
        elif name == "square":
            results = [_map_elements(lambda a: _power(a, 2), x[0])]
        elif name == "rsqrt":
            results = [
                _map_elements(
                    lambda a: apply_operation("div", constant_symbol(1.0), apply_operation("sqrt", a)), x[0]
                )
            ]
        elif name == "logistic":
            results = [_map_elements(_logistic, x[0])]
        elif name == "select_n" and len(x) == 3:
            results = [
                _map_elements(
                    lambda c, no, yes: choice_symbol((constant_symbol(bool(c.value)) if c.is_const else c), yes, no),
                    *x,
                )
            ]
        elif name == "clamp":
            results = [
                _map_elements(lambda low, a, high: apply_operation("min", apply_operation("max", a, low), high), *x)
            ]
        elif name == "convert_element_type":
            results = [_map_elements(lambda a, kind=p["new_dtype"]: _convert_kind(a, kind), x[0])]
        elif name == "iota":
            results = [_constant_array(np.indices(p["shape"], float)[p["dimension"]])]
        elif name == "reduce_sum":
            rest = np.moveaxis(x[0], p["axes"], range(len(p["axes"])))
            flat = rest.reshape(-1, *rest.shape[len(p["axes"]) :])
            results = [_map_elements(lambda *terms: _sum_of_symbols(terms), *flat)]
        elif name == "dot_general":
            results = [_dot(x[0], x[1], p["dimension_numbers"])]
        elif inner_jaxpr is not None:
            closed = hasattr(inner_jaxpr, "consts")
            results = _evaluate_jaxpr(
                inner_jaxpr.jaxpr if closed else inner_jaxpr, inner_jaxpr.consts if closed else (), x
            )
        else:
            results = [_shape_primitive(name, x, p)]
        values.update(zip(eqn.outvars, results, strict=True))
    return [read(v) for v in jaxpr.outvars]


def _constant_array(value: Any) -> np.ndarray:
    value = np.asarray(value)
    symbols = np.empty(value.shape, object)
    for k in np.ndindex(value.shape):
        symbols[k] = constant_symbol(value[k].item())
    return symbols


def trace_function(function: Callable[..., Any], names: Sequence[str], what: str) -> Symbol:
    """Returns a scalar function of scalars as an expression of their names.

    Args:
        function: traceable function of as many positional scalars.
        what: beginning of the error message.

    Raises:
        BadConfiguration: the function has a loop, or another operation that has no form as an expression.
    """
    closed = jax.make_jaxpr(lambda *x: jnp.asarray(function(*x)))(*(jnp.zeros(()) for _ in names))
    arguments = []
    for name in names:
        cell = np.empty((), object)
        cell[()] = Symbol.of("name", (), name)
        arguments.append(cell)
    try:
        (result,) = _evaluate_jaxpr(closed.jaxpr, closed.consts, arguments)
    except NotImplementedError as error:
        raise BadConfiguration(
            f"{what}: its equation uses {error or 'an operation'} of JAX; rewrite it with sums, products, powers "
            "and scalar functions, or export without it"
        ) from error
    symbol: Any = result[()]
    return symbol


def names_in(*symbols: Symbol) -> list[str]:
    """Names that expressions depend on, in the order of their first use."""
    names: dict[str, None] = {}
    visited: set[int] = set()

    def visit(x: Symbol) -> None:
        if id(x) in visited:
            return
        visited.add(id(x))
        if x.op == "name":
            names[x.value] = None
        for a in x.args:
            visit(a)

    for symbol in symbols:
        visit(symbol)
    return list(names)


#: The number 0.
ZERO = constant_symbol(0.0)


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
    uses: dict[int, int] = {}

    def count(x: Symbol) -> None:
        uses[id(x)] = uses.get(id(x), 0) + 1
        if uses[id(x)] == 1:
            for a in x.args:
                count(a)

    count(result)
    lines: list[str] = []
    local: dict[int, str] = {}

    def text(x: Symbol, outer: int = 0) -> str:
        if id(x) in local:
            return local[id(x)]
        if x.is_const:
            number = number_text(x.value)
            return f"({number})" if number.startswith("-") and outer >= 7 else number
        if x.op == "name":
            return spelled(x.value)
        own_rank, written = _operation_text(x, text, dialect)
        if uses[id(x)] > 1:
            local[id(x)] = f"x{len(local) + 1}"
            lines.append(f"    {local[id(x)]} = {written}")
            return local[id(x)]
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
