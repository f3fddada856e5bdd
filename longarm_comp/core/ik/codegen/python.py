"""Straight-line code of a graph as Python text, for floats and arrays (for machines: `emit_llvm`).

Every function has the signature ``name(s)`` over a column of numbers (or rows of arrays), which
it reads and writes as ``s[3]``.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from longarm_comp.core.ik.codegen.symbolic import Graph, Operand, Symbol

Outputs = dict[int, Any]  # place in s -> symbol or number

_INFIX = {"add": "+", "sub": "-", "mul": "*", "div": "/", "lt": "<", "le": "<=", "pow": "**"}
_NAME = re.compile(r"v(\d+)")

FLOATS: dict[str, Any] = {
    **{f: getattr(math, f) for f in ("fabs", "sin", "cos", "tan", "tanh", "exp", "log", "sqrt")},
    "atan2": math.atan2,
    "floor": lambda x: float(math.floor(x)),
    "sign": lambda x: float((x > 0) - (x < 0)),
    "minimum": lambda a, b: b if b < a else a,
    "maximum": lambda a, b: b if b > a else a,
}
ARRAYS: dict[str, Any] = {
    **{f: getattr(np, f) for f in ("fabs", "sin", "cos", "tan", "tanh", "exp", "log", "sqrt")},
    "atan2": np.arctan2,
    "floor": np.floor,
    "sign": np.sign,
    "minimum": np.minimum,
    "maximum": np.maximum,
    "select": np.where,
}


def python(name: str, graph: Graph, outputs: Outputs, arrays: bool = False) -> str:
    """A Python function. An expression that is used once is inlined.

    Names are reused as soon as their value is no longer needed.  Arrays then stay in the
    processor's cache, which makes the function three times faster.
    """
    live = graph.needed(list(outputs.values()))
    uses: Counter[int] = Counter()
    for node in live:
        uses.update(o for o in graph.nodes[node][1] if type(o) is int)
    uses.update(o.node for o in outputs.values() if isinstance(o, Symbol))
    text: dict[int, str] = {}
    depth: dict[int, int] = {}
    lines: list[tuple[str, str]] = []  # target, expression
    for node in live:
        op, operands = graph.nodes[node]
        deep = 1 + max((depth[o] for o in operands if type(o) is int), default=0)
        shown = _expression(op, operands, text, arrays)
        # nesting of inlined expressions
        if op == "input" or uses[node] > 1 or deep >= 12:
            lines.append((f"v{node}", shown))
            shown, deep = f"v{node}", 0
        text[node], depth[node] = shown, deep
    ends = []  # outputs are written after all computations
    for k, (place, out) in enumerate(outputs.items()):
        value = text[out.node] if isinstance(out, Symbol) else repr(float(out))
        if not _NAME.fullmatch(value):
            lines.append((f"o{k}", value))
            value = f"o{k}"
        ends.append((f"s[{place}]", value))
    return "\n".join([f"def {name}(s):", "    pass", *_renamed(lines + ends), ""])


def _renamed(lines: Sequence[tuple[str, str]]) -> list[str]:
    last = {int(v): k for k, (_, shown) in enumerate(lines) for v in _NAME.findall(shown)}
    held: dict[int, str] = {}
    spare: list[str] = []
    names = []
    for k, (target, shown) in enumerate(lines):
        used = {int(v) for v in _NAME.findall(shown)}
        shown = _NAME.sub(lambda match: held[int(match[1])], shown)
        spare += [held[v] for v in sorted(used) if last[v] == k]
        if target[0] == "v":
            held[int(target[1:])] = spare.pop() if spare else f"w{len(held)}"
            target = held[int(target[1:])]
        names.append(f"    {target} = {shown}")
    return names


def _expression(op: str, operands: tuple[Operand, ...], text: dict[int, str], arrays: bool) -> str:
    if op == "input":
        return f"s[{operands[0]}]"
    shown = [text[o] if type(o) is int else _number(o) for o in operands]
    if op == "neg":
        return f"(-{shown[0]})"
    if op in _INFIX:
        return f"({shown[0]} {_INFIX[op]} {shown[1]})"
    if op == "select" and not arrays:
        return f"({shown[1]} if {shown[0]} else {shown[2]})"
    return f"{op}({', '.join(shown)})"


def _number(value: float) -> str:
    return repr(value) if value >= 0 else f"({value!r})"
