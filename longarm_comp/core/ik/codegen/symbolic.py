"""Symbolic execution of the model's Python code, recorded as straight-line code.

`Symbol` is another kind of scalar.  It records every operation on a `Graph`, folds constants
(products with zero are dropped) and shares common subexpressions.  `llvm` writes the operations
that given outputs need as assembly.  No formula is written twice: a changed model is traced again.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from longarm_comp.core.arm.angles import arc_tangent2, cosine, sine

Operand = Any  # node number (int) or constant (float)

_COMMUTES = {"add", "mul", "minimum", "maximum"}
_FOLD = {"add": operator.add, "sub": operator.sub, "mul": operator.mul, "div": operator.truediv}
_ALIKE = ("tan", "tanh", "exp", "expm1", "log", "sqrt", "floor", "minimum", "maximum")
_UFUNCS = {
    **{getattr(np, name): name for name in _ALIKE},
    np.add: "add",
    np.subtract: "sub",
    np.multiply: "mul",
    np.true_divide: "div",
    np.negative: "neg",
    np.absolute: "fabs",
    np.fabs: "fabs",
    np.less: "lt",
    np.less_equal: "le",
    np.power: "pow",
}
_IN_ARITHMETIC: dict[Any, Callable[..., Any]] = {
    np.sin: sine,
    np.cos: cosine,
    np.arctan2: arc_tangent2,
    np.sign: lambda x: (x > 0.0) - (x < 0.0),
}
"""Recorded as arithmetic, which works on all lanes at once."""


class Graph:
    """The operations in order: node k is ``(operation, operands)``, inputs first."""

    def __init__(self) -> None:
        self.nodes: list[tuple[str, tuple[Operand, ...]]] = []
        self._known: dict[tuple[Any, ...], int] = {}
        self._symbols: dict[int, Symbol] = {}

    def input(self, text: str) -> Symbol:
        """Return a symbol for an input; `text` is its place in the state."""
        return self._node("input", (text,))

    def apply(self, op: str, *args: Any) -> Any:
        """Return the result of an operation: a symbol, or a float if it is constant."""
        args = tuple(a if isinstance(a, Symbol) else float(a) for a in args)
        simple = _simplify(self, op, args)
        if simple is not None:
            return simple
        operands = tuple(a.node if isinstance(a, Symbol) else a for a in args)
        if op in _COMMUTES and _order(operands[1]) < _order(operands[0]):
            operands = (operands[1], operands[0])
        return self._node(op, operands)

    def _node(self, op: str, operands: tuple[Operand, ...]) -> Symbol:
        key = (op, operands, *map(type, operands))  # node 2 is not the number 2.0
        node = self._known.get(key)
        if node is None:
            node = self._known[key] = len(self.nodes)
            self.nodes.append((op, operands))
            self._symbols[node] = Symbol(self, node)
        return self._symbols[node]

    def needed_nodes(self, outputs: Sequence[Any]) -> list[int]:
        """Return the nodes that the outputs depend on, in order."""
        keep = [False] * len(self.nodes)
        for out in outputs:
            if isinstance(out, Symbol):
                keep[out.node] = True
        for node in range(len(self.nodes) - 1, -1, -1):
            if keep[node]:
                for operand in self.nodes[node][1]:
                    if type(operand) is int:
                        keep[operand] = True
        return [node for node, kept in enumerate(keep) if kept]


Outputs = dict[int, Any]
"""By place in the state: a symbol or a number."""
Program = tuple[Graph, Outputs]


def _both(op: str) -> tuple[Any, Any]:
    """Return the two methods of an operator: ``symbol op other`` and ``other op symbol``."""

    def first(self: Symbol, other: Any) -> Any:
        return self.graph.apply(op, self, other)

    def second(self: Symbol, other: Any) -> Any:
        return self.graph.apply(op, other, self)

    return first, second


class Symbol:
    """A traced number."""

    __slots__ = ("graph", "node")

    def __init__(self, graph: Graph, node: int) -> None:
        self.graph, self.node = graph, node

    __add__, __radd__ = _both("add")
    __sub__, __rsub__ = _both("sub")
    __mul__, __rmul__ = _both("mul")
    __truediv__, __rtruediv__ = _both("div")
    __lt__, __gt__ = _both("lt")
    __le__, __ge__ = _both("le")

    def __pow__(self, other: Any) -> Any:
        if isinstance(other, int) and 1 <= other <= 8:
            product: Any = self
            for _ in range(other - 1):
                product = product * self
            return product
        return self.graph.apply("pow", self, other)

    def __neg__(self) -> Any:
        return self.graph.apply("neg", self)

    def __pos__(self) -> Symbol:
        return self

    def __abs__(self) -> Any:
        return self.graph.apply("fabs", self)

    def where(self, yes: Any, no: Any) -> Any:
        """Return `yes` where this condition holds, else `no`."""
        return self.graph.apply("select", self, yes, no)

    def __bool__(self) -> bool:
        raise TypeError("a traced number decides no branch: use spatial.where, minimum, maximum")

    def __float__(self) -> float:
        raise TypeError("a traced number has no value yet: leave floats, arrays and symbols alike")

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Any:
        if method != "__call__" or options:
            return NotImplemented
        if ufunc in (np.greater, np.greater_equal):
            return self.graph.apply("lt" if ufunc is np.greater else "le", inputs[1], inputs[0])
        if ufunc is np.square:
            return self.graph.apply("mul", inputs[0], inputs[0])
        if ufunc in _IN_ARITHMETIC:
            return _IN_ARITHMETIC[ufunc](*inputs)
        if ufunc not in _UFUNCS:
            raise TypeError(f"numpy.{ufunc.__name__} is not among the traced operations")
        return self.graph.apply(_UFUNCS[ufunc], *inputs)


def _order(operand: Operand) -> tuple[bool, float]:
    return type(operand) is float, operand


def _simplify(graph: Graph, op: str, args: tuple[Any, ...]) -> Any:
    """Return the simplified result of an operation, or None if it cannot be simplified."""
    a, b = args[0], args[1] if len(args) > 1 else None
    fa, fb = type(a) is float, type(b) is float
    if op in _FOLD and fa and fb:
        return _FOLD[op](a, b)
    if op == "add":
        if fa and a == 0.0:
            return b
        if fb and b == 0.0:
            return a
        for x, y in ((a, b), (b, a)):
            inner = _negation_of(graph, y)
            if inner is not None:
                return graph.apply("sub", x, inner)
        return None
    if op == "sub":
        if fb and b == 0.0:
            return a
        if a is b:
            return 0.0
        if fa and a == 0.0:
            return graph.apply("neg", b)
        inner = _negation_of(graph, b)
        return None if inner is None else graph.apply("add", a, inner)
    if op == "mul":
        for x, y in ((a, b), (b, a)):
            if type(x) is float and x in (0.0, 1.0, -1.0):
                return 0.0 if x == 0.0 else y if x == 1.0 else graph.apply("neg", y)
        return None
    if op == "div":
        return 0.0 if fa and a == 0.0 else graph.apply("mul", a, 1.0 / b) if fb and b else None
    if op == "neg":
        return -a if fa else _negation_of(graph, a)
    if op == "select" and args[1] is args[2]:
        return args[1]
    return None


def _negation_of(graph: Graph, x: Any) -> Any:
    """Return y where x is the symbol -y, else None."""
    if not isinstance(x, Symbol):
        return None
    op, operands = graph.nodes[x.node]
    return graph._symbols[operands[0]] if op == "neg" else None
