"""Tables as instruments write them: headers, other files, and rows of two clocks."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from cli_shell import Shell
from pose_tables import POSE, line

# ------------------------------------------------------------------ headers


def test_a_header_may_be_a_remark_or_missing(shell: Shell) -> None:
    table = line("x y z", POSE[:, :3])
    Path("log.csv").write_text(table)
    assert shell("import-data", "log.csv", "--units", "m") == 0, shell.err
    plain = Path("samples.csv").read_text()
    head, rest = table.split("\n", 1)
    for told in (f"# {head}\n{rest}", f"#{head}\n{rest}", f"% made by hand\n%{head}\n{rest}"):
        Path("log.csv").write_text(told)
        assert shell("import-data", "log.csv", "--units", "m", "--force") == 0, shell.err
        assert Path("samples.csv").read_text() == plain
    Path("log.csv").write_text(rest)
    call = ("import-data", "log.csv", "--units", "m,deg", "--force")
    assert "or --columns" in shell.refused(*call)
    assert "--columns: '2 names'; allowed: 7 names" in shell.refused(*call, "--columns", "q1,q2")
    named = ("--columns", "q1,q2,q3_m,q4,x,y,z")
    assert shell(*call, *named) == 0, shell.err
    assert Path("samples.csv").read_text() == plain
    like = ("import-data", "log.csv", "--like", "samples.mapping.yaml", "-o", "again.csv")
    assert shell(*like) == 0, shell.err
    assert Path("again.csv").read_text() == plain
    row = rest.split("\n")[0]
    Path("log.csv").write_text(f"{head}\n{row}\n# {row}\n{row}\n")  # a row that was taken out
    call = ("import-data", "log.csv", "--units", "m", "-o", "out.csv")
    assert "line 3: '# 1,20," in shell.refused(*call)
    Path("log.csv").write_text(f"{head}\n{row}\n#{row}\n")
    assert "line 3, q1_deg: '#1'" in shell.refused(*call)
    Path("log.csv").write_text("#,q1_deg,x_m,y_m,z_m\n7,1,2,3,4\n")  # a name: numbers of rows
    assert shell("import-data", "log.csv", "-o", "third.csv") == 0, shell.err
    assert "left out: #" in shell.err


MOTION = """Format Version,1.23,Take Name,Take,Rotation Type,Quaternion

,Type,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,,
,Name,tool,tool,tool,tool,tool,tool,tool,,
,ID,{0},{0},{0},{0},{0},{0},{0},,
,,Rotation,Rotation,Rotation,Rotation,Position,Position,Position,,
Frame,Time (Seconds),X,Y,Z,W,X,Y,Z,A1_deg,A2_deg
0,0.0,0,0,0.6,0.8,1,2,3,10,20
1,0.5,0,0.6,0,0.8,4,5,6,11,21
"""


@pytest.mark.parametrize("number", ["506381AA", "1", "2003"])
def test_a_line_of_ids_is_a_heading(number: str, shell: Shell) -> None:
    Path("log.csv").write_text(MOTION.format(number))
    assert shell("import-data", "log.csv", "--units", "m") == 0, shell.err
    made = pd.read_csv("samples.csv")
    np.testing.assert_allclose(made[[*"xyz"]], [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_allclose(made[["qx", "qy", "qz", "qw"]], [[0, 0, 0.6, 0.8], [0, 0.6, 0, 0.8]])
    assert made["t_s"].tolist() == [0, 0.5]
    mapping = Path("samples.mapping.yaml").read_text()
    assert f"from: Rigid Body tool {number} Position X" in mapping


def test_no_row_of_numbers_is_lost_above_a_header(shell: Shell) -> None:
    head, row = "Point,A1_deg,x_m,y_m,z_m", "P7,1,2,3,4"
    for above in (row, "P7,1.5,2,3,4", "7,1,2,3,4"):
        for below in (head, "Point,A1_deg,u_m,v_m,w_m"):
            if above == row and below != head:
                continue  # ids
            Path("log.csv").write_text(f"{head}\n{above}\n{below}\n{row}\n")
            assert "line 2: 'numbers above a header'" in shell.refused("import-data", "log.csv")
    Path("log.csv").write_text(f"{head}\n{row}\nP8,lost,,,\n{row}\n")  # no line of names
    assert "line 3, A1_deg: 'lost'" in shell.refused("import-data", "log.csv")


def test_joints_that_count_from_0_are_no_quaternion(shell: Shell) -> None:
    Path("log.csv").write_text("q0_deg,q1_deg,q2_deg,q3_deg,x_m,y_m,z_m\n1,2,3,4,5,6,7\n")
    assert "joints: 'q0, q1, q2, q3'" in shell.refused("import-data", "log.csv")
    Path("log.csv").write_text("q0,q1,q2,q3,x_m,y_m,z_m\n1,2,3,4,5,6,7\n")
    call = ("import-data", "log.csv", "--units", "deg")
    assert "joints: 'q0, q1, q2, q3'" in shell.refused(*call)
    assert shell(*call, "--map", "q0=q1,q1=q2,q2=q3,q3=q4") == 0, shell.err
    assert "qw" not in pd.read_csv("samples.csv")


@pytest.mark.parametrize(
    ("name", "raw", "said"),
    [
        ("log.xls", b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1", "XLSX: save it as such"),
        ("log.json", b'[{"q1": 1, "x": 2}]', "file: 'JSON'"),
        ("log.csv", b' {"q1": [1, 2]}', "pandas.read_json"),
        ("log.mat", b"MATLAB 5.0 MAT-file, Platform: GLNXA64" + bytes(200), "writematrix"),
        ("log.mat", b"\x89HDF\r\n\x1a\n" + bytes(50), "file: 'MAT'"),
        ("log.npy", b"\x93NUMPY\x01\x00v\x00", "numpy.savetxt"),
        ("log.mcap", b"\x89MCAP0\r\n", "longarm bag to-csv"),
        ("log.db3", b"SQLite format 3\x00", "longarm bag to-csv"),
    ],
)
def test_other_files_are_refused_with_the_export_to_make(
    name: str, raw: bytes, said: str, shell: Shell
) -> None:
    Path(name).write_bytes(raw)
    assert said in shell.refused("import-data", name)


# ------------------------------------------------------------------ two clocks


def clocks(one: list[float], two: list[float], names: tuple[str, str]) -> None:
    head, other = names
    Path("arm.csv").write_text(
        "".join([f"{head},A1_deg\n", *(f"{t!r},{k}\n" for k, t in enumerate(one))])
    )
    Path("seen.csv").write_text(
        "".join([f"{other},x_m,y_m,z_m\n", *(f"{t!r},{k},0,0\n" for k, t in enumerate(two))])
    )


def test_numbers_of_two_clocks_are_joined_by_the_nearest(shell: Shell) -> None:
    start = 1785175389.65
    one = [start + 2.0 * k for k in range(6)]
    two = [t + d for t, d in zip(one, [0.01, -0.02, 0.015, 0, 0.4, 0.02], strict=True)]
    del two[3]
    clocks(one, two[::-1], ("Timestamp", "Timestamp"))
    call = ("import-data", "arm.csv", "seen.csv", "--join")
    assert shell(*call, "Timestamp", "--units", "s") == 0, shell.err
    made = pd.read_csv("samples.csv")
    np.testing.assert_allclose(np.degrees(made["q1"]), [0, 1, 2, 4, 5])
    assert made["x"].tolist() == [4, 3, 2, 1, 0]
    assert "nearest Timestamp within 1; the farthest are 0.4 apart" in shell.err
    assert f"arm.csv: no partner of Timestamp {one[3]!r}" in shell.err


def test_units_of_two_clocks(shell: Shell) -> None:
    clocks([0.0, 1.0, 2.0], [10.0, 1010.0, 1990.0], ("Time [s]", "Time [ms]"))
    call = ("import-data", "arm.csv", "seen.csv", "--force", "--join")
    assert shell(*call, "Time") == 0, shell.err
    assert pd.read_csv("samples.csv")["x"].tolist() == [0, 1, 2]
    clocks([0.0, 1.0], [0.0, 1.0], ("Time [s]", "Time"))
    assert "seen.csv: --join Time: 'no unit'" in shell.refused(*call, "Time")
    clocks([0.0, 1.0], [50.0, 51.0], ("t_s", "t_s"))
    assert "times of one clock, within 0.5" in shell.refused(*call, "t_s")


def test_a_fast_tracker_beside_slow_joints_and_rows_of_one_time(shell: Shell) -> None:
    fast = [0.01 * k for k in range(1000)]
    clocks([1.234, 5.002, 7.777], fast, ("Time", "Time"))
    call = ("import-data", "arm.csv", "seen.csv", "--force", "--units", "s", "--join", "Time")
    assert shell(*call) == 0, shell.err
    assert pd.read_csv("samples.csv")["x"].tolist() == [123, 500, 778]
    clocks([1.0, 1.0, 2.0], [1.1, 1.9], ("Time", "Time"))
    assert shell(*call) == 0, shell.err
    assert pd.read_csv("samples.csv")["x"].tolist() == [0, 0, 1]


def test_numbers_that_are_no_times_are_joined_by_their_like_only(shell: Shell) -> None:
    clocks([10.0, 20.0, 40.0], [12.0, 30.0, 40.0], ("Point", "Point"))
    assert shell("import-data", "arm.csv", "seen.csv", "--join", "Point") == 0, shell.err
    assert pd.read_csv("samples.csv")["x"].tolist() == [2]
