"""The model as small programs, for the inverse kinematics.

At the trial joints, `first` computes the twists under the rigid arm's loads, `again` the twists
under the loads of the arm with given twists, and `tip` the tip and Jacobian of that arm.  The other
programs are the search of `newton`.  A `Kernel` traces them and compiles them to machine code:
parameters are constants there, joints and context are inputs.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np

from longarm_comp.core.arm import spatial
from longarm_comp.core.arm.context import Context, Layout
from longarm_comp.core.arm.posture import Posture, Twists
from longarm_comp.core.arm.spatial import ZERO, Vec
from longarm_comp.core.ik import newton
from longarm_comp.core.ik.codegen.symbolic import Graph, Program, Symbol
from longarm_comp.core.model.model import Model


def rigid_jacobian(posture: Posture, tip: Vec, station: float = math.inf) -> list[tuple[Vec, Vec]]:
    """Return the tip's translation and rotation per unit of each commanded joint, base frame.

    The sag is kept constant, so on a soft arm the Jacobian is a few percent off.

    Args:
        tip: the point that moves, base frame, m.
        station: the station that carries the point, if it is not the tip. Rows behind it do not
            move the point.
    """
    chain = posture.chain
    columns: list[tuple[Vec, Vec]] = [(ZERO, ZERO)] * chain.arm.n
    for joint, row, weights in zip(chain.arm.joints, chain.rows, chain.mixing, strict=True):
        if joint.type == "fixed" or row.bearing > station:
            continue
        if joint.type == "revolute":
            bearing = posture.frames[row.bearing]
            lever = spatial.sub(tip, bearing.p)
            linear, angular = spatial.cross(bearing.a, lever), bearing.a
        else:
            linear, angular = posture.frames[row.frame].a, ZERO
        for k, weight in enumerate(weights):
            if weight != 0.0:
                w = float(weight)
                held = columns[k]
                shift, turn = spatial.scale(w, linear), spatial.scale(w, angular)
                columns[k] = spatial.add(held[0], shift), spatial.add(held[1], turn)
    return columns


@dataclass(frozen=True)
class TwistRow:
    """The effects' twists of all stations as one row of numbers, the ``x`` of a search's state."""

    slot: dict[tuple[int, int], int]  # position in the row, by (station, component 0 to 5)
    fixed: dict[tuple[int, int], float]  # values that are not in the row, by the same keys

    @classmethod
    def whole(cls, model: Model, context: Context) -> TwistRow:
        stations = model.twists(model.posture_without_sag(tuple(model.arm.mid.tolist()), context))
        return cls({(s, i): 6 * k + i for k, s in enumerate(stations) for i in range(6)}, {})

    @classmethod
    def trace(cls, model: Model, layout: Layout) -> TwistRow:
        """Return a row of those components only that depend on joints, context or loads."""
        graph = Graph()
        q = tuple(graph.input(f"q{i}") for i in range(model.arm.n))
        context = layout.unpack([graph.input(f"c{k}") for k in range(layout.count)])
        start = model.twists(model.posture_without_sag(q, context))
        free = {s: tuple(graph.input(f"x{s}, {i}") for i in range(6)) for s in start}
        again = model.twists(model.posture_with_twists(q, context, free))  # type: ignore[arg-type]
        row = cls({}, {})
        for s in sorted(start):
            for i in range(6):
                if not isinstance(again[s][i], Symbol) and again[s][i] == start[s][i]:
                    row.fixed[s, i] = float(start[s][i])
                else:
                    row.slot[s, i] = len(row.slot)
        return row

    def twists(self, x: Sequence[Any] | np.ndarray) -> Twists:
        fixed, slot = self.fixed, self.slot
        made: dict[int, Any] = {
            station: tuple(
                fixed[station, i] if (station, i) in fixed else x[slot[station, i]]
                for i in range(6)
            )
            for station in {station for station, _ in (*fixed, *slot)}
        }
        return made


Work = Callable[[newton.State], newton.Outcome]


def works(
    model: Model, context_of: Callable[[newton.State], Context], row: TwistRow
) -> dict[str, Work]:
    """Return the programs of a model by name.

    Args:
        context_of: returns the circumstances that belong to a state.
        row: the components of the twists that a state holds.
    """

    def at(s: newton.State, x: Sequence[Any]) -> Posture:
        return model.posture_with_twists(tuple(s["trial"]), context_of(s), row.twists(x))

    def carry(posture: Posture) -> newton.Outcome:
        twists = model.twists(posture)
        return {"x": [twists[station][i] for station, i in row.slot]}

    span = [float(v) for v in model.arm.upper - model.arm.lower]
    made: dict[str, Work] = {
        "first": lambda s: carry(model.posture_without_sag(tuple(s["trial"]), context_of(s))),
        "again": lambda s: carry(at(s, s["x"])),
        "tip": lambda s: {"out": tip_and_jacobian(model, at(s, s["x"]))},
        "begin": lambda s: newton.begin_search(model.arm.n),
        "open": newton.open_level,
    }
    for m in (3, 6):
        made[f"accept{m}"] = partial(newton.accept, m=m)
        for level in newton.LEVELS:
            of_level = partial(newton.judge, span=span, m=m, level=level)
            made[f"judge{m}_{level.evaluate}"] = of_level
        made[f"round{m}"] = partial(newton.step_in_box, span=span, m=m)
    return made


class Kernel:
    """The programs of a model for one layout of the context, as machine code when asked for.

    Attributes:
        passes: load passes of the model.
        workload: work done so far, counted in single targets; it decides when to compile.
    """

    def __init__(self, model: Model, layout: Layout) -> None:
        self._model, self.arm, self.layout = model, model.arm, layout
        self.passes, self.workload = model.load_passes, 0.0
        self._code: Any = None

    @cached_property
    def row(self) -> TwistRow:
        """The components of the twists that the state holds."""
        return TwistRow.trace(self._model, self.layout)

    @cached_property
    def place(self) -> dict[str, range]:
        """Layout of a search's state (`newton.rows`)."""
        return newton.rows(self._model.arm.n, self.layout.count, len(self.row.slot))

    @property
    def size(self) -> int:
        """The number of scalars in the state of a search."""
        return 1 + max(r[-1] for r in self.place.values() if r)

    def slice(self, name: str) -> slice:
        """Return the slice of a quantity in the state."""
        return slice(self.place[name].start, self.place[name].stop)

    @property
    def is_compiled(self) -> bool:
        """True if there is machine code already."""
        return self._code is not None

    @property
    def code(self) -> Any:
        """The programs as machine code (see `codegen.llvm`), and flows of them.

        `search3` and `search6` start from joints q, `solve3` and `solve6` from a seed and a matrix;
        `evaluate` is the model itself at the trial joints.
        """
        if self._code is None:
            self._code = self._compile()
        return self._code

    def _compile(self) -> Any:
        evaluate = newton.evaluation(newton.LEVELS[-1], self.passes, True)
        flows: dict[str, newton.Flow] = {"evaluate": evaluate}
        for m in (3, 6):
            search = newton.flow(self.passes, m)
            flows |= {f"search{m}": search, f"solve{m}": (f"accept{m}", *search)}
        return self._compile_works(
            works(self._model, lambda s: self.layout.unpack(s["c"]), self.row), flows
        )

    def _compile_works(
        self, made: dict[str, Work], flows: dict[str, newton.Flow], level: int = 1
    ) -> Any:
        """Trace programs, and compile them with flows of them; `level` as in `compile_module`."""
        from longarm_comp.core.ik.codegen import llvm

        width = llvm.count_lanes()
        programs: dict[str, Program] = {}
        for name, work in made.items():
            graph = Graph()
            state = {k: [graph.input(str(i)) for i in r] for k, r in self.place.items()}
            outputs = {
                self.place[part][k]: value
                for part, values in work(state).items()
                for k, value in enumerate(values)
                if value is not state[part][k]  # unchanged values need no writing
            }
            programs[name] = graph, outputs
        text = llvm.write_module(programs, flows, self.place, width)
        return llvm.compile_module(text, width, level)


def tip_and_jacobian(model: Model, posture: Posture) -> list[Any]:
    """Return 12 + 6 n numbers: the tip's position, its axes n, o, a, and the Jacobian by rows."""
    tip = model.tip_frame(posture)
    columns = rigid_jacobian(posture, tip.p)
    axes = [*tip.p, *tip.n, *tip.o, *tip.a]
    return axes + [column[i // 3][i % 3] for i in range(6) for column in columns]


def characteristic_length(model: Model) -> float:
    """Return the length (m) that a radian of the tool's angle counts as in a search.

    It is a quarter of the sum of all DH lengths, at least 0.01 m.
    """
    if "length" not in model.memo:
        size = sum(abs(j.a_m) + abs(j.d_m) for j in model.arm.joints)
        model.memo["length"] = max(0.25 * size, 0.01)
    length: float = model.memo["length"]
    return length


MOST_KERNELS = 8
"""Number of kernels kept, the last used ones: four models with two layouts each. One takes 2 MB,
and 2 MB with its columns."""
_kernels: OrderedDict[tuple[Any, ...], Kernel] = OrderedDict()


def kept_kernels(model: Model) -> dict[Layout, Kernel]:
    """Return the kernels that a model has so far, by layout of the context."""
    kernels: dict[Layout, Kernel] = model.memo.setdefault("kernels", {})
    return kernels


def kernel_of(model: Model, layout: Layout) -> Kernel:
    """Return the kernel of a model for a layout; models of equal content share one."""
    kept = kept_kernels(model)
    if layout not in kept:
        key = (model.arm.hash, repr(model.effects), model.passes, model.elements_per_beam, layout)
        if key not in _kernels:
            _kernels[key] = Kernel(model, layout)
        _kernels.move_to_end(key)
        while len(_kernels) > MOST_KERNELS:
            _kernels.popitem(last=False)
        kept[layout] = _kernels[key]
    return kept[layout]
