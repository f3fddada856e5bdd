"""What inclinometers tell, in a bag as on a running graph."""

from types import SimpleNamespace
from typing import Any

import pytest
from small_arm import ARM

from longarm_comp.core.errors import InputError
from longarm_comp.sessions.message_buffer import MessageBuffer


def told(*turn: float, frame: str = "", known: float = 0.0) -> Any:
    """A message of an inclinometer: x, y, z, w; a covariance of -1: it measures no orientation."""
    return SimpleNamespace(
        header=SimpleNamespace(frame_id=frame, stamp=SimpleNamespace(sec=1, nanosec=0)),
        orientation=SimpleNamespace(**dict(zip("xyzw", turn, strict=True))),
        orientation_covariance=[known] + [0.0] * 8,
    )


def columns(message: Any) -> dict[str, float]:
    buffer = MessageBuffer(ARM, "bag", 0, every_command=False)
    buffer.take("inclination", 10**9, message)
    return {name: steps.at(1.0) for name, steps in buffer.columns.items()}


@pytest.mark.parametrize("turn", [(0.02, 0.0, 0.0, 2.0), (0.0, 0.0, 0.0, 0.0)])
def test_what_is_no_orientation_is_refused(turn: tuple[float, ...]) -> None:
    """Twice as long, it read four times the tilt; of zeros, none."""
    with pytest.raises(InputError, match=r"inclination orientation at 1\.000 s.*of length 1"):
        columns(told(*turn))


def test_a_sensor_that_measures_no_orientation_tells_no_tilt() -> None:
    assert columns(told(0.0, 0.0, 0.0, 0.0, known=-1.0)) == {}


@pytest.mark.parametrize(("frame", "name"), [("", "0"), ("base", "0"), ("2", "2"), ("a b", "a_b")])
def test_a_tilt_has_one_name_in_bags_and_on_the_graph(frame: str, name: str) -> None:
    pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")
    from longarm_comp.nodes.messages import tilt_of

    message = told(0.01, 0.0, 0.0, 0.99995, frame=frame)
    read = columns(message)
    assert list(read) == [f"incl_{name}_x", f"incl_{name}_y"]
    assert read[f"incl_{name}_x"] == pytest.approx(0.02, rel=1e-3)
    assert tilt_of(message)[1] == read
