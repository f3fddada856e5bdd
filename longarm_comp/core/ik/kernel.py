"""The model as small traced programs, for the inverse kinematics.

At the trial joints, `rigid` computes the tip and its Jacobian without loads and context, `first`
the twists under the rigid arm's loads, `again` the twists under the loads of the arm with given
twists, and `tip` the tip and Jacobian of that arm.  The other programs are the search of `newton`.
All are traced from the package's own Python and give its numbers.  Parameters are constants in
them; joints and context are inputs.  They run on floats, on arrays, or (with llvmlite) as machine
code, which is compiled in about a second.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial
from typing import Any

from longarm_comp.core.arm import spatial
from longarm_comp.core.arm.context import Layout
from longarm_comp.core.arm.posture import Posture, Twists
from longarm_comp.core.arm.spatial import ZERO, Vec
from longarm_comp.core.ik import newton
from longarm_comp.core.ik.codegen import python as emit
from longarm_comp.core.ik.codegen.symbolic import Graph, Symbol
from longarm_comp.core.model.model import Model


def geometric(posture: Posture, tip: Vec, station: float = math.inf) -> list[tuple[Vec, Vec]]:
    """Tip velocity (m, base frame) and angular velocity (rad) per unit of each commanded joint.

    Of another point ``station`` is the one that carries it: rows after it are left out.

    A revolute row turns all that follows about the z axis of its bearing; a prismatic row
    pushes it along the z axis of its frame.  Passive rows follow through the arm's mixing.
    The sag is kept constant, so on a soft arm the Jacobian is a few percent off.
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


_Fixed = dict[tuple[int, int], float]
_Slots = dict[tuple[int, int], int]
_Work = Callable[[newton.State], newton.Outcome]
_Program = tuple[Graph, emit.Outputs]


class _Traced(dict[str, _Program]):
    """Programs by name, each traced on its first use."""

    def __init__(self, works: Mapping[str, _Work], place: Mapping[str, range]) -> None:
        super().__init__()
        self.works, self._place = works, place

    def __missing__(self, name: str) -> _Program:
        graph = Graph()
        state = {k: [graph.input(str(i)) for i in r] for k, r in self._place.items()}
        outputs = {
            self._place[part][k]: value
            for part, values in self.works[name](state).items()
            for k, value in enumerate(values)
            if value is not state[part][k]  # unchanged values need no writing
        }
        self[name] = graph, outputs
        return self[name]


class Kernel:
    """The traced programs of one arm and, if it is traceable, of one model.

    Attributes:
        place: layout of a search's state (`newton.rows`).
        size: length of the state.
        passes: load passes of the model.
        layout: layout of the context.
        twisted: components of twists that are constant, and places of the others in ``x``.
        lower, upper, mid: the joint box.
        workload: work done before it is compiled, in single targets.
        flows: `search3` and `search6` start from joints q, `solve3` and `solve6` from a seed and
            a matrix.
    """

    def __init__(self, model: Model, layout: Layout) -> None:
        self.layout, self.n = layout, model.arm.n
        self.lower, self.upper, self.mid = model.arm.lower, model.arm.upper, model.arm.mid
        fixed, slot = self.twisted = _twist_slots(model, layout)
        self.place = newton.rows(self.n, layout.count, len(slot))
        self.size = 1 + max(r[-1] for r in self.place.values() if r)
        self.passes, self.workload = model.load_passes, 0.0
        self.flows: dict[str, newton.Flow] = {}
        for m in (3, 6):
            search = newton.flow(self.passes, m)
            self.flows |= {f"search{m}": search, f"solve{m}": (f"accept{m}", *search)}
        works = self._model_works(model, fixed, slot) | self._search_works(model)
        self.programs = _Traced(works, self.place)

    def slice(self, name: str) -> slice:
        """Slice of a quantity in the state."""
        return slice(self.place[name].start, self.place[name].stop)

    def _search_works(self, model: Model) -> dict[str, _Work]:
        span = [float(v) for v in model.arm.upper - model.arm.lower]
        length = characteristic_length(model)
        works: dict[str, _Work] = {"begin": lambda s: newton.begin(self.n), "open": newton.opening}
        for m in (3, 6):
            works[f"accept{m}"] = partial(newton.accept, m=m)
            for level in newton.LEVELS:
                of_level = partial(newton.judge, span=span, length=length, m=m, level=level)
                works[f"judge{m}_{level.evaluate}"] = of_level
            works[f"round{m}"] = partial(newton.step_in_box, span=span, m=m)
        return works

    def _model_works(self, model: Model, fixed: _Fixed, slot: _Slots) -> dict[str, _Work]:
        def seen(posture: Posture) -> newton.Outcome:
            return {"out": tip_and_jacobian(model, posture)}

        def at(s: newton.State, x: Sequence[Any] | None) -> Posture:
            context = self.layout.unpack(s["c"])
            if x is None:
                return model.unsagged(tuple(s["trial"]), context)
            return model.loaded(tuple(s["trial"]), context, self.twists(x))

        def carried(posture: Posture) -> newton.Outcome:
            twists = model.twists(posture)
            return {"x": [twists[station][i] for station, i in slot]}

        return {
            "rigid": lambda s: seen(at(s, [0.0] * len(slot))),
            "first": lambda s: carried(at(s, None)),
            "again": lambda s: carried(at(s, s["x"])),
            "tip": lambda s: seen(at(s, s["x"])),
        }

    def twists(self, x: Sequence[Any]) -> Twists:
        """The effects' twists by station, of the row ``x`` of a state."""
        fixed, slot = self.twisted
        made: dict[int, Any] = {
            station: tuple(
                fixed[station, i] if (station, i) in fixed else x[slot[station, i]]
                for i in range(6)
            )
            for station in {station for station, _ in (*fixed, *slot)}
        }
        return made

    @cached_property
    def floats(self) -> dict[str, Any]:
        """The programs by name, on a list of floats."""
        return _Python(self.programs, arrays=False)

    @cached_property
    def arrays(self) -> dict[str, Any]:
        """The programs by name, on rows (size, N)."""
        return _Python(self.programs, arrays=True)

    @cached_property
    def code(self) -> Any:
        """The programs and flows as machine code: see `machine_code`."""
        from longarm_comp.core.ik.codegen import llvm as emit_llvm
        from longarm_comp.core.ik.codegen import machine_code

        width = machine_code.lanes()
        programs = {name: self.programs[name] for name in self.programs.works}
        text = emit_llvm.module(programs, self.flows, self.place, width)
        self.programs.clear()  # frees the graphs; they are traced again where they are asked for
        return machine_code.compile_module(text, width)


_BEYOND = {"inf": math.inf, "nan": math.nan}
"""Constants of an absurd arm, as Python prints them."""


class _Python(dict[str, Any]):
    """Programs as Python functions, each generated on its first use."""

    def __init__(self, programs: Mapping[str, _Program], arrays: bool) -> None:
        super().__init__()
        self.programs, self.arrays = programs, arrays

    def __missing__(self, name: str) -> Any:
        space = dict(emit.ARRAYS if self.arrays else emit.FLOATS) | _BEYOND
        text = emit.python(name, *self.programs[name], self.arrays)
        exec(compile(text, f"<traced {name}>", "exec"), space)
        self[name] = space[name]
        return self[name]


def tip_and_jacobian(model: Model, posture: Posture) -> list[Any]:
    """Tip, its axes n, o, a, and the Jacobian row after row, 12 + 6 n."""
    tip = model.tip_frame(posture)
    columns = geometric(posture, tip.p)
    axes = [*tip.p, *tip.n, *tip.o, *tip.a]
    return axes + [column[i // 3][i % 3] for i in range(6) for column in columns]


def characteristic_length(model: Model) -> float:
    """Weight of a radian of tool angle in metres: a quarter of the stretched arm."""
    size = sum(abs(j.a_m) + abs(j.d_m) for j in model.arm.joints)
    return max(0.25 * size, 0.01)


def _twist_slots(model: Model, layout: Layout) -> tuple[_Fixed, _Slots]:
    """Components of twists (station, number): constant ones, and places of the others.

    The constant ones depend neither on joints nor on context or loads.
    """
    graph = Graph()
    q = tuple(graph.input(f"q{i}") for i in range(model.arm.n))
    context = layout.unpack([graph.input(f"c{k}") for k in range(layout.count)])
    start = model.twists(model.unsagged(q, context))
    free = {s: tuple(graph.input(f"x{s}, {i}") for i in range(6)) for s in start}
    again = model.twists(model.loaded(q, context, free))  # type: ignore[arg-type]
    fixed: _Fixed = {}
    slot: _Slots = {}
    for s in sorted(start):
        for i in range(6):
            if not isinstance(again[s][i], Symbol) and again[s][i] == start[s][i]:
                fixed[s, i] = float(start[s][i])
            else:
                slot[s, i] = len(slot)
    return fixed, slot


MOST_KERNELS = 8
"""Kernels kept, the last used: of the model at work, the rigid one, the one before and the one that
is learned, each with what is known of two kinds of targets.  A compiled one takes some 2 MB."""
_kernels: OrderedDict[tuple[Any, ...], Kernel] = OrderedDict()


def kernel_of(model: Model, layout: Layout) -> Kernel:
    """The kernel of a model, traced on first use and kept by content."""
    held: dict[Layout, Kernel] = model.__dict__.setdefault("_kernels", {})
    if layout not in held:
        key = (model.arm.hash, repr(model.effects), model.passes, model.elements_per_beam, layout)
        if key not in _kernels:
            _kernels[key] = Kernel(model, layout)
        _kernels.move_to_end(key)
        while len(_kernels) > MOST_KERNELS:
            _kernels.popitem(last=False)
        held[layout] = _kernels[key]
    return held[layout]
