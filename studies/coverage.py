"""Counts how often a measured row lies inside the 90 % radius that its model states.

The radius is of a measured row: error of the tip and noise of the measurement; of simulated arms
also that of the tip alone, which a command states.  Rows are left out three ways: the splits of the
public data (off the grid, or at random), places (an eighth of the joint space, refitted without it;
of arms that touched points, where a tool stood), and fresh random poses of simulated arms.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import click
import numpy as np

from longarm_comp.cli import options
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.calibration.calibrate import fit_stages
from longarm_comp.core.calibration.fit import fit_model
from longarm_comp.core.calibration.left_out import subtract_point_means
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.calibration.uncertainty import measure_uncertainty
from longarm_comp.core.compensation.unshown import structure_left
from longarm_comp.core.data.commanded import commanded_errors
from longarm_comp.core.data.measurement import compute_posture, compute_tip_errors, make_equations
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.catalogue import effect_class
from longarm_comp.core.effects.compliances import BearingTilt, JointCompliance
from longarm_comp.core.effects.effect import Bias, Effect
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import slots_of
from longarm_comp.core.model.uncertainty import LEVEL, ModelUncertainty, sizes
from longarm_comp.sessions.read import read_session
from studies.commands import Figures, Show, arm_option, study_command, whole_number
from studies.interval import wilson
from studies.loop_cases import Case
from studies.loop_setting import set_up
from studies.real_sessions import every_robot
from studies.touch import EXAMPLE

HALVED = 3
"""Joints whose range is halved: eight places, left out one at a time."""
ROWS = 300
KEPT = (0.87, 0.93)
APART = 2.0
"""Standard deviations that rows lie off as a whole by, from which it is said."""
FEWEST_PLACES = 9
"""Places of which a 90 % radius at another can be told: nine of ten, with it (conformal)."""
SIMULATED = ("joint_compliance", "backlash", "joint_gain", "link_stiffness")
"""Effects of the simulated arms in turn: half of the arms know them, half do not."""

Progress = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class LeftOutRows:
    """Rows left out of a fit, against what it states of them.

    Attributes:
        set: robot, and how the rows were left out.
        error: (N,) m, measured - predicted.
        expected, radius: (N,) m, of a measured row.
        apart: how far the rows lie off as a whole, in standard deviations of what is stated.
        inside_data: share of the rows whose expected error is one that fitted rows have.
        places: where the fitted rows stood, if they stood at few places.
    """

    set: str
    error: np.ndarray
    expected: np.ndarray
    radius: np.ndarray
    apart: float = 0.0
    inside_data: float = 1.0
    places: int = FEWEST_PLACES


def judge(
    name: str,
    fitted: ModelFit,
    rows: Session,
    clean: np.ndarray | None = None,
    commanded: bool = False,
) -> LeftOutRows:
    """Hold rows with a position against a fit that has not seen them.

    Args:
        clean: (N, 3) m, the rows' points without noise: then the tip alone is judged.
        commanded: whether errors are those that a command would leave.
    """
    known, seen = measure_uncertainty(fitted), rows.take(rows.has_position)
    model = fitted.model
    off = (commanded_errors if commanded else compute_tip_errors)(model, seen)
    if clean is not None:
        known = replace(known, noise=np.zeros((3, 3)))
        off = off + clean[rows.has_position] - seen.xyz
    slots = (*model.slots, *slots_of(model.arm, known.absent))
    columns = make_equations(model, seen, slots).columns[:, :3]
    carried = known.carry_to_tip(columns, [slot.identity for slot in slots])
    structure = structure_left(model, known, seen.q, seen.context())
    return _judge(name, off, carried, known, structure)


def judge_touches(name: str, fitted: ModelFit, rows: Session) -> LeftOutRows:
    """Hold touches against a fit that has not seen their places: tips against their mean."""
    known, touched = measure_uncertainty(fitted), rows.labels["touch"]
    model = fitted.model
    slots = model.uncertain_slots(known)
    names = [slot.identity for slot in slots]
    tip, columns = model.columns(compute_posture(model, rows), slots)
    off, alone = subtract_point_means(tip, touched)
    moved, _ = subtract_point_means(columns, touched)
    structure = structure_left(model, known, rows.q, rows.context())[~alone]
    return _judge(name, off[~alone], known.carry_to_tip(moved[~alone], names), known, structure)


def _judge(
    name: str,
    off: np.ndarray,
    carried: np.ndarray,
    known: ModelUncertainty,
    structure: np.ndarray,
) -> LeftOutRows:
    alone = structure + known.noise
    expected, radius = sizes(carried + alone)
    own = sizes(carried + structure)[0]
    whole = carried.mean(axis=0) + alone.mean(axis=0) / len(off)
    mean = off.mean(axis=0)
    apart = math.sqrt(float(mean @ np.linalg.pinv(whole) @ mean) / 3.0)
    inside = float((own <= known.largest_m).mean())
    return LeftOutRows(name, np.linalg.norm(off, axis=1), expected, radius, apart, inside)


def judge_real(folder: Path, say: Progress = lambda _: None) -> Iterator[LeftOutRows]:
    """Yield the public data sets: their own splits, and places.

    Args:
        folder: holds ``dlr_justin``, ``wam_ur5`` or both.
        say: called with each set.

    Raises:
        InputError: it holds no data set.
    """
    for robot, parts in every_robot(folder).items():
        for part in parts:
            bends = (*JointCompliance.for_arm(part.arm), *BearingTilt.for_arm(part.arm))
            more = bends if robot == "dlr_justin" else ()
            say(f"{robot}: its own split")
            fitted = _fit_terms(part.arm, part.train, *more)
            yield judge(f"{robot}, its own split", fitted, part.held_out)
            for kept, out in _places(part.train):
                say(f"{robot}: places")
                yield judge(f"{robot}, places", _fit_terms(part.arm, kept, *more), out)


def judge_pandas(say: Progress = lambda _: None) -> Iterator[LeftOutRows]:
    """Yield six real arms that touched sockets, each place of the tool left out in turn."""
    arm = Arm.load(EXAMPLE / "arm.yaml")
    for path in sorted(EXAMPLE.glob("panda_*.csv")):
        session = read_session(path, arm)
        place = session.labels["location"]
        for each in np.unique(place):
            say(f"{path.stem}: {each}")
            fitted = _fit_terms(arm, session.take(place != each))
            judged = judge_touches(path.stem, fitted, session.take(place == each))
            yield replace(judged, places=len(np.unique(place)) - 1)


def judge_simulated(
    declared: Arm, count: int, say: Progress = lambda _: None
) -> Iterator[LeftOutRows]:
    """Yield random arms with a hidden effect that every other model knows; fresh random poses."""
    for k in range(count):
        name = SIMULATED[k % len(SIMULATED)]
        say(f"arm {k + 1}: {name}")
        setting = set_up(
            Case("single", (name,), False, "usual", "sobol", ROWS, 1.0, k, 0), declared
        )
        told = (k // len(SIMULATED) + k) % 2 == 0
        kind = effect_class(name, "study coverage")
        more = kind.for_arm(setting.arm) if told else ()
        fitted = _fit_terms(setting.arm, setting.train, *more)
        how = "the effect known" if told else "the effect not known"
        yield judge(f"simulated, {how}", fitted, setting.held_out)
        yield judge(f"the tip alone, {how}", fitted, setting.held_out, setting.clean_held_out)


def table(found: Sequence[LeftOutRows]) -> list[dict[str, object]]:
    """Return one row a set; ``kept``: whether the radius holds, or why that is not known."""
    rows: list[dict[str, object]] = []
    for name in dict.fromkeys(each.set for each in found):
        mine = [each for each in found if each.set == name]
        error, expected, radius = (
            np.concatenate([getattr(each, k) for each in mine])
            for k in ("error", "expected", "radius")
        )
        inside = [int((each.error <= each.radius).sum()) for each in mine]
        share, between = _interval(inside, [len(each.error) for each in mine])
        rows.append(
            {
                "set": name,
                "rows": len(error),
                "inside_90": share,
                "ci95": list(between),
                "kept": _verdict(share, between, mine),
                "mean_mm": 1e3 * float(error.mean()),
                "expected_mm": 1e3 * float(expected.mean()),
                "p90_mm": 1e3 * float(radius.mean()),
            }
        )
    return rows


def _interval(inside: Sequence[int], of: Sequence[int]) -> tuple[float, tuple[float, float]]:
    """Compute the share of all rows, and its 95 % interval, rows of one place being alike.

    Places that differ more than independent rows would count as fewer rows (design effect).
    """
    k, n = np.array(inside), np.array(of)
    total, share = int(n.sum()), float(k.sum() / n.sum())
    spread = max(share * (1.0 - share), 1.0 / total)
    between = float(((k - n * share) ** 2).sum()) / (total * spread) * len(n) / max(len(n) - 1, 1)
    return share, wilson(share, total / max(between, 1.0))


def _verdict(share: float, between: tuple[float, float], mine: Sequence[LeftOutRows]) -> str:
    low, high = KEPT
    if low <= round(share, 2) <= high:
        return "yes"
    why = "too few rows to tell" if between[0] <= LEVEL <= between[1] else "no"
    if len(mine) == 1 and mine[0].apart > APART:
        why += f"; they lie off as a whole ({mine[0].apart:.1f} sigma): another day or set-up"
    fewest = min(each.places for each in mine)
    if fewest < FEWEST_PLACES:
        why += f"; fitted at {fewest} places, 90 % takes {FEWEST_PLACES}"
    far = 1.0 - float(np.mean([each.inside_data for each in mine]))
    return why + (f"; {far:.0%} are far from the fitted rows" if far > 0.1 else "")


def _fit_terms(arm: Arm, rows: Session, *more: Effect | Bias) -> ModelFit:
    """Fit geometry, then further terms on top of it."""
    *_, (_, geometry) = fit_stages(declared_model(arm), rows)
    return fit_model(geometry.model.plus(*more), rows) if more else geometry


def _places(rows: Session) -> Iterator[tuple[Session, Session]]:
    """Yield rows without and with each place: halves of the joints that moved farthest, crossed."""
    place = np.zeros(len(rows), dtype=int)
    for j in np.argsort(-np.ptp(rows.q, axis=0))[:HALVED]:
        place = 2 * place + (rows.q[:, j] > np.median(rows.q[:, j]))
    for each in np.unique(place):
        yield rows.take(place != each), rows.take(place == each)


@study_command(
    options.path_option(
        "--data", "Folder with dlr_justin, wam_ur5 or both; none are judged if absent."
    ),
    arm_option,
    whole_number("--arms", 6, "Simulated arms.", least=0),
    click.option(
        "--pandas/--no-pandas", "touched", default=True, help="Six real arms that touched sockets."
    ),
)
def command(data: Path | None, arm: Arm, arms: int, touched: bool, show: Show) -> Figures:
    """Count the rows left out that lie inside the 90 % radius that their model states.

    The radius is of a measured row: error of the tip and noise. "kept" says whether it holds, or
    why that cannot be told.

    \b
    Example:
      longarm study coverage --data test/data --arms 6 --json
    """
    found = [] if data is None else list(judge_real(data, lambda text: show(text, 0.0)))
    if touched:
        found += judge_pandas(lambda text: show(text, 0.3))
    found += judge_simulated(arm, arms, lambda text: show(text, 0.5))
    rows = table(found)
    return Figures({"rows": rows}, {"Rows left out inside the stated 90 % radius": rows})
