"""Targets as CSV: what comes back, and what is refused with which words."""

from pathlib import Path

import numpy as np
import pytest

from longarm_comp.core.errors import InputError
from longarm_comp.sessions.targets import Targets, read_targets


def written(path: Path, *lines: str) -> Path:
    path.write_text("\n".join(lines) + "\n")
    return path


def test_targets(tmp_path: Path) -> None:
    path = written(
        tmp_path / "t.csv",
        "x,y,z,qx,qy,qz,qw,approach,payload_kg",
        "1,2,3,0,0,0.70711,0.70711,-1,0.3",
        "4,5,6,,,,,,0.4",
    )
    targets = read_targets(path)
    assert targets.xyz.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert np.isclose(np.linalg.norm(targets.quaternion[0]), 1, atol=1e-12)
    assert np.isnan(targets.quaternion[1]).all()
    context = targets.context(4)
    assert [side.tolist() for side in context.approach] == [[-1.0, 0.0]] * 4
    assert context.column("payload_kg").tolist() == [0.3, 0.4]


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (("x,y", "1,2"), "column z: 'missing'"),
        (("x,y,z", "1,2,nan"), "line 2, z: 'nan'"),
        (("x,y,z", "1,2,"), "line 2, z: ''"),
        (("x,y,z,qx,qy,qz", "1,2,3,0,0,0"), "column qw: 'missing"),
        (("x,y,z,qx,qy,qz,qw", "1,2,3,0,0,0,0.5"), "a quaternion of length 1"),
        (("x,y,z,qx,qy,qz,qw", "1,2,3,0,0,0,"), "a quaternion of length 1"),
        (("x,y,z,approch", "1,2,3,1"), "close to approach"),
    ],
)
def test_bad_targets(lines: tuple[str, ...], words: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=words):
        read_targets(written(tmp_path / "t.csv", *lines))


@pytest.mark.parametrize(
    ("column", "cell"),
    [
        *(("frame", "measured"), ("approach", "1"), ("payload_kg", "0.5"), ("t_s", "3")),
        *(("qx,qy,qz,qw", "0,0,0,1"), ("operator", "anna"), ("wind", "2.5")),
    ],
)
def test_points_are_targets_that_ask_for_nothing_more(
    column: str, cell: str, tmp_path: Path
) -> None:
    first = "0.0" if column in ("payload_kg", "t_s", "wind") else "," * column.count(",")
    path = written(tmp_path / "t.csv", f"x,y,z,{column}", f"1,2,3,{first}", f"4,5,6,{cell}")
    name = column.partition(",")[0]
    row = 1 if first == "0.0" else 2
    with pytest.raises(InputError, match=rf"row {row}, {name}: .*x, y, z alone, in the frame base"):
        _ = read_targets(path).points


def test_points_may_have_a_number_and_the_frame_base(tmp_path: Path) -> None:
    path = written(tmp_path / "t.csv", "index,x,y,z,frame,approach,wind", "7,1,2,3,base,0,")
    assert read_targets(path).points.tolist() == [[1.0, 2.0, 3.0]]


@pytest.mark.parametrize("numbers", [[1, 2], [1, 2, np.nan], [1, 2, 3, 0, 0, 0, 0.2]])
def test_bad_target_on_the_command_line(numbers: list[float]) -> None:
    with pytest.raises(InputError, match="target"):
        Targets.one(numbers)
