"""Poses as instruments write them: `longarm import-data` reads the same numbers, or refuses."""

import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from cli_shell import Shell
from hypothesis import given, settings
from hypothesis import strategies as st
from pose_tables import POSE, line, split
from scipy.spatial.transform import Rotation as Turn
from small_arm import ARM

from longarm_comp.core.data.session import Session
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.model import Model
from longarm_comp.sessions.csv import read_csv
from longarm_comp.sessions.foreign.convert import Options, import_table
from longarm_comp.sessions.foreign.written import Like
from longarm_comp.sessions.targets import Targets, read_targets

N = 5
NOA = "nx ny nz ox oy oz ax ay az"


def quaternion(turns: Turn) -> np.ndarray:
    return turns.as_quat()


def angles(axes: str) -> Callable[[Turn], np.ndarray]:
    return lambda turns: turns.as_euler(axes)


def matrix(turns: Turn) -> np.ndarray:
    return turns.as_matrix().reshape(-1, 9)


def by_columns(turns: Turn) -> np.ndarray:
    return turns.as_matrix().transpose(0, 2, 1).reshape(-1, 9)


POSITIONS = (
    *("x y z", "tx ty tz", "Px Py Pz", "pos_x pos_y pos_z", "T_X T_Y T_Z", "T03 T13 T23"),
    *("Position X|Position Y|Position Z", "translation.x translation.y translation.z"),
)
# names, their values, and the convention that --rotation must say, if the names do not
TURNS: tuple[tuple[str, Callable[[Turn], np.ndarray], str], ...] = (
    ("", quaternion, ""),
    ("qx qy qz qw", quaternion, ""),
    ("Qx Qy Qz Q0", quaternion, ""),
    ("q_i q_j q_k q_0", quaternion, ""),
    ("rotation.x rotation.y rotation.z rotation.w", quaternion, ""),
    ("Rotation X|Rotation Y|Rotation Z|Rotation W", quaternion, ""),
    ("Q0 Q1 Q2 Q3", lambda turns: turns.as_quat(scalar_first=True), "wxyz"),
    ("rv_x rv_y rv_z", Turn.as_rotvec, ""),
    ("R00 R01 R02 R10 R11 R12 R20 R21 R22", matrix, ""),
    ("r11 r12 r13 r21 r22 r23 r31 r32 r33", matrix, ""),
    (NOA, by_columns, ""),
    ("rx ry rz", Turn.as_rotvec, "rotvec"),
    ("RX RY RZ", angles("xyz"), "xyz"),
    ("roll pitch yaw", angles("xyz"), "xyz"),
    ("A B C", angles("ZYX"), "ZYX"),
    ("W P R", angles("xyz"), "xyz"),
)


def rows(seed: int) -> tuple[Session, Turn]:
    rng = np.random.default_rng(seed)
    q = ARM.lower + rng.random((N, ARM.n)) * (ARM.upper - ARM.lower)
    return Session.record(q, rng.uniform(-1, 1, (N, 3))), Turn.random(N, rng=rng)


def read(text: str, **told: object) -> Session:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.csv"
        path.write_text(text)
        import_table(path, Options(arm=ARM, **told)).save(path)  # type: ignore[arg-type]
        return read_csv(path, ARM)


@st.composite
def written(draw: st.DrawFn) -> tuple[str, dict[str, object], int, Session, Turn, bool]:
    """A table, what is said of it, how many markers it has, what it holds, and whether only x, y, z
    are to be read of it."""
    seed = draw(st.integers(0, 1000))
    session, turns = rows(seed)
    names, values, convention = draw(st.sampled_from(TURNS))
    position = draw(st.sampled_from(POSITIONS))
    markers = draw(
        st.sampled_from([[""], [""], ["tool "], ["M1 ", "M2 "], ["prism A.", "prism B."]])
    )
    unit, per_m = draw(st.sampled_from([("m", 1.0), ("mm", 1e3), ("in", 1 / 0.0254)]))
    turn, per_rad = draw(st.sampled_from([("rad", 1.0), ("deg", 180 / np.pi)]))
    table: dict[str, np.ndarray] = {}
    for j, (name, row) in enumerate(
        zip(("q1", "A2", "Joint 3", "axis4"), session.q.T, strict=True)
    ):
        factor = 1e3 if j == 2 else 180 / np.pi
        table[f"{name} [{'mm' if j == 2 else 'deg'}]"] = row * factor
    parts = split(names)
    for k, marker in enumerate(markers):
        for part, numbers in zip(split(position), (session.xyz + k).T, strict=True):
            table[marker + part] = numbers * per_m
        is_angle = len(parts) == 3
        held = values(turns * turns[:1] ** k) * (per_rad if is_angle else 1.0)
        for part, numbers in zip(parts, held.T, strict=False):
            table[marker + part] = numbers
    for junk in draw(st.sets(st.sampled_from(["Quality", "Mean Marker Error", "Status", "Frame"]))):
        table[junk] = np.arange(N) + 0.5
    order = draw(st.permutations(list(table)))
    frame = pd.DataFrame(table)[order]
    blank = any(" " in name for name in order)
    mark = draw(st.sampled_from([",", ";", "\t"] if blank else [",", ";", "\t", "  "]))
    decimal = "," if mark == ";" and draw(st.booleans()) else "."
    lines = [mark.join(order)]
    lines += [
        mark.join(repr(float(v)).replace(".", decimal) for v in row) for row in frame.to_numpy()
    ]
    told: dict[str, object] = {"units": (unit, turn)}
    head = draw(st.sampled_from(["", "# ", "#", "% "]))
    if draw(st.booleans()) and len(markers) == 1:
        told["columns"], lines = tuple(order), lines[1:]
    else:
        lines[0] = head + lines[0]
    how = draw(st.sampled_from(["told", "told", "inverse", "none"])) if names else ""
    melted = ["" if len(markers) > 1 else markers[0]][0]
    if how == "none":
        told["rotation"] = "none"
    elif how == "inverse" or (how and convention):
        known = convention or {4: "xyzw", 9: "matrix", 3: "rotvec"}[len(parts)]
        listed = [melted + part for part in parts]
        if parts == NOA.split():
            listed = [melted + f"{c}{axis}" for axis in "xyz" for c in "noa"]
        told["rotation"] = f"{'-' * (how == 'inverse')}{known}:{','.join(listed)}"
    gone = not how or how == "none"
    expected = turns.inv() if how == "inverse" else turns
    return "\n".join(lines), told, len(markers), session, expected, gone


@settings(max_examples=120, deadline=None)
@given(table=written())
def test_any_mixture_is_read_to_the_same_numbers_or_refused(
    table: tuple[str, dict[str, object], int, Session, Turn, bool],
) -> None:
    text, told, markers, session, turns, gone = table
    try:
        found = read(text, **told)
    except InputError as error:
        if markers == 1 or "--rotation" not in str(error):
            raise  # only of several markers may the columns have other names
        return
    assert len(found) == N * markers
    names = np.unique(found.labels.get("marker", np.full(N, "")))
    one, last = (found.take(found.labels["marker"] == name) if markers > 1 else found
                 for name in (names[0], names[-1]))  # fmt: skip
    np.testing.assert_allclose(one.q, session.q, atol=1e-12)
    np.testing.assert_allclose(one.xyz, session.xyz, atol=1e-12)
    np.testing.assert_allclose(last.xyz, session.xyz + markers - 1, atol=1e-12)
    seen = one.readings.get("orientation")
    if gone:
        assert seen is None
    else:
        assert seen is not None
        assert (Turn.from_quat(seen).inv() * turns).magnitude().max() < 1e-7


@pytest.mark.parametrize("names", [t[0] for t in TURNS if t[2]])
def test_names_that_do_not_say_their_convention_are_asked_for_it(names: str, shell: Shell) -> None:
    size = len(split(names))
    Path("log.csv").write_text(line(f"tx ty tz {names}", POSE[:, : 3 + size]))
    call = ("import-data", "log.csv", "--units", "m,rad")
    assert f"missing for {', '.join(split(names))}" in shell.refused(*call)
    assert shell(*call, "--rotation", "none") == 0, shell.err
    assert list(pd.read_csv("samples.csv")) == ["q1", "q2", "q3", "q4", "x", "y", "z"]


def test_angles_are_in_no_unit_of_lengths(shell: Shell) -> None:
    Path("log.csv").write_text(line("x|y|z|rx [mm]|ry|rz", POSE[:, :6]))
    call = ("import-data", "log.csv", "--units", "m,rad", "--rotation", "rotvec:rx,ry,rz")
    assert 'column rx [mm]: "no angle\'s unit"' in shell.refused(*call)


def test_half_an_orientation_is_asked_for_and_no_marker(shell: Shell) -> None:
    Path("log.csv").write_text(line("px py pz qx qy qz", POSE[:, :6]))
    said = shell.refused("import-data", "log.csv", "--units", "m")
    assert "missing for qx, qy, qz" in said
    Path("log.csv").write_text(line("x y z tool_qx tool_qy tool_qz tool_qw", POSE))
    assert shell("import-data", "log.csv", "--units", "m") == 0, shell.err  # one pose, two headings
    assert "qw" in pd.read_csv("samples.csv")


def test_left_and_right_markers_are_markers(shell: Shell) -> None:
    for names in ("L_x L_y L_z R_x R_y R_z", "L x|L y|L z|R x|R y|R z"):
        Path("log.csv").write_text(line(names, POSE[:, :6]))
        assert shell("import-data", "log.csv", "--units", "m") == 0, shell.err
        assert pd.read_csv("samples.csv")["marker"].tolist() == ["L", "R"] * 2


def test_no_orientation_is_left_where_none_is_wanted(shell: Shell) -> None:
    """Also by the mapping of an earlier file."""
    Path("log.csv").write_text(line("x y z qx qy qz qw", POSE))
    none = ("import-data", "log.csv", "--units", "m", "--rotation", "none")
    assert shell(*none) == 0, shell.err
    assert "left out: qx, qy, qz, qw" in shell.err
    assert "qw" not in pd.read_csv("samples.csv")
    like = ("--like", "samples.mapping.yaml", "-o", "again.csv")
    assert shell("import-data", "log.csv", *like) == 0, shell.err
    assert Path("again.csv").read_text() == Path("samples.csv").read_text()


def test_two_ways_of_writing_one_orientation(shell: Shell) -> None:
    """The fuller one is read; two of the same form are asked for."""
    turn = Turn.from_quat(POSE[:, 3:])
    both = np.hstack([POSE, turn.as_euler("xyz")])
    Path("log.csv").write_text(line("x y z qx qy qz qw roll pitch yaw", both))
    assert shell("import-data", "log.csv", "--units", "m") == 0, shell.err
    assert "left out: roll, pitch, yaw" in shell.err
    twice = np.hstack([POSE, POSE[:, 3:]])
    Path("log.csv").write_text(line("x y z qx qy qz qw quat_x quat_y quat_z quat_w", twice))
    assert "missing for qx, qy, qz, qw, quat_x" in shell.refused(
        "import-data", "log.csv", "--units", "m"
    )


def test_markers_orientations_in_several_forms_are_refused(shell: Shell) -> None:
    names = "M1 x|M1 y|M1 z|M1 qx|M1 qy|M1 qz|M1 qw|M2 x|M2 y|M2 z|M2 rv_x|M2 rv_y|M2 rv_z"
    Path("log.csv").write_text(line(names, np.hstack([POSE, POSE[:, :6]])))
    call = ("import-data", "log.csv", "--units", "m")
    assert "one form for all markers" in shell.refused(*call)
    assert shell(*call, "--rotation", "none") == 0, shell.err
    assert list(pd.read_csv("samples.csv"))[-4:] == [*"xyz", "marker"]
    mixed = "M1 x [mm]|M1 y|M1 z|M2 x|M2 y|M2 z"
    Path("log.csv").write_text(line(mixed, POSE[:, :6]))
    assert "units: 'M1 x [mm], M2 x'; allowed: one for all markers" in shell.refused(*call)
    names = "M1 x|M1 y|M1 z|M2 x|M2 y|M2 z|M2 qx|M2 qy|M2 qz|M2 qw"  # the first has none
    Path("log.csv").write_text(line(names, np.hstack([POSE[:, :3], POSE])))
    assert shell(*call) == 0, shell.err
    made = pd.read_csv("samples.csv")
    assert made["qy"].tolist()[1::2] == pytest.approx(POSE[:, 4]) and made["qy"][::2].isna().all()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda m: m * 1.1, "row 1: nine numbers that are no rotation"),
        (lambda m: m * np.where(np.arange(9) < 3, -1, 1), "row 1: nine numbers"),  # mirrored
        (lambda m: np.where(np.eye(2, 9, -1, dtype=bool), np.nan, m), "row 2: partly blank"),
    ],
)  # fmt: skip
def test_nine_numbers_must_be_a_rotation(
    change: Callable[[np.ndarray], np.ndarray], said: str, shell: Shell
) -> None:
    values = change(Turn.from_quat(POSE[:, 3:]).as_matrix().reshape(-1, 9))
    names = "x y z R00 R01 R02 R10 R11 R12 R20 R21 R22"
    Path("log.csv").write_text(line(names, np.hstack([POSE[:, :3], values])))
    assert said in shell.refused("import-data", "log.csv", "--units", "m")


# ------------------------------------------------------------------ several bodies


def test_the_orientation_is_that_of_the_chosen_body(shell: Shell) -> None:
    parts = [*(f"Position {a}" for a in "XYZ"), *(f"Rotation {a}" for a in "XYZW")]
    bodies = [f"{body} {part}" for body in ("base", "tool") for part in parts]
    turned = POSE.copy()
    turned[:, 3:] = Turn.from_quat(POSE[:, 3:]).inv().as_quat()
    turned[:, :3] += 1
    Path("log.csv").write_text(line("|".join(bodies), np.hstack([POSE, turned])))
    assert "choose it with --map" in shell.refused("import-data", "log.csv", "--units", "m")
    bodies += [*"xyz"]  # a marker without a heading has not the orientation of another
    Path("log.csv").write_text(line("|".join(bodies), np.hstack([POSE, turned, POSE[:, :3] + 2])))
    assert shell("import-data", "log.csv", "--units", "m") == 0, shell.err
    assert "qw" not in pd.read_csv("samples.csv")
    for body, expected in (("base", POSE), ("tool", turned)):
        mapped = ",".join(f"{body} Position {a}={a.lower()}" for a in "XYZ")
        assert shell("import-data", "log.csv", "--units", "m", "--map", mapped, "--force") == 0
        made = pd.read_csv("samples.csv")[[*"xyz", "qx", "qy", "qz", "qw"]].to_numpy()
        made[:, 3:] *= np.sign(made[:, 6:]) * np.sign(expected[:, 6:])
        np.testing.assert_allclose(made, expected, atol=1e-12)


# ------------------------------------------------------------------ what the rows say


def of_an_arm(names: str, values: Callable[[Turn], np.ndarray]) -> str:
    """A table of 40 poses of the arm with a tool anyhow on it, seen by a tracker anywhere."""
    rng = np.random.default_rng(3)
    q = ARM.lower + rng.random((40, ARM.n)) * (ARM.upper - ARM.lower)
    pose, base = Model(ARM).pose(q), Turn.from_euler("xyz", [0.3, -0.5, 2.0])
    turns = base * Turn.from_matrix(pose[:, :3, :3]) * Turn.from_euler("zx", [0.7, 1.1])
    xyz = base.apply(pose[:, :3, 3]) + np.array([1.0, -2.0, 0.5]) + rng.normal(0, 1e-4, (40, 3))
    table = np.hstack([q, xyz, values(turns)])
    head = ",".join(["q1_rad", "q2_rad", "q3_m", "q4_rad", "tx", "ty", "tz", *split(names)])
    return "\n".join([head, *(",".join(repr(float(v)) for v in row) for row in table)])


WRITTEN: tuple[tuple[str, Callable[[Turn], np.ndarray], str], ...] = (
    ("Q0 Q1 Q2 Q3", lambda t: t.as_quat(scalar_first=True), "wxyz"),
    ("Q0 Q1 Q2 Q3", quaternion, "xyzw"),
    ("Q0 Q1 Q2 Q3", lambda t: t.inv().as_quat(), "-xyzw"),
    ("rx ry rz", Turn.as_rotvec, "rotvec"),
    ("rx ry rz", lambda t: t.inv().as_rotvec(), "-rotvec"),
    ("roll pitch yaw", angles("xyz"), "xyz"),
    ("A B C", angles("ZYX"), "ZYX"),
    ("A B C", angles("ZYZ"), "ZYZ"),
)


@pytest.mark.parametrize(("names", "values", "convention"), WRITTEN)
def test_the_rows_say_the_convention(
    names: str, values: Callable[[Turn], np.ndarray], convention: str, work: Path, shell: Shell
) -> None:
    Path("log.csv").write_text(of_an_arm(names, values))
    call = ("import-data", "log.csv", "--units", "m,rad", "--arm", work / "arm.yaml", "--rotation")
    columns = ",".join(split(names))
    fit = f"the rows fit {convention}:{columns} (it leaves "
    assert fit in shell.refused(*call[:-1])
    assert shell(*call, f"{convention}:{columns}") == 0, shell.err
    other = convention[1:] if convention[0] == "-" else f"-{convention}"
    assert fit in shell.refused(*call, f"{other}:{columns}", "-o", "other.csv")
    assert not Path("other.csv").exists()


def test_names_that_say_a_convention_are_held_against_the_rows(work: Path, shell: Shell) -> None:
    for names, values, fit in (
        ("qx qy qz qw", lambda t: t.inv().as_quat(), "-xyzw:qx,qy,qz,qw"),
        ("qx qy qz qw", lambda t: t.as_quat(scalar_first=True), "wxyz:qx,qy,qz,qw"),
        ("R00 R01 R02 R10 R11 R12 R20 R21 R22", by_columns, "-matrix:R00,R01"),
    ):
        Path("log.csv").write_text(of_an_arm(names, values))
        call = ("import-data", "log.csv", "--units", "m", "--force")
        assert f"the rows fit {fit}" in shell.refused(*call, "--arm", work / "arm.yaml")
        assert shell(*call) == 0, shell.err  # without an arm nobody can know


def test_rows_of_no_convention(work: Path, shell: Shell) -> None:
    """Numbers of another body are not the arm's in any convention: nothing is claimed of them."""
    rng = np.random.default_rng(0)
    call = ("import-data", "log.csv", "--units", "m,rad", "--arm", work / "arm.yaml")
    Path("log.csv").write_text(
        of_an_arm("rx ry rz", lambda t: Turn.random(40, rng=rng).as_rotvec())
    )
    assert "no convention fits (the best leaves " in shell.refused(*call)
    assert shell(*call, "--rotation", "rotvec:rx,ry,rz") == 0, shell.err  # calibrate refuses them
    text = of_an_arm("rx ry rz", Turn.as_rotvec).split("\n")
    Path("log.csv").write_text("\n".join(text[:10]))  # too few rows to tell
    assert "the rows fit" not in shell.refused(*call)
    Path("log.csv").write_text("\n".join(text[:11]))
    assert "the rows fit rotvec:" in shell.refused(*call)


@pytest.mark.parametrize("heads", ["A [deg]|B [deg]|C [deg]", "A|B|C"])
def test_targets_in_the_users_table_keep_their_orientation(heads: str, shell: Shell) -> None:
    """It was left free without a word."""
    turn = Turn.from_quat(POSE[:, 3:])
    rows = np.hstack([POSE[:, :3], turn.as_euler("ZYX", degrees=True)])
    Path("log.csv").write_text(line("x|y|z|A [deg]|B [deg]|C [deg]", rows))
    call = ("import-data", "log.csv", "--units", "m,deg", "--rotation", "ZYX:A,B,C")
    assert shell(*call) == 0, shell.err
    form = Like(Path("samples.mapping.yaml"))

    def read(names: str, cells: np.ndarray) -> Targets:
        table = pd.DataFrame(cells, columns=names.split("|"))
        table.to_csv("targets.csv", index=False)
        return read_targets("targets.csv", form.read)

    rows[1, 3:] = np.nan  # free
    found = read(f"x|y|z|{heads}", rows)
    assert np.isnan(found.quaternion).all(axis=1).tolist() == [False, True]
    assert (Turn.from_quat(found.quaternion[0]).inv() * turn[0]).magnitude() < 1e-7
    assert not found.columns
    assert np.isnan(read("x|y|z", rows[:, :3]).quaternion).all()
    with pytest.raises(InputError, match=r"targets\.csv: orientation: 'C'"):
        read("x|y|z|A|B", rows[:, :5])
    rows[0, 4] = np.nan
    with pytest.raises(InputError, match="orientation: 'row 1: partly blank'"):
        read(f"x|y|z|{heads}", rows)
