"""Straight-line code of a graph as LLVM's assembly, several columns side by side in lanes.

Every program is ``void name(ptr s)`` over a block of columns: number k of lane l is
``s[k * width + l]``.  A flow of programs becomes a function of loops around calls, and for
each ``many_name(blocks, count)`` runs it on blocks that follow each other in memory.
A product and a sum may be fused: results differ from those of Python in the last digits.
llvmlite compiles it.
"""

import ctypes
import struct
from collections.abc import Iterator, Mapping
from itertools import count
from typing import Any

from llvmlite import binding

from longarm_comp.core.ik.codegen import Compiled
from longarm_comp.core.ik.codegen.symbolic import Graph, Operand, Outputs, Program, Symbol
from longarm_comp.core.ik.newton import Flow

_INTRINSIC = ("fabs", "sqrt", "floor")
_LIBRARY = {"tan": 1, "tanh": 1, "exp": 1, "expm1": 1, "log": 1, "pow": 2}
_ARITHMETIC = {"add": "fadd", "sub": "fsub", "mul": "fmul", "div": "fdiv"}
_COMPARE = {"lt": "olt", "le": "ole"}
_CHOICE = {"minimum": "olt", "maximum": "ogt"}


def write_module(
    programs: Mapping[str, Program],
    flows: Mapping[str, Flow],
    place: Mapping[str, range],
    width: int,
) -> str:
    """Return the LLVM assembly of programs, and of flows that call them.

    Args:
        place: rows of the state by name (`newton.rows`).
        width: number of columns that are worked on at a time.
    """
    writer = _Writer(width)
    lines = writer.outside()
    size = width * (1 + max(r[-1] for r in place.values() if r))
    bodies = {name: writer.program(*program) for name, program in programs.items()}
    bodies |= {name: writer.flow(work, place, count()) for name, work in flows.items()}
    for name, body in bodies.items():
        lines += [f"define void @{name}(ptr %s) #0 {{", *body, "ret void", "}"]
        lines += _many(name, size)
    lines += ["attributes #0 = { nounwind }", "attributes #1 = { nounwind memory(none) }", ""]
    return "\n".join(lines)


class _Writer:
    """Lines of assembly for one width."""

    def __init__(self, width: int) -> None:
        self.width = width
        self.kind = f"<{width} x double>"
        self.flag = f"<{width} x i1>"

    def outside(self) -> list[str]:
        """Declare the functions that are called; those of the C library are called lane by lane."""
        width, kind = self.width, self.kind
        lines = [f"declare {kind} @llvm.{f}.v{width}f64({kind}) #1" for f in _INTRINSIC]
        for name, arguments in _LIBRARY.items():
            lines.append(f"declare double @{name}({', '.join(['double'] * arguments)}) #1")
            given = ", ".join(f"{kind} %a{k}" for k in range(arguments))
            lines.append(f"define internal {kind} @lanes_{name}({given}) #1 {{")
            held = "poison"
            for lane in range(width):
                args = []
                for k in range(arguments):
                    lines.append(f"%x{k}_{lane} = extractelement {kind} %a{k}, i32 {lane}")
                    args.append(f"double %x{k}_{lane}")
                lines.append(f"%y{lane} = call double @{name}({', '.join(args)})")
                lines.append(f"%r{lane} = insertelement {kind} {held}, double %y{lane}, i32 {lane}")
                held = f"%r{lane}"
            lines += [f"ret {kind} {held}", "}"]
        return lines

    def program(self, graph: Graph, outputs: Outputs) -> list[str]:
        lines = []
        for node in graph.needed_nodes(list(outputs.values())):
            lines += self._instructions(node, *graph.nodes[node])
        for k, (place, out) in enumerate(outputs.items()):
            value = self._value(out.node if isinstance(out, Symbol) else float(out))
            lines += [self._address(f"o{k}", place)]
            lines += [f"store {self.kind} {value}, ptr %o{k}, align 8"]
        return lines

    def flow(self, work: Flow, place: Mapping[str, range], number: Iterator[int]) -> list[str]:
        """Write the calls of a flow, and its loops, which run while a lane of a row is not 0."""
        lines: list[str] = []
        for step in work:
            if isinstance(step, str):
                lines.append(f"call void @{step}(ptr %s)")
                continue
            k = next(number)
            lines += [f"br label %look{k}", f"look{k}:", self._address(f"p{k}", place[step.row][0])]
            lines += [f"%v{k} = load {self.kind}, ptr %p{k}, align 8"]
            lines += [f"%f{k} = fcmp une {self.kind} %v{k}, zeroinitializer"]
            lines += [f"%i{k} = bitcast {self.flag} %f{k} to i{self.width}"]
            lines += [f"%b{k} = icmp ne i{self.width} %i{k}, 0"]
            lines += [f"br i1 %b{k}, label %body{k}, label %end{k}", f"body{k}:"]
            lines += [*self.flow(step.body, place, number), f"br label %look{k}", f"end{k}:"]
        return lines

    def _instructions(self, node: int, op: str, operands: tuple[Operand, ...]) -> list[str]:
        v, kind, flag = f"%v{node}", self.kind, self.flag
        if op == "input":
            return [
                self._address(f"p{node}", int(operands[0])),
                f"{v} = load {kind}, ptr %p{node}, align 8",
            ]
        a = [self._value(o) for o in operands]
        if op in _ARITHMETIC:
            return [f"{v} = {_ARITHMETIC[op]} contract {kind} {a[0]}, {a[1]}"]
        if op == "neg":
            return [f"{v} = fneg {kind} {a[0]}"]
        if op in _COMPARE:  # conditions are numbers, 1.0 or 0.0, as elsewhere
            return [
                f"%c{node} = fcmp {_COMPARE[op]} {kind} {a[0]}, {a[1]}",
                f"{v} = uitofp {flag} %c{node} to {kind}",
            ]
        if op == "select":
            return [
                f"%c{node} = fcmp une {kind} {a[0]}, zeroinitializer",
                f"{v} = select {flag} %c{node}, {kind} {a[1]}, {kind} {a[2]}",
            ]
        if op in _CHOICE:
            return [
                f"%c{node} = fcmp {_CHOICE[op]} {kind} {a[1]}, {a[0]}",
                f"{v} = select {flag} %c{node}, {kind} {a[1]}, {kind} {a[0]}",
            ]
        given = ", ".join(f"{kind} {x}" for x in a)
        called = f"llvm.{op}.v{self.width}f64" if op in _INTRINSIC else f"lanes_{op}"
        return [f"{v} = call {kind} @{called}({given})"]

    def _address(self, name: str, place: int) -> str:
        return f"%{name} = getelementptr double, ptr %s, i64 {place * self.width}"

    def _value(self, operand: Operand) -> str:
        if type(operand) is int:
            return f"%v{operand}"
        number = f"double 0x{struct.unpack('<Q', struct.pack('<d', operand))[0]:016X}"
        return f"<{', '.join([number] * self.width)}>"


def _many(name: str, size: int) -> list[str]:
    return [
        f"define void @many_{name}(ptr %blocks, i64 %count) #0 {{",
        "entry:",
        "%any = icmp sgt i64 %count, 0",
        "br i1 %any, label %loop, label %end",
        "loop:",
        "%i = phi i64 [ 0, %entry ], [ %next, %loop ]",
        f"%by = mul i64 %i, {size}",
        "%s = getelementptr double, ptr %blocks, i64 %by",
        f"call void @{name}(ptr %s)",
        "%next = add i64 %i, 1",
        "%more = icmp slt i64 %next, %count",
        "br i1 %more, label %loop, label %end",
        "end:",
        "ret void",
        "}",
    ]


class _Code:
    """A loaded module.

    Attributes:
        width: columns that a function works on at a time.
    """

    def __init__(self, engine: Any, width: int) -> None:
        self._engine, self.width = engine, width
        self._functions: dict[str, Any] = {}

    def function(self, name: str) -> Any:
        """Return a compiled function by its name.

        It takes the address of a block; a `many_...` function takes the number of blocks too.
        """
        if name not in self._functions:
            arguments = [ctypes.c_void_p, ctypes.c_ssize_t][: 2 if name.startswith("many_") else 1]
            kind = ctypes.CFUNCTYPE(None, *arguments)
            compiled: Any = kind(self._engine.get_function_address(name))
            compiled.engine = self._engine  # keeps the machine code alive with the function
            self._functions[name] = compiled
        return self._functions[name]


def count_lanes() -> int:
    """Return the number of doubles in a vector register of this processor."""
    features = binding.get_host_cpu_features()
    return 8 if features.get("avx512f") else 4 if features.get("avx") else 2


def compile_module(text: str, width: int, level: int = 1) -> _Code:
    """Compile straight-line code without LLVM's optimisation passes.

    They would make the code 3 % faster, and compiling it take twice as long.

    Args:
        level: of the generation of code; at 0 it takes a quarter of the time, the code twice.
    """
    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    module = binding.parse_assembly(text)
    module.verify()
    machine = binding.Target.from_default_triple().create_target_machine(
        cpu=binding.get_host_cpu_name(),
        features=binding.get_host_cpu_features().flatten(),
        opt=level,
        jit=True,
    )
    code = binding.ObjectFileRef.from_data(machine.emit_object(module))
    # The engine keeps its module: a third of the memory where that is empty.
    engine = binding.create_mcjit_compiler(binding.parse_assembly(""), machine)
    engine.add_object_file(code)
    engine.finalize_object()
    Compiled.programs += 1
    return _Code(engine, width)
