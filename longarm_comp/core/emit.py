"""Straight-line code of a tape: Python text for floats and arrays, LLVM assembly for machines.

Every function has the signature ``name(q, c, x, out, y)`` over buffers of numbers; inputs and
outputs are written ``q[3]``, ``out[0]``.
"""

from __future__ import annotations

import math
import struct
from collections import Counter
from typing import Any

import numpy as np

from longarm_comp.core.trace import Operand, Symbol, Tape

Outputs = dict[str, Any]  # "out[0]" -> symbol or number
ARGUMENTS = ("q", "c", "x", "out", "y")

_INFIX = {"add": "+", "sub": "-", "mul": "*", "div": "/", "lt": "<", "le": "<=", "pow": "**"}
_DEEPEST = 12  # nesting of inlined expressions

FLOATS: dict[str, Any] = {
    **{f: getattr(math, f) for f in ("fabs", "sin", "cos", "tan", "tanh", "exp", "log", "sqrt")},
    "atan2": math.atan2,
    "floor": lambda x: float(math.floor(x)),
    "sign": lambda x: float((x > 0) - (x < 0)),
    "minimum": lambda a, b: b if b < a else a,
    "maximum": lambda a, b: b if b > a else a,
    "select": lambda condition, yes, no: yes if condition else no,
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


def python(name: str, tape: Tape, outputs: Outputs) -> str:
    """A Python function; what is used once is written where it is used.

    On arrays no output may share memory with an input.
    """
    live = tape.needed(list(outputs.values()))
    uses: Counter[int] = Counter()
    for node in live:
        uses.update(o for o in tape.nodes[node][1] if type(o) is int)
    uses.update(o.node for o in outputs.values() if isinstance(o, Symbol))
    text: dict[int, str] = {}
    depth: dict[int, int] = {}
    lines = [f"def {name}({', '.join(ARGUMENTS)}):", "    pass"]
    for node in live:
        op, operands = tape.nodes[node]
        deep = 1 + max((depth[o] for o in operands if type(o) is int), default=0)
        shown = _expression(op, operands, text)
        if op == "input" or uses[node] > 1 or deep >= _DEEPEST:
            lines.append(f"    v{node} = {shown}")
            shown, deep = f"v{node}", 0
        text[node], depth[node] = shown, deep
    for target, out in outputs.items():
        value = text[out.node] if isinstance(out, Symbol) else repr(float(out))
        lines.append(f"    {target} = {value}")
    return "\n".join([*lines, ""])


def _expression(op: str, operands: tuple[Operand, ...], text: dict[int, str]) -> str:
    if op == "input":
        return str(operands[0])
    shown = [text[o] if type(o) is int else _number(o) for o in operands]
    if op == "neg":
        return f"(-{shown[0]})"
    if op in _INFIX:
        return f"({shown[0]} {_INFIX[op]} {shown[1]})"
    return f"{op}({', '.join(shown)})"


def _number(value: float) -> str:
    return repr(value) if value >= 0 else f"({value!r})"


_LIBM = {
    "fabs": 1, "sin": 1, "cos": 1, "tan": 1, "tanh": 1, "exp": 1, "log": 1, "sqrt": 1,
    "floor": 1, "atan2": 2, "pow": 2,
}  # fmt: skip
_LLVM_ARITHMETIC = {"add": "fadd", "sub": "fsub", "mul": "fmul", "div": "fdiv"}
_LLVM_COMPARE = {"lt": "olt", "le": "ole"}


def llvm(functions: dict[str, tuple[Tape, Outputs]]) -> str:
    """LLVM assembly of a module with one function a name: ``void name(ptr q, ptr c, ...)``.

    ``many_name(sizes, q, c, ...)`` calls it for rows of arrays: sizes holds their number and
    the length of a row of each array.

    Nothing may be reordered (no fast-math), so that the numbers are those of Python.
    """
    lines = [
        f"declare double @{f}({', '.join(['double'] * count)}) #1" for f, count in _LIBM.items()
    ]
    for name, (tape, outputs) in functions.items():
        arguments = ", ".join(f"ptr %{a}" for a in ARGUMENTS)
        lines.append(f"define void @{name}({arguments}) #0 {{")
        for node in tape.needed(list(outputs.values())):
            lines += _instructions(node, *tape.nodes[node])
        for k, (target, out) in enumerate(outputs.items()):
            value = _llvm(out.node) if isinstance(out, Symbol) else _llvm(float(out))
            lines += [_address(f"o{k}", target), f"store double {value}, ptr %o{k}"]
        lines += ["ret void", "}", *_many(name)]
    return "\n".join(
        [*lines, "attributes #0 = { nounwind }", "attributes #1 = { nounwind memory(none) }", ""]
    )


def _many(name: str) -> list[str]:
    given = ", ".join(f"ptr %{a}" for a in ARGUMENTS)
    lines = [f"define void @many_{name}(ptr %sizes, {given}) #0 {{", "entry:"]
    for k, a in enumerate(("count", *ARGUMENTS)):
        lines.append(f"%at_{a} = getelementptr i64, ptr %sizes, i64 {k}")
        lines.append(f"%size_{a} = load i64, ptr %at_{a}")
    lines.append("%any = icmp sgt i64 %size_count, 0")
    lines += ["br i1 %any, label %loop, label %end", "loop:"]
    lines.append("%i = phi i64 [ 0, %entry ], [ %next, %loop ]")
    for a in ARGUMENTS:
        lines.append(f"%by_{a} = mul i64 %i, %size_{a}")
        lines.append(f"%row_{a} = getelementptr double, ptr %{a}, i64 %by_{a}")
    rows = ", ".join(f"ptr %row_{a}" for a in ARGUMENTS)
    lines += [f"call void @{name}({rows})", "%next = add i64 %i, 1"]
    lines.append("%more = icmp slt i64 %next, %size_count")
    return [*lines, "br i1 %more, label %loop, label %end", "end:", "ret void", "}"]


def _instructions(node: int, op: str, operands: tuple[Operand, ...]) -> list[str]:
    v = f"v{node}"
    if op == "input":
        return [_address(f"p{node}", operands[0]), f"%{v} = load double, ptr %p{node}"]
    a = [_llvm(o) for o in operands]
    if op in _LLVM_ARITHMETIC:
        return [f"%{v} = {_LLVM_ARITHMETIC[op]} double {a[0]}, {a[1]}"]
    if op == "neg":
        return [f"%{v} = fneg double {a[0]}"]
    if op in _LLVM_COMPARE:  # conditions are numbers, 1.0 or 0.0, as elsewhere
        return [
            f"%c{node} = fcmp {_LLVM_COMPARE[op]} double {a[0]}, {a[1]}",
            f"%{v} = uitofp i1 %c{node} to double",
        ]
    if op == "select":
        return [
            f"%c{node} = fcmp une double {a[0]}, 0.0",
            f"%{v} = select i1 %c{node}, double {a[1]}, double {a[2]}",
        ]
    if op in ("minimum", "maximum"):
        order = "olt" if op == "minimum" else "ogt"
        return [
            f"%c{node} = fcmp {order} double {a[1]}, {a[0]}",
            f"%{v} = select i1 %c{node}, double {a[1]}, double {a[0]}",
        ]
    if op == "sign":
        return [
            f"%c{node} = fcmp ogt double {a[0]}, 0.0",
            f"%d{node} = fcmp olt double {a[0]}, 0.0",
            f"%e{node} = select i1 %d{node}, double -1.0, double 0.0",
            f"%{v} = select i1 %c{node}, double 1.0, double %e{node}",
        ]
    given = ", ".join(f"double {x}" for x in a)
    return [f"%{v} = call double @{op}({given})"]


def _address(name: str, element: str) -> str:
    buffer, index = element[:-1].split("[")
    return f"%{name} = getelementptr double, ptr %{buffer}, i64 {index}"


def _llvm(operand: Operand) -> str:
    if type(operand) is int:
        return f"%v{operand}"
    return f"0x{struct.unpack('<Q', struct.pack('<d', operand))[0]:016X}"
