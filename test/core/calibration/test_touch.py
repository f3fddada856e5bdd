"""Calibration by touch: unknown points, known distances, planes; planted arms and real ones."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from numeric_columns import numeric_columns
from scipy.spatial.transform import Rotation
from session_bag import write_bag
from touching import (
    ARM,
    DISTANCES,
    GAP,
    SIGMA,
    SOCKETS,
    errors_of_the_drawing,
    miss,
    touching,
)

import longarm_comp as la
from longarm_comp.core.arm.parts import Tolerance
from longarm_comp.core.calibration.calibrate import geometry_terms
from longarm_comp.core.calibration.fit import fit_model
from longarm_comp.core.calibration.noise import noise_from_repeats
from longarm_comp.core.calibration.placement import place_sensors
from longarm_comp.core.calibration.undetermined import list_undetermined
from longarm_comp.core.data.admission import admit
from longarm_comp.core.data.kinds import KINDS
from longarm_comp.core.data.measurement import (
    compute_posture,
    compute_tip_errors,
    compute_touch_errors,
    make_equations,
)
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.touched_places import PlanePlace, TouchBeside
from longarm_comp.core.errors import InputError, JobError
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.model_file import load_model
from longarm_comp.sessions.csv import write_csv
from longarm_comp.sim.arm_truth import TrueArm
from studies.measurements import joints_at

HIDDEN = errors_of_the_drawing()


@pytest.fixture(scope="module")
def session() -> Session:
    return touching(HIDDEN, 120)


@pytest.fixture(scope="module")
def calibration(session: Session) -> la.Calibration:
    return la.calibrate(ARM, session)


def tabled(rows: int, normal: tuple[float, float, float], height: float) -> Session:
    """Touches of a plane, and of no point."""
    rng = np.random.default_rng(2)
    n = np.array(normal) / np.linalg.norm(normal)
    flat = rng.uniform((0.2, -0.15, 0.05), (0.7, 0.35, 0.55), (rows, 3))
    points = flat - np.outer(flat @ n - height, n)
    points += np.outer(SIGMA * rng.standard_normal(rows), n)
    q = joints_at(ARM, TrueArm(ARM, HIDDEN), points, rng)
    return Session.record(q, np.full((rows, 3), np.nan), labels={"plane": np.full(rows, "table")})


def joined(one: Session, other: Session, xyz: np.ndarray | None = None) -> Session:
    """Rows of both, each with what it measured."""
    count, further = len(one), len(other)
    labels = {
        name: np.concatenate([s.labels.get(name, np.full(len(s), "")) for s in (one, other)])
        for name in {*one.labels, *other.labels}
    }
    held = np.full((count + further, 3), np.nan)
    if xyz is not None:
        held[count:] = xyz
    return Session.record(
        np.concatenate([one.q, other.q]),
        held,
        labels=labels,
        touch_distances=one.touch_distances,
    )


# ------------------------------------------------------------------ equations


def test_columns_are_derivatives_of_touches_and_planes(session: Session) -> None:
    both = joined(session.take(slice(0, 30)), tabled(10, (0.3, -0.2, 1.0), 0.2))
    base = place_sensors(Model(ARM).plus(*geometry_terms(ARM, both)), both)
    base = base.with_values(base.values + 1e-3 * np.sin(np.arange(len(base.values))))
    at = compute_posture(base, both)
    found = make_equations(base, both, at=at)
    for k, slot, want in numeric_columns(base, both, lambda _: 1e-5):
        limit = 0.02 * max(float(np.abs(want).max()), 1e-3)
        np.testing.assert_allclose(found.columns[..., k], want, atol=limit, err_msg=slot.label)
    moved = np.einsum("nkj,j->nk", found.pull, (1e-4, 2e-4, -1e-4))
    plane = next(t for t in base.biases if isinstance(t, PlanePlace))
    normal = Rotation.from_rotvec([plane.rx, plane.ry, 0.0]).inv().apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(moved[30:, 3], normal @ (1e-4, 2e-4, -1e-4), atol=1e-9)
    np.testing.assert_allclose(moved[:30, :3], np.tile((1e-4, 2e-4, -1e-4), (30, 1)), atol=1e-9)


# ------------------------------------------------------------------ calibration


def test_touches_calibrate_an_arm(calibration: la.Calibration) -> None:
    assert miss(Model(ARM), HIDDEN) > 5e-3
    assert miss(calibration.model, HIDDEN) < 3 * SIGMA
    assert calibration.untold == ()
    found = calibration.held_out.rows[-1]
    assert found["spread_mm"] < 0.3 < 3.0 < calibration.held_out.rows[0]["spread_mm"]


def test_without_a_known_distance_the_size_is_not_told(session: Session) -> None:
    bare = dataclasses.replace(session, touch_distances=())
    calibrated = la.calibrate(ARM, bare)
    assert calibrated.untold == ("the size of the arm",)
    assert compute_touch_errors(calibrated.model, bare).mean() < 3 * SIGMA


def test_a_distance_that_is_hardly_known_does_not_tell_the_size(session: Session) -> None:
    rough = tuple((one, other, length, 0.01) for one, other, length, _ in DISTANCES)
    rows = dataclasses.replace(session, touch_distances=rough)
    found = fit_model(place_sensors(Model(ARM).plus(*geometry_terms(ARM, rows)), rows), rows)
    assert list_undetermined(found) == ("the size of the arm",)


def test_one_touch_beside_another_at_a_known_distance_tells_something(session: Session) -> None:
    first = session.labels["touch"] == "front_0"
    kept = first | (np.arange(120) == np.flatnonzero(session.labels["touch"] == "front_1")[0])
    rows = session.take(kept)
    assert rows.seen.all()
    assert not dataclasses.replace(rows, touch_distances=()).seen.all()
    assert len(compute_touch_errors(Model(ARM), rows)) == first.sum()


def test_one_socket_is_enough_to_calibrate() -> None:
    """The tip never travels, the arm does: its rows are not taken for another arm's."""
    rows = touching(HIDDEN, 40, sockets={"only": SOCKETS["front_0"]}, distances=())
    assert len(la.calibrate(ARM, rows).fit.outliers) == 0


def test_a_known_distance_sets_the_size(session: Session) -> None:
    """Distances declared 1 % too long make an arm that is 1 % too long, where they are exact."""
    longer = tuple((a, b, 1.01 * d, 1e-6) for a, b, d, _ in DISTANCES)
    rough = {"tolerance": Tolerance(a_m=0.1, d_m=0.1)}
    joints = tuple(joint.model_copy(update=rough) for joint in ARM.joints)
    wide = ARM.model_copy(update={"joints": joints})

    def fitted(distances: tuple[tuple[str, str, float, float], ...]) -> Model:
        rows = dataclasses.replace(session, touch_distances=distances)
        return fit_model(
            place_sensors(Model(wide).plus(*geometry_terms(wide, rows)), rows), rows
        ).model

    q = np.random.default_rng(0).uniform(ARM.lower, ARM.upper, (200, ARM.n))
    sizes = [np.linalg.norm(np.ptp(m.tip(q), axis=0)) for m in map(fitted, (DISTANCES, longer))]
    assert sizes[1] / sizes[0] == pytest.approx(1.01, abs=5e-4)


def test_a_distance_is_believed_to_its_tolerance(session: Session) -> None:
    """A gauge that is 1 mm off is found out by the others where it is said to be rough."""

    def fitted(tolerance: float) -> Model:
        known = (DISTANCES[0], (*DISTANCES[1][:2], GAP + 1e-3, tolerance), DISTANCES[2])
        rows = dataclasses.replace(session, touch_distances=known)
        return fit_model(
            place_sensors(Model(ARM).plus(*geometry_terms(ARM, rows)), rows), rows
        ).model

    rough, sure = fitted(1e-2), fitted(1e-5)
    stretch = {t.touch: t.stretch for t in rough.biases if isinstance(t, TouchBeside)}
    assert stretch[DISTANCES[1][1]] == pytest.approx(-1e-3, abs=1.5e-4)
    assert miss(rough, HIDDEN) < 0.5 * miss(sure, HIDDEN)


def test_a_chain_of_distances_holds_every_one() -> None:
    """Three sockets in a row, the middle one named last: each is placed by the one before it."""
    row = {name: np.array([0.5, 0.1, 0.1]) + k * np.array([0.0, GAP, 0.0])
           for k, name in enumerate(("b", "c", "a"))}  # fmt: skip
    known = (("b", "c", GAP, 1e-6), ("c", "a", GAP, 1e-6))
    rows = touching(HIDDEN, 45, sockets=row, distances=known)
    found = fit_model(place_sensors(Model(ARM).plus(*geometry_terms(ARM, rows)), rows), rows)
    tips = {n: found.model.tip(rows.q[rows.labels["touch"] == n]).mean(axis=0) for n in row}
    for one, other, length, _ in known:
        assert np.linalg.norm(tips[one] - tips[other]) == pytest.approx(length, abs=2e-4)
    assert np.abs(found.residual).max() < 6 * SIGMA


@pytest.mark.parametrize("way", [(-1.0, 0, 0), pytest.param((0, 0, 1.0), marks=pytest.mark.long)])
def test_no_direction_between_two_sockets_is_special(way: tuple[float, float, float]) -> None:
    pair = {f"s_{k}": np.array([0.45, 0.1, 0.3]) + k * GAP * np.array(way) for k in (0, 1)}
    rows = touching(HIDDEN, 40, sockets=pair, distances=(("s_0", "s_1", GAP, 1e-6),))
    found = fit_model(place_sensors(Model(ARM).plus(*geometry_terms(ARM, rows)), rows), rows)
    assert found.converged
    assert np.abs(found.residual).max() < 6 * SIGMA


def test_a_plane_helps_where_there_is_one_socket() -> None:
    few = touching(HIDDEN, 24, sockets={"only": SOCKETS["front_0"]}, distances=())
    table = tabled(60, (0.1, -0.2, 1.0), 0.15)
    models = []
    for rows in (few, joined(few, table)):
        base = place_sensors(Model(ARM).plus(*geometry_terms(ARM, rows)), rows)
        models.append(fit_model(base, rows).model)
    assert miss(models[1], HIDDEN) < 0.8 * miss(models[0], HIDDEN)
    plane = next(t for t in models[1].biases if isinstance(t, PlanePlace))
    assert np.abs(compute_tip_errors(models[1], table)).mean() < 3 * SIGMA
    assert abs(plane.rx) + abs(plane.ry) < 0.5


def test_touches_beside_positions_share_one_arm(session: Session) -> None:
    """Positions in a frame of their own place the base; the touched points are in that frame."""
    q = np.random.default_rng(5).uniform(ARM.lower, ARM.upper, (30, ARM.n))
    turn = Rotation.from_euler("z", 40, degrees=True).as_matrix()
    seen = TrueArm(ARM, HIDDEN).pose(q)[:, :3, 3] @ turn.T + [0.3, -1.0, 0.2]
    seen += SIGMA * np.random.default_rng(6).standard_normal(seen.shape)
    rest = Session.record(q, seen)
    both = joined(session.take(slice(0, 60)), rest, seen)
    calibrated = la.calibrate(ARM, both)
    assert miss(calibrated.model, HIDDEN) < 4 * SIGMA
    assert calibrated.model.tip(q[:5]) == pytest.approx(seen[:5], abs=1e-3)


# ------------------------------------------------------------------ what is not an error


def test_points_of_a_hold_out_are_solved_from_it(
    session: Session, calibration: la.Calibration, tmp_path: Path
) -> None:
    place = np.array([name.split("_")[0] for name in session.labels["touch"]])
    fitted = la.calibrate(ARM, session.take(place != "left")).model
    held = session.take(place == "left")
    assert np.linalg.norm(compute_tip_errors(fitted, held), axis=1).mean() < 4 * SIGMA
    table = la.evaluate(ARM, held, model=fitted)
    assert table["calibrated"].spread == pytest.approx(table["calibrated"].mean)
    calibration.save(tmp_path / "model.yaml")
    stored = load_model(tmp_path / "model.yaml", ARM)
    assert not any(term.passing for term in stored.terms)
    again = la.evaluate(ARM, session, model=tmp_path / "model.yaml")["calibrated"]
    assert again.spread == pytest.approx(compute_touch_errors(calibration.model, session).mean())


def test_a_point_of_the_same_name_on_another_day_is_another(
    calibration: la.Calibration,
) -> None:
    moved = {name: place + np.array([0.03, -0.02, 0.01]) for name, place in SOCKETS.items()}
    later = touching(HIDDEN, 24, sockets=moved, seed=8)
    assert la.evaluate(ARM, later, model=calibration.model)["calibrated"].mean < 4 * SIGMA


def test_gross_touches_are_left_out(session: Session) -> None:
    q = session.q.copy()
    q[[7, 30, 55], 1] += 0.02
    found = la.calibrate(ARM, dataclasses.replace(session, q=q))
    assert {7, 30, 55} <= set(found.fit.session.index[found.fit.outliers])
    assert miss(found.model, HIDDEN) < 3 * SIGMA


def test_equal_joints_are_no_repeat_of_a_touch(session: Session) -> None:
    """The joints are the reading: repeats that were touched anew tell the noise, copies do not."""
    copies = session.take(np.repeat(np.arange(20), 2))
    assert noise_from_repeats(Model(ARM), copies) is None
    again = session.take(np.repeat(np.arange(20), 2))
    rng = np.random.default_rng(3)
    shifts = SIGMA * rng.standard_normal((40, 3))
    q = again.q + np.stack(
        [
            np.linalg.lstsq(_jacobian(row), shift, rcond=None)[0]
            for row, shift in zip(again.q, shifts, strict=True)
        ]
    )
    repeats = dataclasses.replace(again, q=q, repeat_id=np.repeat(np.arange(20), 2))
    noise = noise_from_repeats(Model(ARM), repeats)
    assert noise is not None
    assert noise.sigma == pytest.approx(np.full(3, SIGMA), rel=0.4)


def _jacobian(q: np.ndarray) -> np.ndarray:
    model, steps = Model(ARM), 1e-6 * np.eye(ARM.n)
    return np.stack([(model.tip(q + s) - model.tip(q - s)) / 2e-6 for s in steps], axis=1)


# ------------------------------------------------------------------ files, refusals


@pytest.mark.parametrize("kind", ["csv", "bag"])
def test_files_hold_touches_and_distances(session: Session, tmp_path: Path, kind: str) -> None:
    whole = joined(session.take(slice(0, 12)), tabled(5, (0.0, 0.0, 1.0), 0.2))
    path = tmp_path / ("session.csv" if kind == "csv" else "bag")
    if kind == "csv":
        write_csv(whole, path)
    else:
        write_bag(whole, path, ARM)
    found = la.read_session(path, ARM)
    assert found.touch_distances == whole.touch_distances
    assert found.blocks == whole.blocks
    for name in ("touch", "plane"):
        np.testing.assert_array_equal(found.labels[name], whole.labels[name])
    np.testing.assert_allclose(found.q, whole.q, atol=1e-12)


def test_arm_yaml_may_hold_the_distances(session: Session) -> None:
    data = ARM.model_dump(mode="json", exclude_defaults=True)
    gauged = la.Arm.parse({**data, "touch_distances": [list(d[:3]) for d in DISTANCES]}, "gauged")
    bare = dataclasses.replace(session, touch_distances=())
    terms = [t for t in geometry_terms(gauged, bare) if isinstance(t, TouchBeside)]
    assert [(t.distance, t.tolerance) for t in terms] == [(GAP, 1e-4)] * 3
    with pytest.raises(InputError, match=r"touch_distances.0.*0\.0"):
        la.Arm.parse({**data, "touch_distances": [["a", "b", 0.0]]}, "gauged")


def test_what_touches_cannot_be(session: Session) -> None:
    loop = (*DISTANCES, (*DISTANCES[0][:2], 0.06, 1e-5))
    with pytest.raises(InputError, match="touch_distances: 'a loop at front_"):
        admit(dataclasses.replace(session, touch_distances=loop), ARM)
    once = dataclasses.replace(session.take(slice(0, 6)), touch_distances=())
    with pytest.raises(InputError, match="touch: 'each in too few rows'; allowed: 2 rows or more"):
        admit(once, ARM)
    unknown = dataclasses.replace(session, touch_distances=(("front_0", "frnt_1", 0.05, 1e-4),))
    said = [str(f) for f in admit(unknown, ARM).findings]
    assert "touch_distances: frnt_1 was not touched" in said
    labels = {**session.labels, "group": np.repeat(["a", "b"], 60)}
    with pytest.raises(InputError, match="group: 'several'"):
        admit(dataclasses.replace(session, labels=labels), ARM)


def test_rows_of_another_arm_are_refused(session: Session) -> None:
    mixed = session.q[np.random.default_rng(0).permutation(len(session))]
    refused = r"not of this arm|fails at held-out|do not determine|as the arm touched them"
    with pytest.raises((JobError, InputError), match=refused):
        la.calibrate(ARM, dataclasses.replace(session, q=mixed))


def test_a_base_that_touches_cannot_show_is_not_fitted(session: Session) -> None:
    found = fit_model(
        place_sensors(Model(ARM).plus(*geometry_terms(ARM, session)), session), session
    )
    assert not any(term.name == "base_pose" for term in found.model.terms)
    assert list_undetermined(found) == ()


def test_a_name_in_one_row_counts_for_nothing(session: Session) -> None:
    """Its point would be wherever the tip is: no error, no noise, no row that flatters a figure."""
    labels = {"touch": session.labels["touch"].copy()}
    labels["touch"][5] = "once"
    labels["plane"] = np.where(np.arange(120) < 3, "floor", "")
    rows = dataclasses.replace(session, labels=labels, blocks=())
    assert rows.seen.sum() == 119
    assert rows.names_of(KINDS["plane"]) == ()
    assert len(compute_tip_errors(Model(ARM), rows)) == 119
    calibrated = la.calibrate(ARM, rows)
    assert miss(calibrated.model, HIDDEN) < 3 * SIGMA
    said = [str(f) for f in admit(rows, ARM).findings]
    assert any(line.startswith("touch: once: in fewer than 2 rows") for line in said)
    assert any(line.startswith("plane: floor: in fewer than 4 rows") for line in said)
