"""One target as a move: finds the joints together with the sides from which they arrive."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from longarm_comp.core.arm.context import Context, stack_contexts
from longarm_comp.core.arm.history import History
from longarm_comp.core.arm.moves import Move, plan_move, wanted_sides
from longarm_comp.core.compensation.compensate import SolvedTargets, lattice_of, physics_of
from longarm_comp.core.compensation.result import (
    Compensation,
    CompensationOptions,
    ResidualPredictor,
)
from longarm_comp.core.compensation.unknown import sided_joints
from longarm_comp.core.ik import solver as ik
from longarm_comp.core.model.model import Model


@dataclass(frozen=True, eq=False)
class Arrival:
    """A compensated target, its move, the circumstances assumed, and the history after the move."""

    outcome: Compensation
    move: Move
    context: Context
    history: History


def compensate_move(
    model: Model,
    predictor: ResidualPredictor | None,
    target: np.ndarray,
    *,
    start: np.ndarray | None,
    history: History,
    context_after: Callable[[History], Context],
    sides: np.ndarray | None = None,
    seed: np.ndarray | None = None,
    position_only: bool = False,
    options: CompensationOptions | None = None,
) -> Arrival:
    """Compensate one target as a move from where the arm is.

    A command is solved for an assumed history of the joints. Its move leaves a history too, and the
    two must agree.  If they do not for a joint (which hardly moves and has no run-up), its side
    counts as unknown.  In the choice among the servos' steps, each command is judged with the
    history that its own move leaves.

    Args:
        target: (3,) m or (4, 4), base frame.
        start: (n,) joints now (rad, m); None: not known.
        history: of the joints at ``start``.
        context_after: returns the circumstances at the command for the history after the move.
        sides: (n,) required sides of arrival, -1 or +1; by default they are chosen.
        seed: (n,) start of the search; ``start`` by default.
    """
    options, arm = options or CompensationOptions(), model.arm
    physics = physics_of(model, options.method)
    seed, to = start if seed is None else seed, np.asarray(target, dtype=float)[None]
    joints = sided_joints(physics)
    length = np.array(model.row_legs or np.zeros(arm.n))

    def move_to(q: np.ndarray) -> Move:
        return plan_move(arm, start, q, wanted, length=length, leg=history.legs[:, 0])

    def context_at(q: np.ndarray) -> Context:
        """Return the circumstances at joints (M, n), each after its own move."""
        return stack_contexts([context_after(history.after(move_to(x).points, start)) for x in q])

    def solve(options: CompensationOptions) -> SolvedTargets:
        at = context_at if joints else None
        return SolvedTargets(model, predictor, to, context, seed, position_only, options, at)

    wanted = np.zeros(arm.n) if sides is None else sides
    move = Move(np.zeros(0), None, wanted, np.zeros(arm.n, bool))
    arrived = history
    fault = ik.target_faults(to, position_only, "compensate")[0]
    if not fault and (predictor is not None or joints or sides is not None):
        here = context_after(history)
        first = ik.solve(
            physics,
            target,
            seed=seed,
            context=here,
            position_only=position_only,
            locked=options.locked,
            max_starts=options.starts,
        )
        if sides is None and options.run_up:
            wanted = _choose_sides(physics, start, first.q, joints, here, length)
        move = move_to(first.q)
        arrived = history.after(move.points, start)
    # Tries commands until one leaves the history it assumes; the last assumes only what is common
    for trials_left in reversed(range(5)):
        assumed, context, doubtful = arrived, context_after(arrived), move.doubtful
        found = solve(replace(options, realisable=False))
        seed, move = found.q[0], move_to(found.q[0])
        arrived = history.after(move.points, start)
        if not found.status[0].success or not joints or arrived.agrees(assumed):
            break
        if trials_left == 1:
            arrived = arrived.common_with(assumed)
    if found.status[0].success and lattice_of(model, options.realisable) is not None:
        doubtful, found = move.doubtful, solve(options)
        move = move_to(found.q[0])
        arrived = history.after(move.points, start)
        context = context_after(arrived)
    return Arrival(found.judge_each(doubtful)[0], move, context, arrived)


def _choose_sides(
    model: Model,
    start: np.ndarray | None,
    q: np.ndarray,
    joints: list[int],
    context: Context,
    length: np.ndarray,
) -> np.ndarray:
    """Choose sides (n,) of -1 or +1 for the joints whose side matters; 0 for the others."""
    wanted, sure = np.zeros((2, model.arm.n))
    if joints:
        posture = model.posture_without_sag(tuple(q), context)
        for effect in model.effects:
            for joint, side in effect.sure_sides(posture).items():
                sure[joint] = side
        known = np.array(model.arrivals or np.ones((model.arm.n, 2)), float)
        wanted[joints] = wanted_sides(model.arm, start, q, known, sure, length)[joints]
    return wanted
