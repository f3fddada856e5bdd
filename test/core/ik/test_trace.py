"""Traced programs give the numbers of the model they were traced from."""

import dataclasses
import gc
import math
import weakref

import numpy as np
import pytest
from every_circumstance import N, circumstances

from longarm_comp.core.arm import angles, spatial
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.effects.catalogue import BUILT_IN
from longarm_comp.core.effects.effect import Bias, Effect
from longarm_comp.core.effects.geometry_errors import JointZero
from longarm_comp.core.effects.link_deflection import LinkDeflection
from longarm_comp.core.ik import newton
from longarm_comp.core.ik.codegen import Compiled
from longarm_comp.core.ik.codegen.llvm import compile_module, write_module
from longarm_comp.core.ik.codegen.symbolic import Graph, Symbol
from longarm_comp.core.ik.columns import tip_and_columns
from longarm_comp.core.ik.engines import compile_at_once
from longarm_comp.core.ik.kernel import MOST_KERNELS, Kernel, kernel_of, tip_and_jacobian, works
from longarm_comp.core.model.model import Model, slots_of, unstack


def situation(arm: Arm) -> tuple[np.ndarray, Context]:
    """Every circumstance but texts, which are not traced."""
    q, context = circumstances(arm)
    return q, dataclasses.replace(context, labels={})


def valued(term: Effect, rng: np.random.Generator) -> Effect:
    """The effect with parameters of a size that a fit would find."""
    return term.with_values(
        {
            p.name: float(np.clip(0.7 * p.prior * rng.standard_normal(), p.lower, p.upper))
            for p in term.declared()
            if p.prior > 0
        }
    )


def effects(arm: Arm, name: str) -> tuple[Effect, ...]:
    rng = np.random.default_rng(3)
    terms = BUILT_IN[name].for_arm(arm)
    return tuple(valued(t, rng) for t in terms if isinstance(t, Effect))


def everything(arm: Arm) -> Model:
    """All arm-side effects at once."""
    return Model(arm, tuple(e for name in sorted(BUILT_IN) for e in effects(arm, name)))


def evaluated(kernel: Kernel, q: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Tip, axes and Jacobian (12 + 6 n, N) after all load passes, in machine code."""
    s = np.zeros((kernel.size, len(q)))
    s[kernel.slice("trial")], s[kernel.slice("c")] = q.T, rows.T
    for name in newton.evaluation(newton.LEVELS[-1], kernel.passes, anew=True):
        in_lanes(kernel, name, s)
    return s[kernel.slice("out")]


def in_lanes(kernel: Kernel, name: str, s: np.ndarray) -> None:
    """Run a program on columns in blocks of lanes; the last block is not full."""
    width, count = kernel.code.width, s.shape[1]
    blocks = np.zeros((-(-count // width), kernel.size, width))
    for k in range(count):
        blocks[k // width, :, k % width] = s[:, k]
    kernel.code.function(f"many_{name}")(blocks.ctypes.data, len(blocks))
    for k in range(count):
        s[:, k] = blocks[k // width, :, k % width]


def by_the_model(model: Model, q: np.ndarray, context: Context) -> np.ndarray:
    """The same by the model's own code."""
    made = np.empty((12 + 6 * model.arm.n, len(q)))
    for row, value in zip(
        made, tip_and_jacobian(model, model.posture(tuple(q.T), context)), strict=True
    ):
        row[:] = value
    return made


def agree(model, layout, q, context):
    """Machine code gives the model's own numbers."""
    made = evaluated(Kernel(model, layout), q, layout.pack(context, N))
    np.testing.assert_allclose(made, by_the_model(model, q, context), rtol=0, atol=1e-12)


@pytest.mark.long
@pytest.mark.parametrize("name", sorted(BUILT_IN))
def test_each_effect_traced_is_the_effect(arm, name):
    """Which one it is, where all at once are not the same."""
    q, context = situation(arm)
    own = effects(arm, name)
    if not own:
        assert not any(isinstance(t, Effect) for t in BUILT_IN[name].for_arm(arm))
        return
    load = (LinkDeflection(),) if name != "link_deflection" else ()
    model, layout = Model(arm, own + load), context.layout
    agree(model, layout, q, context)


def test_machine_code_gives_the_same_numbers(arm):
    """All effects at once, through LLVM, in lanes."""
    q, context = situation(arm)
    agree(everything(arm), context.layout, q, context)


def test_every_program_of_the_search_in_machine_code(arm):
    """From states in the midst of a search."""
    model = Model(arm, (LinkDeflection(),))
    context = Context()
    kernel = Kernel(model, context.layout)
    own = works(model, lambda s: context, kernel.row)
    rng = np.random.default_rng(5)
    q = rng.uniform(arm.lower, arm.upper, (N, arm.n))
    s = np.zeros((kernel.size, N))
    for name, value in (("lower", arm.lower), ("upper", arm.upper)):
        s[kernel.slice(name)] = value[:, None]
    for name, value in (("tol", 1e-9), ("permitted", 60.0), ("live", 1.0)):
        s[kernel.slice(name)] = value
    s[kernel.slice("given")] = model.pose(q).reshape(N, 16).T
    s[kernel.slice("seed")] = rng.uniform(arm.lower, arm.upper, (N, arm.n)).T
    carried = ("round6", "round6", "first", "again", "tip", "judge6_carried")
    full = (*carried[:-1], "judge6_full")
    for name in (
        "accept6",
        "begin",
        "open",
        "first",
        "tip",
        "judge6_kept",
        *carried,
        "open",
        *full,
        *full,
    ):
        made = s.copy()
        in_lanes(kernel, name, made)
        for part, values in own[name]({k: s[kernel.slice(k)].copy() for k in kernel.place}).items():
            for row, value in zip(s[kernel.slice(part)], values, strict=False):
                row[:] = value
        np.testing.assert_allclose(made, s, rtol=1e-10, atol=1e-12, err_msg=name)


def test_context_is_an_input_not_a_constant(arm):
    q, context = situation(arm)
    model = everything(arm)
    kernel = kernel_of(model, context.layout)
    other = dataclasses.replace(
        context,
        approach=tuple(-a for a in context.approach),
        columns={**context.columns, "payload_kg": context.columns["payload_kg"] + 0.3},
    )
    assert kernel_of(model, other.layout) is kernel
    assert kernel_of(model, Context().take(slice(None)).layout) is not kernel
    for some in (context, other):
        rows = kernel.layout.pack(some, N)
        made = evaluated(kernel, q, rows)
        np.testing.assert_allclose(made, by_the_model(model, q, some), rtol=0, atol=1e-12)


def biases(arm: Arm) -> list[Bias]:
    rng = np.random.default_rng(8)
    terms = [term for kind in BUILT_IN.values() for term in kind.for_arm(arm)]
    return [valued(term, rng) for term in terms if isinstance(term, Bias)]


def test_columns_in_machine_code_are_the_models_own(arm):
    """Of every effect's parameters, held by the model or absent, at many postures and at one."""
    q, context = situation(arm)
    every = everything(arm)
    slots = slots_of(arm, every.effects)
    here = [
        term.with_values({p.name: 1.5 for p in term.declared()}) if term.seen_only else term
        for k, term in enumerate(every.effects)  # the base is far off, some loads are absent
        if k % 3 or not term.changes_loads
    ]
    model = Model(arm, tuple(here), tuple(biases(arm)))
    assert len(here) < len(every.effects)
    kernel_of(model, context.layout).code  # noqa: B018 - is kept
    before = Compiled.programs
    for rows in (slice(None), 2):
        at, there = q[rows], context.take(rows)
        with compile_at_once():
            tip, columns = tip_and_columns(model, at, there, slots)
        assert Compiled.programs == before + 1
        posture = model.posture(unstack(at), there)
        own = model.columns(posture, slots)[1].reshape(-1, 3, len(slots))
        np.testing.assert_allclose(tip, model.tip(at, there), rtol=0, atol=1e-12)
        assert columns.shape == own.shape
        sizes = np.abs(own).max(axis=(0, 1))
        assert (np.abs(columns - own).max(axis=(0, 1)) <= 1e-7 * sizes + 1e-10).all()


def test_columns_are_compiled_only_where_that_pays(arm):
    """A model without machine code stays so; with it, many commands pay, or compiling at once."""
    q = np.random.default_rng(1).uniform(arm.lower, arm.upper, (4, arm.n))
    model = Model(arm, (LinkDeflection(), JointZero(1, 1e-3)))
    own = model.columns(model.posture(unstack(q)), model.slots)[1]
    with compile_at_once():
        np.testing.assert_array_equal(tip_and_columns(model, q, Context(), model.slots)[1], own)
    kernel_of(model, Context().layout).code  # noqa: B018 - is kept
    before, calls = Compiled.programs, 0
    while Compiled.programs == before and calls < 1000:
        made = tip_and_columns(model, q, Context(), model.slots)[1]
        np.testing.assert_allclose(made, own, rtol=1e-9, atol=1e-12)
        calls += 1
    assert 50 < calls < 1000


def test_a_kernel_is_kept_by_content(arm):
    layout = Context().layout
    one, same = Model(arm, (LinkDeflection(),)), Model(arm, (LinkDeflection(),))
    assert kernel_of(one, layout) is kernel_of(same, layout)
    assert kernel_of(one.plus(JointZero(1)), layout) is not kernel_of(one, layout)
    finer = dataclasses.replace(one, elements_per_beam=one.elements_per_beam + 1)
    assert kernel_of(finer, layout) is not kernel_of(one, layout)


def test_few_kernels_are_kept_and_a_compiled_one_holds_no_graphs(arm):
    """A node that learns serves a new model every few minutes: memory must not grow with them."""
    q, context = situation(arm)
    layout = context.layout
    model = everything(arm)
    kernel = kernel_of(model, layout)
    old = weakref.ref(kernel)
    assert kernel.code is not None
    gc.collect()
    assert not any(isinstance(thing, Graph) for thing in gc.get_objects())
    rows = layout.pack(context, N)
    found = evaluated(kernel, q, rows)
    np.testing.assert_allclose(found, by_the_model(model, q, context), rtol=0, atol=1e-12)
    del kernel
    for k in range(MOST_KERNELS):
        kernel_of(model.plus(JointZero(1, 1e-4 * k)), layout)
    del model
    gc.collect()
    assert old() is None


def test_every_operation_in_machine_code():
    """A function of all traced operations, against the same lines on floats and arrays."""

    def work(a, b):
        s = spatial
        smooth = s.sin(a) * s.cos(b) + s.tanh(a - b) / (1.5 + s.absolute(b)) - s.sqrt(b * b + 2.0)
        steps = s.floor(3.0 * a) + s.sign(b) + s.minimum(a, b) * s.maximum(a, 0.25)
        return smooth + steps + s.where(a > b, a, -b) + s.where(a <= 0.1, 2.0, b) + s.atan2(a, b)

    graph = Graph()
    a, b = graph.input("0"), graph.input("1")
    outputs = {2: work(a, b), 3: a - a, 4: 0.0 * b + 1.0}
    s = np.zeros((5, 50))
    s[:2] = np.random.default_rng(2).normal(size=(2, 50))
    s[2], s[4] = work(*s[:2]), 1.0
    for column in s.T.tolist():
        assert column[2] == pytest.approx(work(*column[:2]), abs=1e-13)
    for width in (1, 2, 4, 8):
        text = write_module({"f": (graph, outputs)}, {}, {"s": range(5)}, width)
        blocks = np.zeros((-(-50 // width), 5, width))
        for k in range(50):
            blocks[k // width, :2, k % width] = s[:2, k]
        compile_module(text, width).function("many_f")(blocks.ctypes.data, len(blocks))
        for k in range(50):
            assert blocks[k // width, :, k % width] == pytest.approx(s[:, k], abs=1e-13)


def test_angles_in_arithmetic():
    """Sine, cosine and arc tangent to two units in the last place, quadrants and axes included."""
    rng = np.random.default_rng(1)
    for size in (1e-9, 1e-3, 1.0, 100.0, 1e4):
        x, y = rng.normal(size=(2, 2000)) * size
        assert np.abs(angles.sine(x) - np.sin(x)).max() <= 2.5e-16
        assert np.abs(angles.cosine(x) - np.cos(x)).max() <= 2.5e-16
        assert np.abs(angles.arc_tangent2(y, x) - np.arctan2(y, x)).max() <= 9e-16
    y, x = np.array([(0, 0), (0, 1), (0, -1), (1, 0), (-1, 0), (-1, -1), (1e-300, -1)], float).T
    np.testing.assert_allclose(angles.arc_tangent2(y, x), np.arctan2(y, x), rtol=0, atol=1e-15)


def test_constants_fold_and_common_work_is_shared():
    graph = Graph()
    a = graph.input("0")
    assert 0.0 * a == 0.0
    assert (a + 0.0) is a
    assert 1.0 * a is a
    assert (a - a) == 0.0
    negative = -a
    assert -negative is a
    assert (a * 2.0 + 3.0) is (3.0 + 2.0 * a)
    assert len(graph.needed_nodes([a * 2.0])) == 2
    assert isinstance(np.float64(2.0) * a, Symbol)


def test_a_number_is_not_taken_for_a_node():
    """Node 1 and the constant 1.0 are equal and hash alike, but are not the same operand."""
    graph = Graph()
    a, b = graph.input("0"), graph.input("1")
    assert (a < b) is not (a < 1.0)
    assert graph.nodes[(a - b).node] == ("sub", (a.node, b.node))
    assert type(graph.nodes[(a - 1.0).node][1][1]) is float


def test_a_branch_on_a_traced_number_is_refused():
    a = Graph().input("0")
    with pytest.raises(TypeError, match="where"):
        bool(a > 0)
    with pytest.raises(TypeError):
        math.sin(a)
    with pytest.raises(TypeError, match="hypot"):
        np.hypot(a, 1.0)
