"""`longarm import-data`: tables of other programs become sessions, or one line says what lacks."""

import csv
from pathlib import Path

import numpy as np
import pytest
import yaml
from cli_shell import Shell
from openpyxl import Workbook
from scipy.spatial.transform import Rotation as Turn
from small_arm import ARM

from longarm_comp.core.errors import InputError
from longarm_comp.sessions.csv import read_csv
from longarm_comp.sessions.foreign.units import UNITS, Rotation, split_name

GERMAN = """Tracker export 3.1
Date: 2024-01-02

Time;Target;;;;Measured;;;Temp;Operator
;A1;A2;A3;A4;X;Y;Z;;
s;deg;deg;mm;deg;mm;mm;mm;°C;
0,0;10,5;20;50,5;3;1000,25;-3,5;200;21,5;Bo
1,5;11,5;25;60;-4;;;;21,6;Al
"""


def rows(path: str = "samples.csv") -> list[dict[str, str]]:
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def test_header_lines_semicolons_decimal_commas_and_units(shell: Shell) -> None:
    Path("log.csv").write_text(GERMAN, encoding="cp1252")
    found = shell.json("import-data", "log.csv")
    assert found["rows"] == 2 and found["left_out"] == ["Operator"]
    first, second = rows()
    assert list(first) == ["t_s", "temperature_c", "q1", "q2", "q3", "q4", "x", "y", "z"]
    expected = [0.0, 21.5, *np.radians([10.5, 20.0]), 0.0505, np.radians(3), 1.00025, -0.0035, 0.2]
    assert [float(v) for v in first.values()] == pytest.approx(expected, rel=1e-12)
    assert (second["x"], second["y"], second["z"]) == ("", "", "")
    session = read_csv("samples.csv", ARM)
    assert session.seen.tolist() == [True, False] and session.t_s is not None
    mapping = yaml.safe_load(Path("samples.mapping.yaml").read_text())
    assert mapping["decimal"] == "," and mapping["separator"] == ";"
    assert mapping["header_lines"] == [4, 5, 6]
    assert mapping["columns"]["q3"] == {"from": "Target A3 [mm]", "unit": "mm"}


def test_the_preview_says_what_was_read(shell: Shell) -> None:
    Path("log.csv").write_text("q1 [deg],q2 [deg],x_mm,y_mm,z (mm),note\n90,2,1000,2,3,a\n")
    assert shell("import-data", "log.csv") == 0
    line = next(line for line in shell.out.splitlines() if "q1 [deg]" in line)
    assert "1.571" in line and " deg " in line
    assert "left out: note" in shell.err


def test_a_workbook(shell: Shell) -> None:
    book = Workbook()
    sheet = book.active
    sheet.append(["Joint 1", "Joint 2", "tcp x", "tcp y", "tcp z", "time"])
    sheet.append(["deg", "deg", "mm", "mm", "mm", "ms"])
    sheet.append([90, 45.5, 1000, -2.25, 3, 1500])
    sheet.append([None, None, None, None, None, None])
    book.save("log.xlsx")
    assert shell("import-data", "log.xlsx") == 0, shell.err
    (row,) = rows()
    expected = [1.5, *np.radians([90, 45.5]), 1.0, -0.00225, 0.003]
    assert [float(v) for v in row.values()] == pytest.approx(expected, rel=1e-12)
    book.create_sheet("other")
    book.save("two.xlsx")
    assert "--sheet: 'missing'; allowed: one of Sheet, other" in shell.refused(
        "import-data", "two.xlsx"
    )
    assert shell("import-data", "two.xlsx", "--sheet", "Sheet") == 0
    Path("bad.xlsx").write_bytes(Path("log.xlsx").read_bytes()[:900])
    assert "bad.xlsx: workbook" in shell.refused("import-data", "bad.xlsx")


def test_units_and_names_that_are_told(shell: Shell) -> None:
    Path("log.csv").write_text("a,b,u,v,w\n90,100,1,2,3\n")
    told = ("--map", "a=q1,b=q2:mm", "--map", "u=x,v=y,w=z")
    assert shell("import-data", "log.csv", "--units", "cm,deg", *told) == 0, shell.err
    assert "q1: taken to turn" in shell.err
    (row,) = rows()
    assert [float(v) for v in row.values()] == pytest.approx([np.pi / 2, 0.1, 0.01, 0.02, 0.03])


def test_an_arm_says_which_joints_slide_and_what_they_are_called(work: Path, shell: Shell) -> None:
    data = yaml.safe_load((work / "arm.yaml").read_text())
    for joint, name in zip(
        data["joints"], ("base_yaw_joint", "lift", "slide", "wrist"), strict=True
    ):
        joint["name"] = name
    Path("arm.yaml").write_text(yaml.safe_dump(data))
    Path("log.csv").write_text("slide,Base Yaw,LIFT,wrist,X,y,z\n50,10,20,30,1,2,3\n")
    call = ("import-data", "log.csv", "--units", "mm,deg")
    assert "joints: 'none'" in shell.refused(*call)
    assert shell(*call, "--arm", "arm.yaml") == 0, shell.err
    assert "taken to turn" not in shell.err
    (row,) = rows()
    values = [float(row[f"q{j}"]) for j in range(1, 5)]
    assert values == pytest.approx([*np.radians([10, 20]), 0.05, np.radians(30)])


@pytest.mark.parametrize(
    ("convention", "values"),
    [
        ("xyzw:a,b,c,d", lambda r: r.as_quat()),
        ("wxyz:a,b,c,d", lambda r: r.as_quat()[[3, 0, 1, 2]]),
        ("-wxyz:a,b,c,d", lambda r: r.inv().as_quat()[[3, 0, 1, 2]]),
        ("xyz:a,b,c", lambda r: r.as_euler("xyz", degrees=True)),
        ("ZYX:a,b,c", lambda r: r.as_euler("ZYX", degrees=True)),
        ("zyz:a,b,c", lambda r: r.as_euler("zyz", degrees=True)),
        ("rotvec:a,b,c", lambda r: np.degrees(r.as_rotvec())),
        ("-xyz:a,b,c", lambda r: r.inv().as_euler("xyz", degrees=True)),
    ],
)
def test_orientations(convention: str, values: object, shell: Shell) -> None:
    turn = Turn.from_euler("ZYX", [40, -25, 110], degrees=True)
    numbers = [repr(float(v)) for v in values(turn)]  # type: ignore[operator]
    names = "abcd"[: len(numbers)]
    Path("log.csv").write_text(
        f"q1_deg,x_mm,y_mm,z_mm,{','.join(names)}\n1,2,3,4,{','.join(numbers)}\n"
    )
    call = ("import-data", "log.csv", "--units", "deg", "--rotation", convention)
    assert shell(*call) == 0, shell.err
    (row,) = rows()
    made = Turn.from_quat([float(row[n]) for n in ("qx", "qy", "qz", "qw")])
    assert (made.inv() * turn).magnitude() < 1e-9
    mapping = yaml.safe_load(Path("samples.mapping.yaml").read_text())
    assert mapping["rotation"] == convention


def test_the_next_file_of_the_kind_is_read_the_same_way(shell: Shell) -> None:
    Path("log.csv").write_text("a;b;u;v;w;r;p;y0\n90,5;100;1;2;3;0;0;90\n")
    told = ("--map", "a=q1:deg,b=q2:mm,u=x,v=y,w=z", "--units", "cm,deg")
    assert shell("import-data", "log.csv", *told, "--rotation", "xyz:r,p,y0") == 0, shell.err
    first = Path("samples.csv").read_text()
    like = ("import-data", "log.csv", "--like", "samples.mapping.yaml")
    assert shell(*like, "-o", "again.csv") == 0, shell.err
    assert Path("again.csv").read_text() == first
    assert shell(*like, "-o", "again.csv", "--map", "b=q1:deg,a=q2:deg") == 0, shell.err
    assert Path("again.csv").read_text() != first
    Path("bad.yaml").write_text("[1, 2]")
    assert "bad.yaml: columns" in shell.refused("import-data", "log.csv", "--like", "bad.yaml")


def test_the_convention_of_an_orientation_is_asked(shell: Shell) -> None:
    Path("log.csv").write_text("q1_deg,x_mm,y_mm,z_mm,roll,pitch,yaw\n1,2,3,4,0,0,90\n")
    assert "--rotation: 'missing for roll, pitch, yaw'" in shell.refused("import-data", "log.csv")
    assert shell("import-data", "log.csv", "--rotation", "none") == 0
    assert "roll" in shell.err
    for wrong in ("xyz:roll,pitch", "xxz:roll,pitch,yaw", "xYz:roll,pitch,yaw", "roll,pitch,yaw"):
        assert "--rotation" in shell.refused("import-data", "log.csv", "--rotation", wrong)
    assert "no angle's unit" in shell.refused(
        "import-data", "log.csv", "--rotation", "xyz:roll,pitch,yaw"
    )
    Path("q.csv").write_text("q1_deg,x_mm,y_mm,z_mm,a,b,c,d\n1,2,3,4,0,0,9,1\n")
    line = shell.refused("import-data", "q.csv", "--rotation", "xyzw:a,b,c,d")
    assert "row 1: length 9.05" in line
    with pytest.raises(InputError):
        Rotation.parse("wxyz:a,b,c,", "f")


@pytest.mark.parametrize(
    ("text", "words", "said"),
    [
        ("q1,x_mm,y_mm,z_mm\n1,2,3,4\n", (), "column q1: 'no unit'"),
        ("q1_mm,x_deg,y_mm,z_mm\n1,2,3,4\n", (), "column x_deg: 'deg'; allowed: for x: m, cm"),
        ("q1_deg,q3_deg,x_mm,y_mm,z_mm\n1,2,3,4,5\n", (), "joints: 'q1, q3'"),
        ("q1_deg,b,c\n1,2,3\n", (), "measurement: 'none'"),
        ("q1_deg,J1_deg,x_m,y_m,z_m\n1,2,3,4,5\n", (), "column q1: 'q1_deg and J1_deg'"),
        ("q1_deg,x_mm,y_mm,z_mm\nx,2,3,4\n1,2,a,4\n", (), "line 2, q1_deg: 'x'"),
        ("q1_deg,x_mm,y_mm,z_mm\n1,2,3,4\n1,2,a,4\n", (), "line 3, y_mm: 'a'"),
        ("q1_deg,x_mm,y_mm,z_mm\n1,2,3,4\n1,2,4\n", (), "line 3: '3 cells'"),
        ("q1_deg;x_mm;y_mm;z_mm\n1,5;2;3.5;4\n", (), "numbers: '1 with a comma, 1 with a point'"),
        ("q1_deg;x_mm;y_mm;z_mm\n1,5;2;3.5;4\n", ("--decimal", ","), "line 2, y_mm: '3.5'"),
        ("1,2,3,4\n5,6,7,8\n", (), "header: 'none'"),
        ("q1_deg,x_mm,y_mm,z_mm\n", (), "rows: 'no row of numbers'"),
        ("hello\n", (), "file: 'no columns'"),
        ("q1_deg,x_mm,y_mm,z_mm\n1,2,3,4\n", ("--map", "k=x"), "--map: 'k'"),
        ("q1_deg,x_mm,y_mm,z_mm\n1,2,3,4\n", ("--map", "k"), "--map: 'k'"),
        ("q1_deg,x_mm,y_mm,z_mm\n1,2,3,4\n", ("--units", "mm,ell"), "--units: 'ell'"),
        ("q1_deg,x_mm,y_mm,z_mm\n1,2,3,4\n", ("--units", "mm,m"), "--units: 'm'"),
    ],
)  # fmt: skip
def test_tables_that_are_refused(
    text: str, words: tuple[str, ...], said: str, shell: Shell
) -> None:
    Path("log.csv").write_text(text)
    assert said in shell.refused("import-data", "log.csv", *words)
    assert not Path("samples.csv").exists()


@pytest.mark.parametrize(
    ("unit", "value", "si"),
    [
        *(("mm", 1.0, 1e-3), ("cm", 1.0, 1e-2), ("um", 1.0, 1e-6), ("in", 1.0, 0.0254)),
        *(("deg", 180.0, np.pi), ("mrad", 1.0, 1e-3), ("arcmin", 60 * 180.0, np.pi)),
        *(("arcsec", 3600 * 180.0, np.pi), ("ms", 1.0, 1e-3), ("us", 1.0, 1e-6)),
        *(("ns", 1.0, 1e-9), ("min", 1.0, 60.0), ("k", 273.15, 0.0), ("f", 212.0, 100.0)),
        *(("g", 1.0, 1e-3), ("lb", 1.0, 0.45359237), ("m", 2.0, 2.0), ("rad", 1.0, 1.0)),
    ],
)
def test_units(unit: str, value: float, si: float) -> None:
    held = UNITS[unit]
    assert held.factor * value + held.offset == pytest.approx(si, abs=1e-9)


@pytest.mark.parametrize(
    ("name", "stem", "unit"),
    [
        ("q1 [deg]", "q1", "deg"),
        ("x_mm", "x", "mm"),
        ("Time (ms)", "Time", "ms"),
        ("A1/deg", "A1", "deg"),
        ("z, mm", "z", "mm"),
        ("Temp [°C]", "Temp", "c"),
        ("roll (degrees)", "roll", "deg"),
        ("temperature_c", "temperature", "c"),
        ("q1", "q1", None),
        ("repeat_id", "repeat_id", None),
        ("m", "m", None),
    ],
)
def test_names_and_their_units(name: str, stem: str, unit: str | None) -> None:
    found, held = split_name(name)
    assert (found, held.name if held else None) == (stem, unit)


@pytest.mark.parametrize(
    ("header", "call"),
    [
        ("q1_deg,q2_deg,q3_mm,q4_deg,x_mm,y_mm,z_mm", ""),
        ("q1 [deg],q2 [deg],q3 [mm],q4 [deg],x [mm],y [mm],z [mm]", ""),
        ("q1,q2,q3,q4,x_mm,y_mm,z_mm", " --units mm,deg"),
        ("J1,J2,J3,J4,x,y,z", " --units mm,deg"),
    ],
)
def test_other_commands_suggest_the_conversion(
    header: str, call: str, work: Path, shell: Shell
) -> None:
    Path("log.csv").write_text(f"{header}\n10,20,5,0,1,2,3\n")
    for words in (("calibrate", work / "arm.yaml", "log.csv"),
                  ("evaluate", work / "arm.yaml", "--test", "log.csv")):  # fmt: skip
        line = shell.refused(*words)
        assert line.endswith(f"longarm import-data log.csv -o samples.csv{call}")
    Path("semi.csv").write_text(header.replace(",", ";") + "\n1;2;3;4;5;6;7\n")
    assert "longarm import-data semi.csv" in shell.refused(
        "calibrate", work / "arm.yaml", "semi.csv"
    )


def test_a_converted_session_calibrates(work: Path, shell: Shell) -> None:
    """A session written by another program, in its units, gives the same model."""
    session = read_csv(work / "samples.csv", ARM)
    lines = ["A1 [deg];A2 [deg];A3 [mm];A4 [deg];X [mm];Y [mm];Z [mm]"]
    factors = np.array([180 / np.pi, 180 / np.pi, 1e3, 180 / np.pi, 1e3, 1e3, 1e3])
    for row in np.hstack([session.q, session.xyz]) * factors:
        lines.append(";".join(repr(float(v)).replace(".", ",") for v in row))
    Path("log.csv").write_text("\n".join(lines))
    assert shell("import-data", "log.csv", "--arm", work / "arm.yaml") == 0, shell.err
    again = read_csv("samples.csv", ARM)
    np.testing.assert_allclose(again.q, session.q, atol=1e-14)
    np.testing.assert_allclose(again.xyz, session.xyz, atol=1e-14)
