"""LLVM assembly to machine code, through llvmlite (optional; numba brings it)."""

from __future__ import annotations

from functools import cache
from typing import Any

import llvmlite.binding as llvm


class Code:
    """A loaded module; its functions live as long as this object."""

    def __init__(self, engine: Any) -> None:
        self._engine = engine

    def address(self, name: str) -> int:
        """Address of a function."""
        return int(self._engine.get_function_address(name))


@cache
def _prepare() -> None:
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()


def compile_module(text: str) -> Code:
    """Compile straight-line code; heavier optimisation was tried and gained nothing."""
    _prepare()
    module = llvm.parse_assembly(text)
    module.verify()
    machine = llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(),
        features=llvm.get_host_cpu_features().flatten(),
        opt=1,
        jit=True,
    )
    options = llvm.create_pipeline_tuning_options(speed_level=1)
    builder = llvm.create_pass_builder(machine, options)
    builder.getModulePassManager().run(module, builder)
    engine = llvm.create_mcjit_compiler(module, machine)
    engine.finalize_object()
    return Code(engine)
