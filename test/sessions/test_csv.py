"""Sessions as CSV: what comes back, and what is refused with which words."""

import csv
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from small_arm import ARM, measured

from longarm_comp.core import files
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.admission import admit
from longarm_comp.core.data.session import Session
from longarm_comp.core.errors import InputError
from longarm_comp.sessions.csv import read_csv, write_csv
from longarm_comp.sessions.read import read_session
from longarm_comp.sessions.table import nearest
from studies.real_sessions import declared_arm

HEADER = "index,approach,q1,q2,q3,q4,x,y,z"
ROW = "0,1,0.1,0.5,0.05,0.2,0.4,0.1,0.3"
SECOND = "1,,0.2,0.6,0.02,0.1,0.4,0.2,0.3"


def written(path: Path, *lines: str) -> Path:
    path.write_text("\n".join(lines) + "\n")
    return path


def refusal(path: Path) -> str:
    with pytest.raises(InputError) as caught:
        read_csv(path, ARM)
    message = str(caught.value)
    assert message.startswith(str(path))
    assert "\n" not in message
    return message


# ------------------------------------------------------------------ what comes back


@pytest.mark.parametrize("case", ["paper_twin_300", "none_mid_300", "one_backlash_300"])
def test_reads_the_twin_as_a_plain_reader_does(case: str, data_dir: Path) -> None:
    arm = Arm.load(data_dir / "twin" / "arm.yaml")
    path = data_dir / "twin" / case / "samples.csv"
    session = read_csv(path, arm)
    with path.open() as file:
        rows = list(csv.DictReader(file))
    assert len(session) == len(rows)
    assert session.q[17].tolist() == [float(rows[17][f"q{j}"]) for j in range(1, 8)]
    assert session.index.tolist() == [int(row["index"]) for row in rows]
    lost = [row["x"] == "" for row in rows]
    assert (~session.seen).tolist() == lost
    assert any(lost)
    assert session.columns["temperature_c"][3] == float(rows[3]["temperature_c"])
    for i, row in enumerate(rows):
        if row["approach"]:
            assert (session.approach[i] == int(row["approach"])).all()
    blank = [i for i, row in enumerate(rows) if not row["approach"] and i]
    after_gap = [i for i in blank if int(rows[i]["index"]) != int(rows[i - 1]["index"]) + 1]
    assert all(not session.approach[i].any() for i in after_gap)
    followed = [i for i in blank if i not in after_gap]
    step = np.sign(session.q[followed] - session.q[np.array(followed) - 1])
    assert (session.approach[followed][step != 0] == step[step != 0]).all()


@pytest.mark.parametrize(("name", "rows"), [("wam", 236), ("ur5", 1020)])
def test_reads_public_measurements_as_they_are(name: str, rows: int, data_dir: Path) -> None:
    arm = declared_arm(name)
    session = read_csv(data_dir / "wam_ur5" / f"{name}_samples.csv", arm)
    assert len(session) == rows
    assert len(session.where("set", "random")) == 20
    target = np.stack([session.columns[f"target_{c}"] for c in "xyz"], -1)
    difference = np.stack([session.columns[f"dif_{c}"] for c in "xyz"], -1)
    assert np.allclose(session.xyz, target + difference, atol=1e-6)
    # joints 7 of the WAM and 6 of the UR5 turn about a line through the target
    harmless = ("gross outliers", "its sign does not show")
    found = admit(session, arm).findings
    assert all(any(words in finding.message for words in harmless) for finding in found)


def test_only_joints_and_positions_are_required(tmp_path: Path) -> None:
    path = written(tmp_path / "s.csv", "x,y,z,q4,q3,q2,q1", "1,2,3,4,5,6,7")
    session = read_csv(path, ARM)
    assert session.q.tolist() == [[7, 6, 5, 4]]
    assert session.xyz.tolist() == [[1, 2, 3]]
    assert session.index.tolist() == [0]
    assert session.repeat_id.tolist() == [-1]
    assert session.sigma is None
    assert not session.columns
    assert not session.labels


def test_other_columns_are_context_and_text_is_a_label(tmp_path: Path) -> None:
    path = written(
        tmp_path / "s.csv",
        HEADER + ",humidity,incl_4_x,operator,group,sigma_x,sigma_y,sigma_z,empty",
        ROW + ",40,0.01,ann,1,0.001,0.002,0.003,",
    )
    session = read_csv(path, ARM)
    assert {k: v.tolist() for k, v in session.columns.items()} == {
        "humidity": [40.0],
        "incl_4_x": [0.01],
    }
    assert {k: v.tolist() for k, v in session.labels.items()} == {
        "operator": ["ann"],
        "group": ["1"],
    }
    assert session.sigma is not None
    assert session.sigma.tolist() == [[0.001, 0.002, 0.003]]


def test_digits_with_a_line_between_them_are_no_number(tmp_path: Path) -> None:
    """Python reads 1_5 as 15."""
    path = written(tmp_path / "s.csv", f"{HEADER},station", f"{ROW},1_1", f"{SECOND},1_2")
    assert read_csv(path, ARM).labels["station"].tolist() == ["1_1", "1_2"]
    with pytest.raises(InputError, match="line 2, x: '1_5'"):
        read_csv(written(tmp_path / "x.csv", "q1,q2,q3,q4,x,y,z", "0,0,0,0,1_5,0,0"), ARM)


def test_times_count_from_the_first_row_by_any_clock(tmp_path: Path) -> None:
    rows = [f"{row},{since}" for row, since in ((ROW, 1.7e9), (SECOND, 1.7e9 + 30.5))]
    session = read_csv(written(tmp_path / "a.csv", HEADER + ",t_s", *rows), ARM)
    assert np.array_equal(session.context().column("t_s"), [0.0, 30.5])
    assert np.array_equal(session.take([1]).context().column("t_s"), [30.5])
    later = read_csv(written(tmp_path / "b.csv", HEADER + ",t_s", f"{ROW},1700000100"), ARM)
    assert np.array_equal(later.context().column("t_s"), [0.0])
    assert np.array_equal(later.on_clock_of(session).context().column("t_s"), [100.0])


def test_covariance_becomes_sigma(tmp_path: Path) -> None:
    header = HEADER + ",cov_xx,cov_yy,cov_zz,cov_xy"
    session = read_csv(written(tmp_path / "s.csv", header, ROW + ",1e-6,4e-6,9e-6,1e-7"), ARM)
    assert session.sigma is not None
    assert np.allclose(session.sigma, [[1e-3, 2e-3, 3e-3]])
    assert session.columns["cov_xy"].tolist() == [1e-7]


def test_points_touched_once_each_are_tied_by_the_distance_beside(tmp_path: Path) -> None:
    (tmp_path / "touches.yaml").write_text("touch_distances: [[a, b, 0.3, 0.001]]\n")
    lines = "q1,q2,q3,q4,touch", "0.1,0.5,0.05,0.2,a", "0.2,0.4,0.02,0.1,b"
    assert read_session(written(tmp_path / "s.csv", *lines), ARM).seen.all()


def test_bom_blank_lines_and_spaces_do_no_harm(tmp_path: Path) -> None:
    path = tmp_path / "s.csv"
    path.write_bytes(b"\xef\xbb\xbf" + f"{HEADER}\r\n\r\n{ROW.replace(',', ' , ')}\r\n".encode())
    assert len(read_csv(path, ARM)) == 1


@settings(
    max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(seed=st.integers(0, 2**31), rows=st.integers(1, 30))
def test_round_trip_is_exact(seed: int, rows: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(seed)
    base = measured(rows, rng)
    xyz = base.xyz.copy()
    xyz[rng.random(rows) < 0.2] = np.nan
    q = base.q.copy()
    for k, joint in np.argwhere(rng.random(q[1:].shape) < 0.2):
        q[k + 1, joint] = q[k, joint]  # it stands, and keeps its side
    session = Session.record(
        q,
        xyz,
        index=np.cumsum(rng.integers(1, 3, rows)),
        approach=rng.integers(-1, 2, rows if seed % 2 else (rows, 4)),
        repeat_id=rng.integers(-1, 3, rows),
        sigma=rng.random((rows, 3)) + 1e-4 if seed % 3 else None,
        columns={"t_s": np.sort(rng.random(rows)), "humidity": rng.random(rows)},
        labels={"group": rng.choice(["a", "b"], rows)},
    )
    if seed % 5 == 0:
        session = session.take(rng.permutation(rows)[: max(1, rows // 2)])
    write_csv(session, tmp_path / "s.csv")
    assert read_csv(tmp_path / "s.csv", ARM).hash == session.hash


# ------------------------------------------------------------------ what is refused


@pytest.mark.parametrize(
    ("header", "row", "words"),
    [
        ("q1,q2,q4,x,y,z", "0,0,0,0,0,0", "column q3: 'missing'"),
        ("q1,q2,q3,q4,role", "0,0,0,0,a", "column x: 'missing'"),
        (HEADER + ",qx,qy,qz", ROW + ",0,0,0", "column qw: 'missing'"),
        (HEADER + ",qx,qy,qz,qw", ROW + ",0,0,0,", "line 2, qw: ''"),
        (HEADER + ",qx,qy,qz,qw", ROW + ",0,0,0,2", "x, y, z, w of length 1"),
        (HEADER + ",sigma_rot", ROW + ",0.1", "column qx: 'missing"),
        (HEADER + ",distance,anchor", ROW + ",-0.5,a", "above 0 (m)"),
        (HEADER + ",distance,anchor", ROW + ",0.5,", "line 2, anchor: 'blank'"),
        ("q1,q2,q3,q4,X,y,z", "0,0,0,0,0,0,0", "column x: 'missing (is it X?)'"),
        (HEADER + ",q5", ROW + ",0", "column q5: 'unknown'; allowed: q1..q4 of arm small"),
        (HEADER + ",temprature_c", ROW + ",20", "close to temperature_c"),
        (HEADER + ",Temperature", ROW + ",20", "close to temperature_c"),
        (HEADER + ",payload", ROW + ",0.2", "close to payload_kg"),
        (HEADER + ",payload_gk", ROW + ",0.2", "close to payload_kg"),
        (HEADER + ",T_S", ROW + ",20", "close to t_s"),
        (HEADER + ",repeatid", ROW + ",1", "close to repeat_id"),
        (HEADER + ",x", ROW + ",1", "column x: 'twice'"),
        (HEADER + ",", ROW + ",1", "header, column 10"),
        (HEADER, ROW.replace("0.05", "nan"), "line 2, q3: 'nan'"),
        (HEADER, ROW.replace("0.05", "inf"), "line 2, q3: 'inf'"),
        (HEADER, ROW.replace("0.05", ""), "line 2, q3: ''"),
        (HEADER, ROW.replace("0.05", "abc"), "line 2, q3: 'abc'"),
        (HEADER, ROW.replace("0.4", "NaN"), "line 2, x: 'NaN'"),
        (HEADER, ROW.replace("0.4", "-inf"), "line 2, x: '-inf'"),
        (HEADER, ROW.replace("0,1,", "0,2,"), "line 2, approach: '2'"),
        (HEADER, ROW.replace("0,1,", "0.5,1,"), "line 2, index: '0.5'"),
        (HEADER, ROW + ",7", "line 2: '10 cells'; allowed: 9 cells"),
        (HEADER, ROW[:-4], "line 2: '8 cells'"),
        (HEADER + ",sigma_x,sigma_y,sigma_z", ROW + ",0,1,1", "line 2, sigma_x: '0'"),
        (HEADER + ",sigma_x", ROW + ",0.1", "column sigma_y: 'missing"),
        (HEADER + ",humidity", ROW + ",inf", "line 2, humidity: 'inf'"),
    ],
)
def test_bad_cells_and_columns(header: str, row: str, words: str, tmp_path: Path) -> None:
    assert words in refusal(written(tmp_path / "s.csv", header, row))


def test_a_number_missing_in_some_rows_is_refused(tmp_path: Path) -> None:
    header = HEADER + ",temperature_c"
    path = written(tmp_path / "s.csv", header, ROW + ",20", SECOND + ",")
    assert "line 3, temperature_c: ''" in refusal(path)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "'empty'"),
        (b"\n\n", "'empty'"),
        (HEADER.encode() + b"\n", "rows: 0; allowed: at least one row"),
        (HEADER.replace(",", ";").encode() + b"\n1;2", "separated by commas"),
        (b"\xff\xfe\x00q1", "UTF-8"),
        (HEADER.encode() + b'\n"0,1', "comma-separated text"),
    ],
)
def test_what_is_no_table(content: bytes, words: str, tmp_path: Path) -> None:
    path = tmp_path / "s.csv"
    path.write_bytes(content)
    assert words in refusal(path)


@settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_whatever_is_in_the_file_it_is_read_or_refused(data: st.DataObject, tmp_path: Path) -> None:
    good = "\n".join([HEADER, ROW, SECOND, ""]).encode()
    start = data.draw(st.integers(0, len(good)))
    stop = data.draw(st.integers(start, min(len(good), start + 6)))
    noise = data.draw(
        st.binary(max_size=6) | st.text('0123456789.,-eEnaif\n"q', max_size=8).map(str.encode)
    )
    path = tmp_path / "s.csv"
    path.write_bytes(good[:start] + noise + good[stop:])
    try:
        session = read_csv(path, ARM)
    except InputError:
        return
    assert np.isfinite(session.q).all()
    assert np.isfinite(session.xyz[session.seen]).any(axis=1).all()
    assert np.isin(session.approach, (-1, 0, 1)).all()


def test_no_such_file(tmp_path: Path) -> None:
    assert "No such file" in refusal(tmp_path / "none.csv")


# ------------------------------------------------------------------ writing


def test_read_only_folder(tmp_path: Path, rng: np.random.Generator) -> None:
    if os.geteuid() == 0:
        blocked = Path("/proc/longarm/s.csv")  # root writes anywhere else
    else:
        tmp_path.chmod(0o500)
        blocked = tmp_path / "s.csv"
    with pytest.raises(InputError, match="output folder"):
        write_csv(measured(3, rng), blocked)


def test_interrupted_write_leaves_the_old_file(
    tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "s.csv"
    session = measured(3, rng)
    write_csv(session, path)

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(files, "_publish", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_csv(measured(50, rng), path)
    assert [p.name for p in tmp_path.iterdir()] == ["s.csv"]
    assert read_csv(path, ARM).hash == session.hash


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("run_wp_q1", "run_up_q1"),  # one letter of seven
        ("payloda_gk", "payload_kg"),  # two of nine
        ("pxyxoxd_kg", None),  # three
        ("anchoor", "anchor"),
        ("read", None),  # two letters short
        ("rxad_qx", None),  # two of six
        ("x1", None),
    ],
)
def test_a_name_is_taken_for_another_one_where_a_letter_is_wrong(
    name: str, meant: str | None
) -> None:
    assert nearest(name, ("x", "run_up_q1", "read_q1", "payload_kg", "anchor")) == meant


@pytest.mark.parametrize(
    ("header", "words"),
    [
        ("x_mm,y,z", "column x: 'missing (is it x_mm?)'"),
        ("x [mm],y,z", "column x: 'missing (is it x [mm]?)'"),
        ("x,y,zz", "column z: 'missing (is it zz?)'"),
        ("x,y,z1", "column z: 'missing (is it z1?)'"),
        ("x,pos_y,z", "column y: 'missing (is it pos_y?)'"),
        ("x,y,pz", "column z: 'missing (is it pz?)'"),
        ("x,y,z,x_mm", "x_mm: 'unknown, close to x'; allowed: x, or another name; other units"),
        ("x,y,z,payload_g", "unknown, close to payload_kg"),
        ("x,y,z,t_ms", "unknown, close to t_s"),
        ("x,y,z,temperature_f", "unknown, close to temperature_c"),
        ("x,y,z,q1_deg", "unknown, close to q1"),
    ],
)
def test_no_coordinate_is_lost_by_its_name(header: str, words: str, tmp_path: Path) -> None:
    row = ",".join(["0"] * (4 + header.count(",") + 1))
    assert words in refusal(written(tmp_path / "s.csv", f"q1,q2,q3,q4,{header}", row))


def test_a_coordinate_that_nobody_measured_is_said(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    session = measured(40, rng, columns={"zone_number": np.zeros(40), "size": np.zeros(40)})
    write_csv(session, tmp_path / "s.csv")
    lines = (tmp_path / "s.csv").read_text().splitlines()
    at = lines[0].split(",").index("z")
    rows = [line.split(",") for line in lines]
    text = "\n".join(",".join(row[:at] + row[at + 1 :]) for row in rows)
    (tmp_path / "s.csv").write_text(text)
    found = admit(read_csv(tmp_path / "s.csv", ARM), ARM).findings
    assert [str(f) for f in found if f.field == "z"] == ["z: measured in no row"]
    whole = admit(measured(40, rng), ARM).findings
    assert not [f for f in whole if f.field in ("x", "y", "z")]


def test_an_inclinometer_beside_two_coordinates_is_none_of_them(tmp_path: Path) -> None:
    lines = ("q1,q2,q3,q4,y,z,incl_0_x,incl_0_y", "0,0,0,0,1,2,0,0")
    session = read_csv(written(tmp_path / "s.csv", *lines), ARM)
    assert np.isnan(session.xyz[:, 0]).all() and "incl_0_x" in session.columns
