"""Every field of the circumstances filled, and models with every form of every effect."""

import dataclasses
from collections.abc import Iterator

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import PER_JOINT, WIDTH, Context
from longarm_comp.core.calibration.candidates import Candidate
from longarm_comp.core.effects.catalogue import BUILT_IN
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.effects.joint_term import JointTerm
from longarm_comp.core.ik.solver import Engine
from longarm_comp.core.model.model import Model

N = 6
ENGINES = list(Engine)
KINDS = [kind for kind in BUILT_IN.values() if issubclass(kind, Effect)]


def circumstances(arm: Arm) -> tuple[np.ndarray, Context]:
    """N postures with every field of the record filled."""
    rng = np.random.default_rng(4)
    q = arm.lower + (arm.upper - arm.lower) * (0.2 + 0.6 * rng.random((N, arm.n)))
    columns = {
        "temperature_c": rng.uniform(15, 40, N),
        "payload_kg": rng.uniform(0, 0.5, N),
        "t_s": np.linspace(10, 7200, N),
        "probe": rng.uniform(-1, 1, N),
    }
    for frame in range(len(arm.joints) + 1):
        columns |= {f"incl_{frame}_{axis}": rng.normal(0, 0.01, N) for axis in "xy"}
    history = {
        name: tuple(0.3 * rng.choice([-1.0, 1.0], N) for _ in range(arm.n * WIDTH[name]))
        for name in PER_JOINT
    }
    return q, Context(**history, columns=columns, labels={"group": "a", "marker": "m"})


def forms(arm: Arm) -> Iterator[tuple[Effect, ...]]:
    """Every form of every effect: at all its places."""
    for kind in KINDS:
        by_form: dict[object, dict[object, Effect]] = {}
        placed = issubclass(kind, JointTerm) or (kind.searched and not kind.geometry)
        if placed and not kind.candidates(arm):
            continue  # another arm has a place for it
        for group in kind.candidates(arm) or [kind.for_arm(arm) or (somewhere(kind),)]:
            at = by_form.setdefault(Candidate(kind.name, group).form, {})
            at.update({term.where: term for term in group})
        yield from (tuple(at.values()) for at in by_form.values())


def somewhere(kind: type[Effect]) -> Effect:
    """An effect that this arm has nowhere, at row 2."""
    return kind(**{f.name: 2 for f in dataclasses.fields(kind) if f.default is dataclasses.MISSING})


def valued(term: Effect, rng: np.random.Generator) -> Effect:
    """With parameters of a size that a fit would find."""
    sizes = {p.name: 0.3 * p.prior * (0.5 + rng.random()) for p in term.declared() if p.prior > 0}
    return term.with_values(sizes)


def models(arm: Arm) -> list[Model]:
    """Models that between them hold every form of every effect that a command can undo."""
    rng = np.random.default_rng(3)
    made: list[list[tuple[Effect, ...]]] = []
    for terms in forms(arm):
        if not terms[0].continuous:
            continue
        free = next((m for m in made if all(t[0].name != terms[0].name for t in m)), None)
        if free is None:
            made.append(free := [])
        free.append(tuple(valued(t, rng) for t in terms))
    return [Model(arm, tuple(t for terms in m for t in terms)) for m in made]
