"""A base 20 m away and turned, seen by rows that hold no whole position: judged at the true tip."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from few_effects import few_effects, names_alone
from scipy.spatial.transform import Rotation
from sensed_arm import (
    ANCHORS,
    BODY,
    CAMERAS,
    GAIN,
    SIGMA_ROT,
    ZEROS,
    Sensed,
    declared,
    nowhere,
    only,
    read,
    sensed,
)

import longarm_comp as la
from longarm_comp.cli.fit import calibrate as calibrate_command
from longarm_comp.cli.fit import evaluate as evaluate_command
from longarm_comp.core.calibration.calibrate import fit_stages
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.calibration.undetermined import list_places, list_undetermined
from longarm_comp.core.data.lifted_base import lifted_base, multilaterate
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.drive_errors import GearEccentricity, JointGain
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model
from longarm_comp.sessions.csv import write_csv

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

TURNS = [Rotation.from_rotvec([0.7, -1.1, 1.84]), Rotation.from_rotvec([-3.0, 0.3, 0.2])]
FAR = np.array([12.0, -15.0, 4.0])
N = 120


def there(rows: Sensed, turn: Rotation) -> Sensed:
    """The rows as a measuring frame sees them in which the base stands far away."""
    return Sensed(rows.q, turn.apply(rows.xyz) + FAR, turn * rows.axes, rows.rng)


def arm(turn: Rotation) -> la.Arm:
    """The small arm with anchors and cameras declared in that frame, the base undeclared."""
    anchors = {k: {"xyz_m": (turn.apply(v) + FAR).tolist()} for k, v in ANCHORS.items()}
    sensors = {}
    for name, (place, angles) in CAMERAS.items():
        axes = turn * Rotation.from_euler("xyz", angles, degrees=True)
        rpy = axes.as_euler("xyz", degrees=True).tolist()
        sensors[name] = {
            "kind": "camera",
            "xyz_m": (turn.apply(place) + FAR).tolist(),
            "rpy_deg": rpy,
        }
    return declared(anchors=anchors, sensors=sensors)


def session(kind: str, turn: Rotation, n: int = N) -> Session:
    near = sensed(n=n, seed=4)
    rows = there(near, turn)
    if kind == "distance":
        names = rows.rng.choice(list(ANCHORS), n)
        length = near.distance(names)
        length[3] += 0.3
        return read(rows, xyz=nowhere(n), readings={"distance": length}, labels={"anchor": names})
    if kind == "ray":
        names = rows.rng.choice(list(CAMERAS), n)
        return read(
            rows, xyz=nowhere(n), readings={"ray": near.ray(names)}, labels={"sensor": names}
        )
    if kind == "axes":
        return read(rows, xyz=nowhere(n), readings={"orientation": rows.quaternion()})
    xyz = rows.position()
    xyz[:, ["xyz".index(a) for a in "xyz" if a not in kind]] = np.nan
    return read(rows, xyz=xyz)


def calibrated(kind: str, turn: Rotation) -> ModelFit:
    *_, (_, fitted) = fit_stages(declared_model(arm(turn)), session(kind, turn))
    return fitted


def missed(model: Model, turn: Rotation) -> np.ndarray:
    """(3,) mean error (m) along the axes of the measuring frame, at fresh poses."""
    fresh = there(sensed(ZEROS, 200, seed=99), turn)
    return np.asarray(np.abs(model.tip(fresh.q) - fresh.xyz).mean(axis=0))


@pytest.mark.parametrize("turn", TURNS)
@pytest.mark.parametrize("kind", ["xy", "yz", "x", "z"])
def test_coordinates_alone_place_and_calibrate_what_they_see(kind: str, turn: Rotation) -> None:
    found = calibrated(kind, turn)
    left = missed(found.model, turn)
    seen = ["xyz".index(axis) for axis in kind]
    assert found.converged and left[seen].max() < 1.5e-4
    away = [axis for axis in "xyz" if axis not in kind]
    turns = [f"turn about {kind}"] if len(kind) == 1 else []
    assert list_undetermined(found) == (f"base: {', '.join([*away, *turns])}",)


@pytest.mark.parametrize("turn", TURNS)
@pytest.mark.parametrize(("kind", "good"), [("distance", 3e-4), ("ray", 4e-4)])
def test_distances_and_rays_place_and_calibrate_the_arm(
    kind: str, good: float, turn: Rotation
) -> None:
    found = calibrated(kind, turn)
    assert found.converged and missed(found.model, turn).max() < good
    assert list_undetermined(found) == ()


@pytest.mark.parametrize("turn", TURNS)
def test_axes_alone_tell_turns_and_no_place(turn: Rotation) -> None:
    found = calibrated("axes", turn)
    fresh = there(sensed(ZEROS, 200, seed=99), turn)
    axes = Rotation.from_matrix(found.model.pose(fresh.q)[:, :3, :3])
    body = axes.inv() * fresh.axes * BODY
    assert (body * body.mean().inv()).magnitude().mean() < SIGMA_ROT
    assert list_undetermined(found) == ("base: x, y, z", "tip: x, y, z", "the size of the arm")


def test_every_step_of_the_closed_form_is_exact() -> None:
    near = sensed(n=40)
    rows = there(near, TURNS[0])
    axes = near.axes.as_matrix()
    for kind in ("x", "xz", "xyz"):
        xyz = rows.xyz.copy()
        xyz[:, ["xyz".index(a) for a in "xyz" if a not in kind]] = np.nan
        made = Session.record(rows.q, xyz)
        turn, place = lifted_base(arm(TURNS[0]), near.xyz, axes, made)
        seen = ["xyz".index(axis) for axis in kind]
        np.testing.assert_allclose(turn[seen], TURNS[0].as_matrix()[seen], atol=1e-9)
        np.testing.assert_allclose(place[seen], FAR[seen], atol=1e-9)
        np.testing.assert_allclose(np.delete(place, seen), 0.0, atol=1e-9)
        assert np.linalg.det(turn) == pytest.approx(1.0)
    turned = Session.record(
        rows.q, nowhere(40), readings={"orientation": rows.quaternion(sigma=0.0)}
    )
    turn, place = lifted_base(arm(TURNS[0]), near.xyz, axes, turned)
    np.testing.assert_allclose(turn, TURNS[0].as_matrix(), atol=1e-9)
    np.testing.assert_array_equal(place, 0.0)
    anchor = np.array(ANCHORS["top"])
    length = np.linalg.norm(near.xyz - anchor, axis=1)
    length[2] += 1.0
    np.testing.assert_allclose(multilaterate(near.xyz, length), anchor, atol=1e-9)


def test_what_one_coordinate_leaves_open_is_turned_as_little_as_can_be() -> None:
    near = sensed(n=40)
    about_z = Rotation.from_rotvec([0, 0, 1.0])
    xyz = there(near, about_z).xyz * [np.nan, np.nan, 1.0]
    turn, _ = lifted_base(
        arm(about_z), near.xyz, near.axes.as_matrix(), Session.record(near.q, xyz)
    )
    np.testing.assert_allclose(turn, np.eye(3), atol=1e-9)


# ------------------------------------------------------------------ commands


def test_calibrate_and_evaluate_say_what_was_placed_and_what_is_untold(tmp_path: Path) -> None:
    turn = TURNS[0]
    declared_arm = arm(turn).model_dump(mode="json", exclude_defaults=True)
    (tmp_path / "arm.yaml").write_text(yaml.safe_dump(declared_arm), "utf-8")
    for kind in ("z", "axes"):
        write_csv(session(kind, turn), tmp_path / f"{kind}.csv")
        names = [str(tmp_path / name) for name in ("arm.yaml", f"{kind}.csv", "model.yaml")]
        done = CliRunner().invoke(calibrate_command, [*names[:2], "-o", names[2], "--json"])
        assert done.exit_code == 0, done.output
        told = json.loads(done.stdout)
        assert told["placed"] and told["untold"][0].startswith("base: x, y")
        assert "the rows do not show base: x, y" in done.stderr
        last = told["held_out"][-1]
        if kind == "z":
            assert told["held_out"][0]["mean_mm"] < 30  # placed, not metres away
            assert last["mean_mm"] < 0.3 and "mean_mrad" not in last
        else:
            assert told["held_out"][0]["mean_mrad"] < 100
            assert last["n"] == 0 and last["mean_mm"] is None and last["mean_mrad"] < 1.5
        shown = CliRunner().invoke(evaluate_command, [names[0], "--test", names[1], "--json"])
        assert shown.exit_code == 0, shown.output
        assert json.loads(shown.stdout)["placed"] and "was placed" in shown.stderr
        with_model = ["--test", names[1], "--model", names[2], "--json"]
        shown = CliRunner().invoke(evaluate_command, [names[0], *with_model])
        assert shown.exit_code == 0, shown.output


def test_an_arm_that_stands_elsewhere_than_its_model_says_is_judged_and_said() -> None:
    rows = sensed(n=60)
    near, far = read(rows), read(there(rows, TURNS[0]))
    model = la.calibrate(arm(TURNS[0]), near).model
    said: list[str] = []
    judged = la.evaluate(arm(TURNS[0]), far, model=model, note=said.append)
    assert any("from where the model expects it" in text for text in said)
    assert judged["calibrated"].mean > 1.0
    found = la.evaluate(arm(TURNS[0]), far)
    assert found.placed and found["rigid"].mean < 0.02
    assert not la.evaluate(arm(TURNS[0]), near).placed


@pytest.mark.parametrize("kind", ["z", "distance"])
def test_shuffled_rows_are_no_calibration(kind: str) -> None:
    rows = session(kind, TURNS[0], 60)
    mixed = dataclasses.replace(rows, q=np.random.default_rng(0).permutation(rows.q))
    with pytest.raises(la.JobError, match=r"is left after calibration|worse|carry over"):
        la.calibrate(arm(TURNS[0]), mixed)


def test_axes_alone_are_not_diagnosed_or_learned() -> None:
    rows = session("axes", TURNS[0], 40)
    with pytest.raises(InputError, match="calibrate takes orientations alone"):
        la.diagnose(arm(TURNS[0]), rows)
    with pytest.raises(InputError, match="not measured together"):
        la.train(arm(TURNS[0]), rows)


def test_a_diagnosis_does_not_depend_on_where_the_base_stands() -> None:
    """The same rows seen from 20 m away: the same name, and the evidence but for the noise.

    The noise is estimated along the axes of the measuring frame, which are others then.
    """
    rows, held = sensed(GAIN, n=100, seed=5), sensed(GAIN, n=40, seed=6)
    seen, told = rows.position(), held.position()
    with few_effects((JointGain, GearEccentricity)), names_alone():
        near, far = (
            la.diagnose(declared(), Session.record(rows.q, xyz), test=test, network=False)
            for xyz, test in (
                (seen, Session.record(held.q, told)),
                (TURNS[0].apply(seen) + FAR, Session.record(held.q, TURNS[0].apply(told) + FAR)),
            )
        )
    (one,), (other,) = near.findings, far.findings
    assert near.verdict == far.verdict
    assert (one.name, one.where, one.names) == (other.name, other.where, other.names)
    assert other.log_bayes_factor == pytest.approx(one.log_bayes_factor, rel=0.1)
    for name in ("calibrated", "with_effects"):
        assert far.held_out[name].mean == pytest.approx(near.held_out[name].mean, rel=0.02)


@pytest.mark.long
@pytest.mark.usefixtures("few_names")
def test_diagnose_names_the_effect_from_rays() -> None:
    turn = TURNS[0]
    near = sensed(GAIN, n=160, seed=5)
    rows = there(near, turn)
    names = rows.rng.choice(list(CAMERAS), 160)
    rays = only(near.ray(names), np.arange(160) % 3 != 0)
    poses = np.where((np.arange(160) % 3 == 0)[:, None], rows.position(), np.nan)
    made = read(rows, xyz=poses, readings={"ray": rays}, labels={"sensor": names})
    found = la.diagnose(arm(turn), made, network=False)
    assert [(f.name, f.where) for f in found.findings] == [("joint_gain", ("joint 2",))]


def test_calibrate_says_how_well_it_knows_the_base(rng: np.random.Generator) -> None:
    """The tip known, a base is told as a rigid body by N points: turned about its own origin."""
    turn = TURNS[0]
    known = arm(turn).model_dump(exclude_defaults=True)
    known["tolerance"] = {"tip": {"xyz_m": [1e-9] * 3}}
    model = declared_model(la.Arm.parse(known, "arm"))
    q = sensed(n=500).q
    seen = Session.record(q, turn.apply(model.tip(q)) + FAR + 1e-4 * rng.standard_normal((500, 3)))
    (_, found), *_ = fit_stages(model, seen)
    (place,) = list_places(found)
    np.testing.assert_allclose(place.xyz_m, FAR, atol=1e-3)
    np.testing.assert_allclose(
        Rotation.from_euler("xyz", place.rpy_deg, degrees=True).as_matrix(), turn.as_matrix(),
        atol=2e-3,
    )  # fmt: skip
    x, y, z = (seen.xyz - place.xyz_m).T
    o = np.zeros(500)
    design = np.zeros((500, 3, 6))
    design[:, :, :3] = np.eye(3)
    design[:, :, 3:] = -np.array([[o, -z, y], [z, o, -x], [-y, x, o]]).transpose(2, 0, 1)
    told = (design / found.sigma[:, None]).reshape(-1, 6)
    sd = np.sqrt(np.diag(np.linalg.inv(told.T @ told)))
    np.testing.assert_allclose(place.sd_mm, 1e3 * sd[:3], rtol=0.05)
    np.testing.assert_allclose(place.sd_deg, np.degrees(sd[3:]), rtol=0.05)


def test_points_in_site_coordinates_are_refused_before_digits_are_lost() -> None:
    seen = sensed(n=40)
    far = there(seen, TURNS[0])
    rows = Session.record(far.q, far.xyz - [0.0, 250.0, 0.0])
    with pytest.raises(InputError, match=r"xyz: '26.*200 m from the frame's origin"):
        list(fit_stages(Model(arm(TURNS[0])), rows))
