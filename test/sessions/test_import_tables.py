"""Tables as trackers and controllers write them: several files, markers, times; and back again."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from cli_shell import Shell
from small_arm import ARM, measured

from longarm_comp.core.data.plan import sobol
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.sessions.csv import read_csv
from longarm_comp.sessions.foreign.units import seconds
from longarm_comp.sessions.poses import read_poses

JOINTS = "Point;A1 [deg];A2 [deg];A3 [mm];A4 [deg]\n"
ROWS = {"P7": (10, 20, 50, 3), "P8": (11, 25, 60, -4), "P9": (12, 21, 40, 5)}


def joints(names: str = "P7 P8 P9") -> str:
    return JOINTS + "".join(f"{n};{';'.join(map(str, ROWS[n]))}\n" for n in names.split())


def session(path: str = "samples.csv") -> pd.DataFrame:
    return pd.read_csv(path, dtype={"point": str})


# ------------------------------------------------------------------ several files


def test_joints_and_points_are_joined_by_number(shell: Shell) -> None:
    Path("arm.csv").write_text(joints())
    Path("tracker.txt").write_text(
        "Name  X_mm  Y_mm  Z_mm\nP9  9  2,5  3\nP7  7  2,5  3\nP5  1  2  3\n"
    )
    Path("named.txt").write_text(Path("tracker.txt").read_text().replace("Name", "Point"))
    assert "--join" in shell.refused("import-data", "arm.csv", "tracker.txt")
    call = ("import-data", "arm.csv", "named.txt", "--join")
    assert "one column of" in shell.refused(*call, "Number")
    assert shell(*call, "Point") == 0, shell.err
    made = session()
    assert made["point"].tolist() == ["P7", "P9"]
    np.testing.assert_allclose(made["x"], [0.007, 0.009])
    np.testing.assert_allclose(made["y"], 0.0025)
    np.testing.assert_allclose(np.degrees(made["q1"]), [10, 12])
    for words in ("arm.csv: no partner of Point P8", "named.txt: no partner of Point P5"):
        assert words in shell.err
    Path("named.txt").write_text("Point  X_mm  Y_mm  Z_mm\nP9  9  2  3\nP9  7  2  3\n")
    assert "line 3, Point: 'P9'; allowed: each of them once" in shell.refused(*call, "Point")
    Path("named.txt").write_text("Point  X_mm  Y_mm  Z_mm\nX9  9  2  3\nY9  7  2  3\n")
    assert "no row in common" in shell.refused(*call, "Point")


def test_rows_without_a_number_have_no_partner(shell: Shell) -> None:
    """A way-point of the arm is not what the tracker measured between its points."""
    Path("arm.csv").write_text(joints() + ";40;50;60;7\n")
    Path("tracker.csv").write_text("Point,X_mm,Y_mm,Z_mm\nP7,7,2,3\n,0,0,0\n,1,1,1\nP8,8,2,3\n")
    assert shell("import-data", "arm.csv", "tracker.csv", "--join", "Point") == 0, shell.err
    made = session()
    assert made["point"].tolist() == ["P7", "P8"]
    np.testing.assert_allclose(made["x"], [0.007, 0.008])
    assert "arm.csv: no partner of Point P9, (blank)" in shell.err
    assert "tracker.csv: no partner of Point (blank), (blank)" in shell.err


def test_what_a_controller_measured_is_a_reading(shell: Shell) -> None:
    """Beside the command of each joint, in the unit of its column; blank is not read."""
    Path("log.csv").write_text(
        "A1 [deg];A2 [deg];A3 [mm];A4 [deg];A1_actual [deg];A3_actual [mm];x [mm];y [mm];z [mm]\n"
        "10;20;50;3;9.5;49;7;2;3\n"
        "11;25;60;-4;;60;8;2;3\n"
    )
    joints = "A1=q1,A2=q2,A3=q3,A4=q4,A1_actual=read_q1,A3_actual=read_q3"
    assert shell("import-data", "log.csv", "--map", joints) == 0, shell.err
    rows = read_csv("samples.csv", ARM)
    assert rows.read_joints == (0, 2)
    np.testing.assert_allclose(np.degrees(rows.readings["read_q1"][:, 0]), [9.5, np.nan])
    np.testing.assert_allclose(rows.readings["read_q3"][:, 0], [0.049, 0.060])


def test_files_are_joined_by_the_nearest_time(shell: Shell) -> None:
    Path("arm.csv").write_text(
        "Time,A1_deg\n2024-01-02 10:00:00,1\n2024-01-02 10:00:10,2\n2024-01-02 10:00:20,3\n"
    )
    Path("tracker.csv").write_text(
        "Time,x_mm,y_mm,z_mm\n2024-01-02T10:00:11,2,0,0\n2024-01-02T10:00:01,1,0,0\n"
    )
    assert shell("import-data", "arm.csv", "tracker.csv", "--join", "Time") == 0, shell.err
    made = session()
    np.testing.assert_allclose(np.degrees(made["q1"]), [1, 2])
    np.testing.assert_allclose(made["x"], [0.001, 0.002])
    np.testing.assert_allclose(made["t_s"], [0, 10])
    assert "no partner of Time 2024-01-02 10:00:20" in shell.err


def test_days_follow_each_other_with_a_gap(shell: Shell) -> None:
    tip = ";X [mm];Y [mm];Z [mm]"
    rows = [line + ";1;2;3" for line in joints("P7 P8").splitlines()[1:]]
    Path("day1.csv").write_text("\n".join([JOINTS.strip() + tip, *rows]))
    turned = "X [mm];Y [mm];Z [mm];" + JOINTS.strip()
    Path("day2.csv").write_text(turned + "\n4;5;6;P9;12;21;40;5\n4;5;6;P7;10;20;50;3\n")
    assert shell("import-data", "day1.csv", "day2.csv") == 0, shell.err
    made = session()
    assert made["index"].tolist() == [0, 1, 3, 4]  # nobody knows what the joints did between
    assert made["point"].tolist() == ["P7", "P8", "P9", "P7"]
    np.testing.assert_allclose(made["x"], [0.001, 0.001, 0.004, 0.004])
    held = read_csv("samples.csv", ARM)
    assert held.labels["point"].tolist() == ["P7", "P8", "P9", "P7"]
    assert held.approach[1].any() and not held.approach[2].any()


def test_rows_are_not_sorted_by_a_column_with_a_blank(shell: Shell) -> None:
    """As texts, the numbers beside it would come in the order 10, 2, 9."""
    Path("log.csv").write_text(
        "A1_deg,No,x_m,y_m,z_m\n3,10,3,0,0\n1,2,1,0,0\n2,,2,0,0\n4,9,4,0,0\n"
    )
    said = shell.refused("import-data", "log.csv", "--sort", "No")
    assert "line 4, No: ''; allowed: a value to sort by" in said


def test_times_of_day_of_a_further_file_are_of_the_next_day(shell: Shell) -> None:
    """Nine hours back within a file would be rows out of order."""
    head = "A1_deg,Time,X_mm,Y_mm,Z_mm\n"
    Path("day1.csv").write_text(head + "1,08:00,1,2,3\n2,17:00,1,2,3\n")
    Path("day2.csv").write_text(head + "3,08:00,1,2,3\n4,09:30,1,2,3\n")
    assert shell("import-data", "day1.csv", "day2.csv") == 0, shell.err
    assert session()["t_s"].tolist() == [0, 32400, 86400, 91800]
    assert session()["index"].tolist() == [0, 1, 3, 4]


def test_the_gap_between_files_is_sorted_with_their_rows(shell: Shell) -> None:
    head = "A1_deg,No,X_mm,Y_mm,Z_mm\n"
    Path("late.csv").write_text(head + "4,4,1,2,3\n5,5,1,2,3\n6,6,1,2,3\n")
    Path("early.csv").write_text(head + "1,1,1,2,3\n2,2,1,2,3\n")
    assert shell("import-data", "late.csv", "early.csv", "--sort", "No") == 0, shell.err
    made = session()
    np.testing.assert_allclose(np.degrees(made["q1"]), [1, 2, 4, 5, 6])
    assert made["index"].tolist() == [0, 1, 3, 4, 5]


def test_markers_side_by_side_are_rows(shell: Shell) -> None:
    Path("log.csv").write_text(
        "A1_deg,M1 X_mm,M1 Y_mm,M1 Z_mm,M2 X_mm,M2 Y_mm,M2 Z_mm\n1,1,2,3,4,5,6\n2,7,8,9,,,\n"
    )
    assert shell("import-data", "log.csv") == 0, shell.err
    made = session()
    assert made["marker"].tolist() == ["M1", "M2", "M1", "M2"]
    assert made["index"].tolist() == [0, 0, 1, 1]
    np.testing.assert_allclose(made["x"], [0.001, 0.004, 0.007, np.nan])
    assert "a row each: M1, M2" in shell.err
    chosen = ("--map", "M2 X=x,M2 Y=y,M2 Z=z", "-o", "second.csv")
    assert shell("import-data", "log.csv", *chosen) == 0, shell.err
    assert "marker" not in session("second.csv") and len(session("second.csv")) == 2


def test_rows_are_put_in_the_order_of_a_column(shell: Shell) -> None:
    Path("log.csv").write_text("A1_deg,No,x_m,y_m,z_m\n3,10,3,0,0\n1,2,1,0,0\n2,9,2,0,0\n")
    assert shell("import-data", "log.csv") == 0
    assert "--sort" in shell.err
    assert shell("import-data", "log.csv", "--sort", "No") == 0, shell.err
    assert session()["x"].tolist() == [1, 2, 3] and session()["point"].tolist() == ["2", "9", "10"]


# ------------------------------------------------------------------ names, titles, times


def test_what_the_user_says_wins(shell: Shell) -> None:
    Path("log.csv").write_text(
        "A1_deg,U(95) X [mm],X [mm],Y [mm],Z [mm],Goal x_mm,measurement_x_mm\n1,9,1,2,3,4,5\n"
    )
    assert shell("import-data", "log.csv", "--map", "X=x") == 0, shell.err
    assert session()["x"].tolist() == [0.001]
    assert shell("import-data", "log.csv", "--map", "measurement_x=x") == 0, shell.err
    assert session()["x"].tolist() == [0.005]
    assert shell("import-data", "log.csv", "--map", "U(95) X=x") == 0, shell.err
    assert session()["x"].tolist() == pytest.approx([0.009])
    Path("log.csv").write_text("A1_deg,U(95) X [mm],X [mm],Y [mm],Z [mm]\n1,9,1,2,3\n")
    assert shell("import-data", "log.csv") == 0, shell.err  # the bare name is meant
    assert session()["x"].tolist() == [0.001]


def test_a_plain_name_needs_no_unit_of_one_with_a_heading(shell: Shell) -> None:
    """In whichever order they stand."""
    for names, cells in (
        ("Goal q1,q1 [deg]", "7,180"),
        ("q1 [deg],Goal q1", "180,7"),
        ("Goal q1,Last q1,q1 [deg]", "7,8,180"),
    ):
        Path("log.csv").write_text(f"{names},X [mm],Y [mm],Z [mm]\n{cells},1,2,3\n")
        assert shell("import-data", "log.csv") == 0, shell.err
        assert session()["q1"].tolist() == pytest.approx([np.pi])


@pytest.mark.parametrize("title", ["Survey of 2024-03-01", "Boom,survey,12", "Boom,survey\n"])
def test_a_title_is_no_heading(title: str, shell: Shell) -> None:
    Path("log.csv").write_text(f"{title}\nA1_deg,X_mm,Y_mm,Z_mm,note\n1,2,3,4,a\n1,2,3,4,b\n")
    assert shell("import-data", "log.csv", "--map", "X=x") == 0, shell.err
    mapping = yaml.safe_load(Path("samples.mapping.yaml").read_text())
    assert mapping["columns"]["q1"]["from"] == "A1_deg"


@pytest.mark.parametrize(
    "text",
    [
        "A1_deg  X_mm  Y_mm  Z_mm\n1  2.5  3  4\n",
        "A1_deg X_mm Y_mm Z_mm\n 1 2,5 3 4\n",
        "A1_deg   X_mm\tY_mm   Z_mm\n1\t2.5   3\t4\n",
        "A1_deg\tX_mm\tY_mm\tZ_mm\n1\t2,5\t3\t4\n",
    ],
)
def test_tables_aligned_with_blanks(text: str, shell: Shell) -> None:
    Path("log.txt").write_text(text)
    assert shell("import-data", "log.txt") == 0, shell.err
    assert session()[["x", "y", "z"]].to_numpy()[0] == pytest.approx([0.0025, 0.003, 0.004])


def test_a_quaternion_of_a_tracker_is_no_joint(shell: Shell) -> None:
    Path("log.csv").write_text(
        "A1_deg,A2_deg,x_m,y_m,z_m,Q0,Q1,Q2,Q3\n1,2,3,4,5,1,0,0,0\n1,2,3,4,5,0.6,0.8,0,0\n"
    )
    assert "--rotation" in shell.refused("import-data", "log.csv")
    turn = ("--rotation", "wxyz:Q0,Q1,Q2,Q3")
    assert shell("import-data", "log.csv", *turn) == 0, shell.err
    made = session()
    assert made["qx"].tolist() == pytest.approx([0, 0.8]) and "q3" not in made
    np.testing.assert_allclose(np.degrees(made[["q1", "q2"]]), [[1, 2], [1, 2]])


@pytest.mark.parametrize(
    ("texts", "passed"),
    [
        (["20200714163904", "20200714164000"], [0, 56]),
        (["2020-07-14 16:39:04.5", "2020-07-14T16:39:05"], [0, 0.5]),
        (["14.07.2020 23:59", "15.07.2020 00:01"], [0, 120]),
        (["16:39", "16:40:30"], [0, 90]),
        (["23:59:59.5", "00:00:01"], [0, 1.5]),
        (["1.5", "2.5"], None),
        (["20200714163904", "x"], None),
        (["soon", "later"], None),
    ],
)
def test_wall_clock_times(texts: list[str], passed: list[float] | None) -> None:
    found = seconds(texts)
    assert (None if found is None else found.tolist()) == passed


def test_times_of_a_table_are_seconds(shell: Shell) -> None:
    head = "Timestamp,A1_deg,x_m,y_m,z_m\n"
    Path("log.csv").write_text(head + "20200714163904,1,1,2,3\n20200714163914,1,1,2,3\n")
    assert shell("import-data", "log.csv") == 0, shell.err
    assert session()["t_s"].tolist() == [0, 10]
    Path("log.csv").write_text(head + "5,1,1,2,3\n6,1,1,2,3\n")
    assert "no unit" in shell.refused("import-data", "log.csv", "-o", "other.csv")


def test_a_mapping_serves_a_text_and_a_workbook(shell: Shell) -> None:
    Path("log.csv").write_text("a;u;v;w\n1,5;2,5;3;4\n")
    told = ("--map", "a=q1:deg,u=x:mm,v=y:mm,w=z:mm")
    assert shell("import-data", "log.csv", *told) == 0, shell.err
    pd.DataFrame({"a": [1.5], "u": [2.5], "v": [3], "w": [4]}).to_excel("log.xlsx", index=False)
    like = ("import-data", "log.xlsx", "--like", "samples.mapping.yaml", "-o", "again.csv")
    assert shell(*like) == 0, shell.err
    assert Path("again.csv").read_text() == Path("samples.csv").read_text()
    back = ("import-data", "log.csv", "--like", "again.mapping.yaml", "-o", "third.csv")
    assert shell(*back) == 0, shell.err
    assert Path("third.csv").read_text() == Path("samples.csv").read_text()


def test_a_workbook_for_a_session_is_told(work: Path, shell: Shell) -> None:
    pd.DataFrame({"q1": [1.5]}).to_excel("day1.xlsx", index=False)
    line = shell.refused("calibrate", work / "arm.yaml", "day1.xlsx")
    assert line.endswith("to convert it: longarm import-data day1.xlsx -o samples.csv")


def test_an_imported_session_that_was_edited_is_kept(shell: Shell) -> None:
    Path("log.csv").write_text("A1_deg,x_m,y_m,z_m\n5,1,1,2\n6,1,1,2\n")
    for _ in range(2):
        assert shell("import-data", "log.csv") == 0, shell.err
    made = Path("samples.csv")
    made.write_text(made.read_text().replace("1.0", "1.5"))
    assert "--force" in shell.refused("import-data", "log.csv")
    assert shell("import-data", "log.csv", "--force") == 0
    made.write_text("q1,x,y,z\n1,2,3,4\n")  # another's table under that name
    Path("samples.mapping.yaml").unlink()
    assert "--force" in shell.refused("import-data", "log.csv")


def test_outliers_are_called_by_their_point_numbers(work: Path, shell: Shell) -> None:
    rows = measured(60, np.random.default_rng(2))
    raw = pd.DataFrame(np.hstack([rows.q, rows.xyz]), columns=["q1", "q2", "q3", "q4", *"xyz"])
    raw.insert(0, "Point", [f"P{100 + k}" for k in range(len(raw))])
    raw.loc[17, "x"] += 0.05
    raw.to_csv("log.csv", index=False)
    assert shell("import-data", "log.csv", "--units", "m,rad", "--arm", work / "arm.yaml") == 0
    assert shell("calibrate", work / "arm.yaml", "samples.csv") == 0, shell.err
    assert "1 rows set aside (1.7%): P117;" in shell.err
    told = shell.json("diagnose", work / "arm.yaml", "samples.csv", "-o", "told", "--no-network")
    report = json.loads(Path("told/report.json").read_text())
    assert "P117" in [outlier["point"] for outlier in report["outliers"]], told
    assert ">P117</th>" in Path("told/report.html").read_text()


# ------------------------------------------------------------------ and back


@pytest.mark.parametrize("kind", ["csv", "xlsx"])
def test_a_table_comes_back_in_its_own_form(kind: str, work: Path, shell: Shell) -> None:
    """Raw table, session, plan and commands in the raw table's form: the same numbers."""
    q = sobol(ARM, 6, 2).q
    factors = np.array([180 / np.pi, 180 / np.pi, 1e3, 180 / np.pi])
    names = ["A1 [deg]", "A2 [deg]", "Lift [mm]", "A4 [deg]"]
    raw = pd.DataFrame(q * factors, columns=names)
    raw[["X [mm]", "Y [mm]", "Z [mm]"]] = 1e3 * np.array([[0.5, 0.1, 0.2]] * 6)
    log = Path(f"log.{kind}")
    if kind == "csv":
        raw.to_csv(log, index=False, sep=";", decimal=",")
    else:
        raw.to_excel(log, index=False)
    told = ("--arm", work / "arm.yaml", "--map", "Lift=q3")
    assert shell("import-data", log, *told) == 0, shell.err
    np.testing.assert_allclose(read_csv("samples.csv", ARM).q, q, rtol=1e-12)

    def table(path: str) -> pd.DataFrame:
        if kind == "xlsx":
            return pd.read_excel(path)
        return pd.read_csv(path, sep=";", decimal=",")

    like = ("--like", "samples.mapping.yaml")
    plan = ("plan", work / "arm.yaml", "--kind", "sobol", "-n", 5)
    assert shell(*plan) == 0 and shell(*plan, "-o", f"his.{kind}", *like) == 0, shell.err
    his = table(f"his.{kind}")
    np.testing.assert_allclose(his[names] / factors, read_poses("poses.csv", ARM).q, rtol=1e-12)

    tips = declared_model(ARM).tip(q[:2])
    pd.DataFrame(tips, columns=list("xyz")).to_csv("targets.csv", index=False)
    wanted = pd.DataFrame(1e3 * tips, columns=["X [mm]", "Y [mm]", "Z [mm]"])
    if kind == "csv":
        wanted.to_csv("wanted.csv", index=False, sep=";", decimal=",")
    else:
        wanted.to_excel("wanted.xlsx", index=False)
    aim = ("compensate", work / "arm.yaml", "--model", work / "model.yaml", "--frame", "measured")
    assert shell(*aim, "--targets", "targets.csv") == 0, shell.err
    assert shell(*aim, "--targets", f"wanted.{kind}", *like, "-o", f"go.{kind}") == 0, shell.err
    go, plain = table(f"go.{kind}"), pd.read_csv("commands.csv")
    np.testing.assert_allclose(go[names] / factors, plain[["q1", "q2", "q3", "q4"]], rtol=1e-9)
    targets = go[["target X [mm]", "target Y [mm]", "target Z [mm]"]]
    np.testing.assert_allclose(targets, 1e3 * tips, rtol=1e-12)
    ran = go["run up Lift [mm]"].to_numpy(dtype=float)
    np.testing.assert_allclose(ran, 1e3 * plain["run_up_q3"], rtol=1e-9)
    assert go["status"].tolist() == plain["status"].tolist()
    np.testing.assert_array_equal(go["approach A1"].fillna(0), plain["approach_q1"].fillna(0))
