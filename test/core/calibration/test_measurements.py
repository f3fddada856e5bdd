"""What a sensor of any kind measures calibrates the arm: planted arms, judged at the true tip."""

from pathlib import Path

import numpy as np
import pytest
from discover_rows import DEMO
from few_effects import few_effects, names_alone
from numeric_columns import numeric_columns
from scipy.spatial.transform import Rotation
from sensed_arm import (
    ANCHORS,
    BODY,
    CAMERAS,
    GAIN,
    SIGMA,
    SIGMA_ROT,
    Sensed,
    declared,
    miss,
    nowhere,
    only,
    read,
    sensed,
)
from small_arm import ARM

import longarm_comp as la
from longarm_comp.core.calibration.calibrate import geometry_terms
from longarm_comp.core.calibration.fit import fit_model
from longarm_comp.core.calibration.noise import noise_from_repeats
from longarm_comp.core.calibration.placement import place_sensors
from longarm_comp.core.data.kinds import rotation_vector
from longarm_comp.core.data.measurement import compute_tip_errors, make_equations
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.camera_errors import CameraScale
from longarm_comp.core.effects.drive_errors import GearEccentricity, JointGain
from longarm_comp.core.effects.geometry_errors import JointZero
from longarm_comp.core.effects.placements import (
    AnchorPlace,
    CameraPose,
    SensorPlace,
    TipOrientation,
)
from longarm_comp.core.errors import InputError
from longarm_comp.core.identify.diagnose import diagnose
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model
from longarm_comp.report.record import parse_report
from longarm_comp.sessions.csv import read_csv, write_csv

GOOD = 1.5e-4
"""What 100 whole positions leave at the true tip is below 0.1 mm; the declared arm errs by 4 mm."""


def fitted(session: Session, arm: la.Arm = ARM) -> Model:
    base = declared_model(arm).plus(*geometry_terms(arm, session))
    return fit_model(place_sensors(base, session), session).model


def mixture(seed: int = 3) -> Session:
    """A third each of poses, of one or two coordinates, and of distances."""
    rows = sensed(n=150, seed=seed)
    third = np.arange(150) % 3
    xyz = rows.position()
    xyz[third == 1] = np.where(rows.rng.random((50, 3)) < 0.5, np.nan, xyz[third == 1])
    xyz[third == 2] = np.nan
    names = np.where(third == 2, rows.rng.choice(list(ANCHORS), 150), "")
    wires = rows.distance(np.where(names == "", "left", names))
    readings = {
        "orientation": only(rows.quaternion(), third == 0),
        "distance": only(wires, third == 2),
    }
    return read(rows, xyz=xyz, readings=readings, labels={"anchor": names})


def test_the_declared_arm_errs() -> None:
    assert miss(Model(ARM)) > 2e-3


def test_columns_are_derivatives_of_every_equation() -> None:
    """Central differences of the residual, at a model with every kind of bias."""
    session = mixture()
    arm = declared(camera={"position_m": [0.75, -1.7, 0.3]})
    terms = (*geometry_terms(arm, session), CameraScale(), CameraPose())
    base = place_sensors(Model(arm).plus(*terms), session)
    base = base.with_values(base.values + 1e-3 * np.sin(np.arange(len(base.values))))
    found = make_equations(base, session)
    for k, slot, want in numeric_columns(base, session, lambda _: 1e-5):
        limit = 0.02 * max(np.abs(want).max(), 1e-3)
        np.testing.assert_allclose(found.columns[..., k], want, atol=limit, err_msg=slot.label)
        assert np.abs(want).max() > 0, slot.label


def test_poses_calibrate_better_than_their_positions() -> None:
    alone, both = [], []
    for seed in range(6):
        rows = sensed(n=14, seed=seed)
        xyz, readings = rows.position(1e-3), {"orientation": rows.quaternion(sigma=3e-4)}
        alone.append(miss(fitted(read(rows, xyz=xyz))))
        model = fitted(read(rows, xyz=xyz, readings=readings))
        both.append(miss(model))
    assert np.mean(both) < 0.9 * np.mean(alone)
    turn = next(t for t in model.biases if isinstance(t, TipOrientation))
    planted = BODY * Rotation.from_rotvec([turn.rx, turn.ry, turn.rz]).inv()
    assert planted.magnitude() < 5e-3


def test_orientations_and_distances_have_noise_of_their_own() -> None:
    session = mixture()
    base = declared_model(ARM).plus(*geometry_terms(ARM, session))
    found = fit_model(place_sensors(base, session), session)
    noise = dict(zip(session.channels, found.sigma, strict=True))
    for name, sigma in (("x", SIGMA), ("rz", SIGMA_ROT), ("distance", SIGMA)):
        assert noise[name] == pytest.approx(sigma, rel=0.35)
    assert found.weights.all()
    assert miss(found.model) < GOOD


@pytest.mark.parametrize("axes", ["xz", "yz", "xy"])
def test_coordinates_may_be_missing(axes: str) -> None:
    rows = sensed(n=150)
    xyz = rows.position()
    xyz[:, ["xyz".index(a) for a in "xyz" if a not in axes]] = np.nan
    xyz[:8] = rows.xyz[:8]
    assert miss(fitted(read(rows, xyz=xyz))) < GOOD


def test_distances_to_solved_anchors_calibrate_the_arm_in_its_own_base() -> None:
    rows = sensed(n=200)
    names = rows.rng.choice(list(ANCHORS), 200)
    distance = rows.distance(names)
    distance[7] += 0.05
    labels = {"anchor": names}
    session = read(rows, xyz=nowhere(200), readings={"distance": distance}, labels=labels)
    base = declared_model(ARM).plus(*geometry_terms(ARM, session))
    found = fit_model(place_sensors(base, session), session)
    assert list(found.outliers) == [7]
    for term in found.model.biases:
        assert isinstance(term, AnchorPlace)
        away = np.subtract([term.x, term.y, term.z], ANCHORS[term.anchor])
        assert np.linalg.norm(away) < 0.01
    left = np.delete(compute_tip_errors(found.model, session), 7, axis=0)
    assert np.linalg.norm(left, axis=1).mean() < 2 * SIGMA


def test_distances_to_declared_anchors_calibrate_the_arm() -> None:
    arm = declared(anchors={name: {"xyz_m": place} for name, place in ANCHORS.items()})
    rows = sensed(n=150)
    names = rows.rng.choice(list(ANCHORS), 150)
    readings = {"distance": rows.distance(names)}
    session = read(rows, xyz=nowhere(150), readings=readings, labels={"anchor": names})
    model = fitted(session, arm)
    assert not model.biases
    assert miss(model) < 3 * GOOD


def cameras() -> la.Arm:
    sensors = {
        name: {"kind": "camera", "xyz_m": place, "rpy_deg": turn}
        for name, (place, turn) in CAMERAS.items()
    }
    return declared(sensors=sensors)


def test_rays_of_calibrated_cameras_calibrate_the_arm(tmp_path: Path) -> None:
    arm, rows = cameras(), sensed(n=200)
    names = rows.rng.choice(list(CAMERAS), 200)
    readings = {"ray": rows.ray(names)}
    path = tmp_path / "samples.csv"
    write_csv(read(rows, xyz=nowhere(200), readings=readings, labels={"sensor": names}), path)
    session = read_csv(path, arm)
    base = declared_model(arm).plus(*geometry_terms(arm, session))
    found = fit_model(place_sensors(base, session), session)
    assert not found.model.biases
    assert found.sigma == pytest.approx(np.full(4, SIGMA_ROT), rel=0.3)
    assert miss(found.model) < 3 * GOOD
    sideways = np.linalg.norm(compute_tip_errors(found.model, session), axis=1)
    assert 0.5e-3 < np.sqrt((sideways**2).mean()) < 1.1e-3


def test_several_sensors_have_a_place_and_a_noise_of_their_own() -> None:
    """A tracker, and a coarse camera anywhere else, of which one sees poses."""
    rows = sensed(n=160)
    coarse = np.arange(160) % 3 == 1
    away = Rotation.from_rotvec([0.4, -1.1, 2.0])
    xyz = np.where(coarse[:, None], rows.position(1e-3), rows.position())
    xyz[coarse] = away.apply(xyz[coarse]) + np.array([3.0, -2.0, 7.0])
    turned = rows.quaternion(sigma=2e-3)
    turned[coarse] = (away * Rotation.from_quat(turned[coarse])).as_quat()
    names = np.where(coarse, "camera", "tracker")
    readings = {"orientation": turned}
    session = read(rows, xyz=xyz, readings=readings, labels={"sensor": names})
    base = declared_model(ARM).plus(*geometry_terms(ARM, session))
    found = fit_model(place_sensors(base, session), session)
    noise = dict(zip(session.channels, found.sigma, strict=True))
    assert noise["tracker x"] == pytest.approx(SIGMA, rel=0.35)
    assert noise["camera x"] == pytest.approx(1e-3, rel=0.35)
    assert miss(found.model) < GOOD
    place = next(t for t in found.model.biases if isinstance(t, SensorPlace))
    turn = Rotation.from_rotvec([place.rx, place.ry, place.rz])
    assert (turn * away.inv()).magnitude() < 3e-3


def test_a_row_counts_for_what_it_holds() -> None:
    """An equation that was not measured neither moves the fit nor its covariance."""
    rows = sensed(n=60)
    positions = read(rows)
    quaternion = np.full((60, 4), np.nan)
    quaternion[5] = rows.quaternion()[5]
    more = read(rows, xyz=positions.xyz, readings={"orientation": quaternion})
    base = Model(ARM).plus(*JointZero.for_arm(ARM))
    one = fit_model(base, positions, sigma=np.full(3, SIGMA), robust=False)
    two = fit_model(base, more, sigma=np.full(6, [SIGMA] * 3 + [1e6] * 3), robust=False)
    np.testing.assert_allclose(two.model.values, one.model.values, rtol=1e-9)
    np.testing.assert_allclose(two.covariance, one.covariance, rtol=1e-9)


def test_calibrate_and_evaluate_take_a_mixture(tmp_path: Path) -> None:
    path = tmp_path / "samples.csv"
    write_csv(mixture(), path)
    session = read_csv(path, ARM)
    assert session.hash == mixture().hash
    found = la.calibrate(ARM, path)
    assert miss(found.model) < GOOD
    errs = la.evaluate(ARM, path, model=found.model)
    assert errs["calibrated"].mean < 0.25 * errs["rigid"].mean


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_orientations_alone_name_an_effect_and_prove_it_by_turns() -> None:
    rows = sensed(GAIN, n=60, seed=3)
    session = read(rows, xyz=nowhere(60), readings={"orientation": rows.quaternion()})
    held = sensed(GAIN, n=40, seed=9)
    test = read(held, xyz=nowhere(40), readings={"orientation": held.quaternion()})
    for rows_held_out in (test, None):
        with names_alone():
            made = diagnose(ARM, session, test=rows_held_out, kinds=(JointGain,))
        (found,) = made.findings
        assert (found.name, found.seen_mm) == ("joint_gain", (0.0, 0.0))
        assert (made.written, made.failed, made.expected) == ("with_effects", "", {})
        turns = made.proof.turn_sizes
        assert turns["with_effects"].mean() < 0.2 * turns["calibrated"].mean()


@pytest.mark.parametrize("kind", [pytest.param("pose", marks=pytest.mark.long), "mixture"])
def test_diagnose_names_the_effect_from_poses_and_from_a_mixture(kind: str, tmp_path: Path) -> None:
    """A wrong gain at joint 2, seen by poses, and by positions beside distances."""

    def seen(n: int, seed: int) -> Session:
        rows = sensed(GAIN, n=n, seed=seed)
        far = np.arange(n) % 3 == 0
        names = np.where(far, rows.rng.choice(list(ANCHORS), n), "")
        if kind == "pose":
            return read(rows, readings={"orientation": rows.quaternion()})
        wires = only(rows.distance(np.where(far, names, "left")), far)
        return read(
            rows,
            xyz=only(rows.position(), ~far),
            readings={"distance": wires},
            labels={"anchor": names},
        )

    with few_effects((JointGain, GearEccentricity)), names_alone():
        found = la.diagnose(ARM, seen(120, 3), test=seen(60, 4), network=False)
    assert found.verdict in ("named", "set")
    assert [(f.name, f.where) for f in found.findings] == [("joint_gain", ("joint 2",))]
    assert miss(found.model, GAIN) < GOOD
    assert not found.diagnosis.structure.flag
    found.save(tmp_path / "out")
    parse_report(found.report.model_dump(by_alias=True, mode="json"))


def test_what_cannot_be_is_refused() -> None:
    rows = sensed(n=6)
    for readings, words in (
        ({"orientation": 2 * rows.quaternion()}, "length 1"),
        ({"distance": -np.ones((6, 1))}, "above 0"),
        ({"distance": np.ones((6, 1))}, "anchor"),
        ({"smell": np.ones((6, 1))}, "orientation, distance"),
    ):
        with pytest.raises(InputError, match=words):
            read(rows, readings=readings)
    wires = read(
        sensed(n=40),
        xyz=nowhere(40),
        readings={"distance": np.ones((40, 1))},
        labels={"anchor": np.full(40, "left")},
    )
    with pytest.raises(InputError, match="not measured together"):
        la.train(ARM, wires)
    arm = declared(anchors={"left": {"xyz_m": [0, 0, 0]}})
    names = np.full(6, "lft")
    wrong = read(rows, readings={"distance": np.ones((6, 1))}, labels={"anchor": names})
    with pytest.raises(InputError, match=r"lft.*left"):
        la.calibrate(arm, wrong)
    rays = read(rows, readings={"ray": np.ones((6, 3))}, labels={"sensor": np.full(6, "hall")})
    with pytest.raises(InputError, match=r"hall.*boom, wall"):
        la.calibrate(cameras(), rays)


def test_repeats_tell_the_noise_of_every_kind_in_enough_of_them() -> None:
    """Ten poses, each measured six times: poses, and a wire to one of two anchors."""
    one = sensed(n=10)
    again = np.repeat(np.arange(10), 6)
    rows = Sensed(one.q[again], one.xyz[again], one.axes[again], one.rng)
    names = np.where(np.arange(60) % 2 == 0, "left", "right")
    wires = rows.distance(names)
    wires[5] += 0.02
    xyz = rows.position()
    xyz[8:, 2] = np.nan  # too few of them
    readings = {"orientation": rows.quaternion(), "distance": wires}
    session = read(rows, xyz=xyz, readings=readings, labels={"anchor": names})
    model = place_sensors(declared_model(ARM).plus(*geometry_terms(ARM, session)), session)
    noise = noise_from_repeats(model, session)
    assert noise is not None
    told = dict(zip(session.channels, noise.sigma, strict=True))
    for name, sigma in (("x", SIGMA), ("rz", SIGMA_ROT), ("distance", SIGMA)):
        assert told[name] == pytest.approx(sigma, rel=0.35)
    assert np.isinf(told["z"])


def test_a_copied_row_is_no_second_measurement() -> None:
    """Ten poses, each measured six times; of others every row stands twice."""
    rng = np.random.default_rng(1)
    again = np.repeat(np.arange(10), 6)
    q = ARM.lower + rng.random((30, ARM.n)) * (ARM.upper - ARM.lower)
    q = np.concatenate([q[again], np.repeat(q[10:], 2, axis=0)])
    xyz = declared_model(ARM).tip(q) + SIGMA * rng.standard_normal((100, 3))
    xyz[61::2] = xyz[60::2]
    noise = noise_from_repeats(declared_model(ARM), Session.record(q, xyz))
    assert noise is not None and 40.0 < noise.degrees <= 50.0
    np.testing.assert_allclose(noise.sigma, SIGMA, rtol=0.35)
    assert noise_from_repeats(declared_model(ARM), Session.record(q[60:], xyz[60:])) is None


def test_a_network_learns_from_whole_positions_and_says_what_it_leaves_out() -> None:
    session = mixture()
    model = la.calibrate(ARM, session).model
    said: list[str] = []
    learned = la.train(ARM, session, model=model, ensemble=1, init="xavier", note=said.append)
    assert learned.samples == session.has_position.sum() < len(session)
    left = int((session.seen & ~session.has_position).sum())
    assert any(f"{left} rows hold no whole position" in text for text in said)


def test_what_is_no_rotation_has_no_rotation_vector() -> None:
    turn = Rotation.from_rotvec([0.1, 0.2, -0.3]).as_matrix()
    mirrored, broken = np.diag([1.0, 1.0, -1.0]), np.full((3, 3), np.nan)
    found = rotation_vector(np.stack([2.0 * turn, mirrored, broken]))
    assert found[0] == pytest.approx([0.1, 0.2, -0.3])
    assert np.isnan(found[1:]).all()


def test_rows_that_say_no_position_leave_no_errors_of_a_bending_arm() -> None:
    model = declared_model(DEMO)
    q = DEMO.lower + (DEMO.upper - DEMO.lower) * np.random.default_rng(3).random((4, DEMO.n))
    axes = Rotation.from_matrix(np.stack([model.pose(row)[:3, :3] for row in q])).as_quat()
    session = Session.record(q, np.full((4, 3), np.nan), readings={"orientation": axes})
    assert compute_tip_errors(model, session).shape == (0, 3)
