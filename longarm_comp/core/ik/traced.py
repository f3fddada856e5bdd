"""Programs and their flow, traced once and run on N columns of numbers.

With llvmlite they run as machine code on several columns in parallel, without it in plain Python on
one after the other.  The results differ only in their last digits.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any

import numpy as np

from longarm_comp.core.ik.codegen import python as emit
from longarm_comp.core.ik.codegen.symbolic import Graph
from longarm_comp.core.ik.engines import Circumstance, worth_compiling
from longarm_comp.core.ik.newton import Flow, Outcome, State, run


class Traced:
    """A flow of programs.

    Args:
        place: layout of a column, by name.
        work: programs by name; each maps the state to the values that it writes.
        flow: order of the programs.
    """

    def __init__(
        self, place: dict[str, range], work: Mapping[str, Callable[[State], Outcome]], flow: Flow
    ) -> None:
        self.place, self.flow, self.workload = place, flow, 0
        self.size = 1 + max(r[-1] for r in place.values())
        self.programs = {name: self._traced(do) for name, do in work.items()}

    def _traced(self, do: Callable[[State], Outcome]) -> tuple[Graph, emit.Outputs]:
        graph = Graph()
        state = {k: [graph.input(str(i)) for i in r] for k, r in self.place.items()}
        written = {
            self.place[name][k]: value
            for name, values in do(state).items()
            for k, value in enumerate(values)
            if value is not state[name][k]  # unchanged values need no writing
        }
        return graph, written

    def slice(self, name: str) -> slice:
        """Slice of a quantity in a column."""
        return slice(self.place[name].start, self.place[name].stop)

    def run(
        self, given: Mapping[str, np.ndarray], count: int, compiled: bool | None = None
    ) -> np.ndarray:
        """The columns of N runs, (N, size), each started from zeros and given values (N, k).

        Args:
            compiled: machine code or plain Python; by default machine code once it pays
                (`engines.warm_up`, or after some hundred runs) where llvmlite is at hand.
        """
        self.workload += count
        if compiled is None:
            compiled = "_code" in self.__dict__ or worth_compiling(self.workload)
        return self._compiled(given, count) if compiled else self._interpreted(given, count)

    @cached_property
    def _floats(self) -> dict[str, Any]:
        space = dict(emit.FLOATS)
        for name, (graph, written) in self.programs.items():
            exec(compile(emit.python(name, graph, written), f"<traced {name}>", "exec"), space)
        return {name: space[name] for name in self.programs}

    @cached_property
    def _code(self) -> Any:
        from longarm_comp.core.ik.codegen import llvm, machine_code

        width = machine_code.lanes()
        text = llvm.module(self.programs, {"flow": self.flow}, self.place, width)
        return machine_code.compile_module(text, width)

    def _interpreted(self, given: Mapping[str, np.ndarray], count: int) -> np.ndarray:
        state = np.zeros((count, self.size))
        for name, values in given.items():
            state[:, self.slice(name)] = values
        columns = state.tolist()
        for s in columns:
            column = Circumstance(self._floats, self.place, s)
            run(self.flow, column.call, column.repeat)
        return np.array(columns).reshape(count, self.size)

    def _compiled(self, given: Mapping[str, np.ndarray], count: int) -> np.ndarray:
        width = self._code.width
        blocks = np.zeros((-(-count // width), self.size, width))
        for name, values in given.items():
            lanes = np.zeros((len(blocks) * width, values.shape[1]))
            lanes[:count] = values
            lanes = lanes.reshape(len(blocks), width, values.shape[1])
            blocks[:, self.slice(name)] = lanes.swapaxes(1, 2)
        self._code.function("many_flow")(blocks.ctypes.data, len(blocks))
        return blocks.swapaxes(1, 2).reshape(-1, self.size)[:count]
