"""Compilation of LLVM assembly to machine code by llvmlite."""

from __future__ import annotations

import ctypes
from typing import Any

import llvmlite.binding as llvm

from longarm_comp.core.ik.codegen import Compiled


class _Code:
    """A loaded module.

    Attributes:
        width: columns that a function works on at a time.
    """

    def __init__(self, engine: Any, width: int) -> None:
        self._engine, self.width = engine, width
        self._functions: dict[str, Any] = {}

    def function(self, name: str) -> Any:
        """A function of the address of its block; `many_...` takes their number too."""
        if name not in self._functions:
            arguments = [ctypes.c_void_p, ctypes.c_ssize_t][: 2 if name.startswith("many_") else 1]
            kind = ctypes.CFUNCTYPE(None, *arguments)
            compiled: Any = kind(self._engine.get_function_address(name))
            compiled.engine = self._engine  # keeps the machine code alive with the function
            self._functions[name] = compiled
        return self._functions[name]


def lanes() -> int:
    """Number of doubles in a vector register of this processor."""
    features = llvm.get_host_cpu_features()
    return 8 if features.get("avx512f") else 4 if features.get("avx") else 2


def compile_module(text: str, width: int) -> _Code:
    """Compile straight-line code, without LLVM's passes: they save 3 % and double the time."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    module = llvm.parse_assembly(text)
    module.verify()
    machine = llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(),
        features=llvm.get_host_cpu_features().flatten(),
        opt=1,
        jit=True,
    )
    code = llvm.ObjectFileRef.from_data(machine.emit_object(module))
    # The engine keeps its module: a third of the memory where that is empty.
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine)
    engine.add_object_file(code)
    engine.finalize_object()
    Compiled.programs += 1
    return _Code(engine, width)
