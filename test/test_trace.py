"""Traced programs give the numbers of the model they were traced from."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from longarm_comp.core import emit, spatial
from longarm_comp.core.arm import Arm
from longarm_comp.core.context import Context
from longarm_comp.core.effects.catalogue import BY_NAME
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.effects.joint_zero import JointZero
from longarm_comp.core.effects.link_deflection import LinkDeflection
from longarm_comp.core.ik_engines import TracedArrays, _ModelMachine
from longarm_comp.core.kernel import Kernel, Layout, kernel_of
from longarm_comp.core.model import Model
from longarm_comp.core.newton import full
from longarm_comp.core.trace import Symbol, Tape

N = 12


@pytest.fixture(scope="module")
def arm(demo_arm_path) -> Arm:
    return Arm.load(demo_arm_path)


def situation(arm: Arm) -> tuple[np.ndarray, Context]:
    rng = np.random.default_rng(11)
    q = arm.lower + (arm.upper - arm.lower) * rng.random((N, arm.n))
    columns = {
        "temperature_c": rng.uniform(15, 40, N),
        "payload_kg": rng.uniform(0, 0.5, N),
        "t_s": np.linspace(0, 7200, N),
    }
    for frame in range(len(arm.joints) + 1):
        for axis in "xy":
            columns[f"incl_{frame}_{axis}"] = rng.normal(0, 0.01, N)
    return q, Context(tuple(rng.choice([-1.0, 1.0], N) for _ in range(arm.n)), columns)


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
    terms = BY_NAME[name].for_arm(arm)
    return tuple(valued(t, rng) for t in terms if isinstance(t, Effect))


def everything(arm: Arm) -> Model:
    """All arm-side effects at once."""
    return Model(arm, tuple(e for name in sorted(BY_NAME) for e in effects(arm, name)))


def by_every_program(model: Model, q: np.ndarray, context: Context) -> dict[str, np.ndarray]:
    """Tip, axes and Jacobian (12 + 6 n, N) by the model and by each program."""
    layout = Layout.of(context)
    kernel = Kernel(model, layout)
    rows, ids = layout.pack(context, len(q)), np.arange(len(q))
    made = {
        "model": _ModelMachine(model, context).full(np.ascontiguousarray(q.T), ids)[0],
        "arrays": TracedArrays(kernel, np.ascontiguousarray(rows.T)).full(
            np.ascontiguousarray(q.T), ids
        )[0],
    }
    size = 12 + 6 * model.arm.n
    floats = []
    for k in range(len(q)):
        out = [0.0] * size
        full(kernel.floats, q[k].tolist(), rows[k].tolist(), [0.0] * kernel.nx, out)
        floats.append(out)
    made["floats"] = np.array(floats).T
    return made


@pytest.mark.parametrize("name", sorted(BY_NAME))
def test_each_effect_traced_is_the_effect(arm, name):
    q, context = situation(arm)
    own = effects(arm, name)
    if not own:
        assert not any(isinstance(t, Effect) for t in BY_NAME[name].for_arm(arm))
        return
    load = (LinkDeflection(),) if name != "link_deflection" else ()
    made = by_every_program(Model(arm, own + load), q, context)
    for program in ("arrays", "floats"):
        np.testing.assert_allclose(made[program], made["model"], rtol=0, atol=1e-12)


def test_machine_code_gives_the_same_numbers(arm):
    """All effects at once, through LLVM, called by address."""
    pytest.importorskip("llvmlite")
    import ctypes

    q, context = situation(arm)
    model = everything(arm)
    layout = Layout.of(context)
    kernel = Kernel(model, layout)
    rows = layout.pack(context, N)
    kind = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 5)
    first, step, last = (kind(address) for address in kernel.machine[:3])

    def machine(function):
        return lambda *buffers: function(*(b.ctypes.data for b in buffers))

    calls = (machine(first), machine(step), machine(last), None, None, kernel.passes)
    made = by_every_program(model, q, context)
    np.testing.assert_allclose(made["floats"], made["model"], rtol=0, atol=1e-12)
    for k in range(N):
        out, x = np.zeros(12 + 6 * arm.n), np.zeros(kernel.nx)
        full(calls, q[k].copy(), rows[k].copy(), x, out)
        np.testing.assert_allclose(out, made["model"][:, k], rtol=0, atol=1e-12)


def test_context_is_an_input_not_a_constant(arm):
    q, context = situation(arm)
    model = everything(arm)
    kernel = kernel_of(model, Layout.of(context))
    other = dataclasses.replace(
        context,
        approach=tuple(-a for a in context.approach),
        columns={**context.columns, "payload_kg": context.columns["payload_kg"] + 0.3},
    )
    assert kernel_of(model, Layout.of(other)) is kernel
    assert kernel_of(model, Layout.of(Context.empty().take(slice(None)))) is not kernel
    ids, columns = np.arange(N), np.ascontiguousarray(q.T)
    for some in (context, other):
        rows = np.ascontiguousarray(kernel.layout.pack(some, N).T)
        np.testing.assert_allclose(
            TracedArrays(kernel, rows).full(columns, ids)[0],
            _ModelMachine(model, some).full(columns, ids)[0],
            rtol=0,
            atol=1e-12,
        )


def test_a_kernel_is_kept_by_content(arm):
    layout = Layout.of(Context.empty())
    one, same = Model(arm, (LinkDeflection(),)), Model(arm, (LinkDeflection(),))
    assert kernel_of(one, layout) is kernel_of(same, layout)
    assert kernel_of(one.plus(JointZero(1)), layout) is not kernel_of(one, layout)
    finer = dataclasses.replace(one, elements_per_beam=one.elements_per_beam + 1)
    assert kernel_of(finer, layout) is not kernel_of(one, layout)


def test_every_operation_in_every_language():
    """A function of all traced operations, against the same lines on plain floats."""

    def work(a, b):
        s = spatial
        smooth = s.sin(a) * s.cos(b) + s.tanh(a - b) / (1.5 + s.absolute(b)) - s.sqrt(b * b + 2.0)
        steps = s.floor(3.0 * a) + s.sign(b) + s.minimum(a, b) * s.maximum(a, 0.25)
        return smooth + steps + s.where(a > b, a, -b) + s.where(a <= 0.1, 2.0, b) + s.atan2(a, b)

    tape = Tape()
    a, b = tape.input("q[0]"), tape.input("q[1]")
    outputs = {"out[0]": work(a, b), "out[1]": a - a, "out[2]": 0.0 * b + 1.0}
    text = emit.python("f", tape, outputs)
    on_floats, on_arrays = dict(emit.FLOATS), dict(emit.ARRAYS)
    exec(text, on_floats)
    exec(text, on_arrays)
    points = np.random.default_rng(2).normal(size=(2, 50))
    out = np.zeros((3, 50))
    on_arrays["f"](points, None, None, out, None)
    for k, (x, y) in enumerate(points.T.tolist()):
        made = [0.0] * 3
        on_floats["f"]([x, y], None, None, made, None)
        assert made == pytest.approx([work(x, y), 0.0, 1.0], abs=1e-14)
        assert out[:, k] == pytest.approx(made, abs=1e-13)
    llvmlite = pytest.importorskip("llvmlite")
    assert llvmlite
    import ctypes

    from longarm_comp.core.machine_code import compile_module

    code = compile_module(emit.llvm({"f": (tape, outputs)}))
    call = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 5)(code.address("f"))
    for x, y in points.T:
        given, made = np.array([x, y]), np.zeros(3)
        call(given.ctypes.data, None, None, made.ctypes.data, None)
        assert made == pytest.approx([work(float(x), float(y)), 0.0, 1.0], abs=1e-13)


def test_constants_fold_and_common_work_is_shared():
    tape = Tape()
    a = tape.input("q[0]")
    assert 0.0 * a == 0.0
    assert (a + 0.0) is a
    assert 1.0 * a is a
    assert (a - a) == 0.0
    negative = -a
    assert -negative is a
    assert (a * 2.0 + 3.0) is (3.0 + 2.0 * a)
    assert len(tape.needed([a * 2.0])) == 2
    assert isinstance(np.float64(2.0) * a, Symbol)


def test_a_branch_on_a_traced_number_is_refused():
    a = Tape().input("q[0]")
    with pytest.raises(TypeError, match="where"):
        bool(a > 0)
    with pytest.raises(TypeError):
        math.sin(a)
    with pytest.raises(TypeError, match="hypot"):
        np.hypot(a, 1.0)
