"""Processes of a graph that end: which are restarted, which stay ended, and what goes on."""

import os
import sys
import threading
from collections.abc import Callable

import pytest

from longarm_comp.core.errors import JobError
from longarm_comp.nodes.bringup import Supervisor

RUNS_ON = "import signal; signal.pause()"
BAD_INPUT = "raise SystemExit(2)"
DIES = "import os; os.abort()"


def supervisor(say: Callable[[str], None], respawn: bool = True, **programs: str) -> Supervisor:
    """Supervise Python programs, by the names of nodes."""
    commands = {name: [sys.executable, "-c", text] for name, text in programs.items()}
    return Supervisor(commands, respawn=respawn, say=say)


def is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


class Said(list[str]):
    """What a supervisor said; its event is set once it said that something ended."""

    def __init__(self) -> None:
        super().__init__()
        self.heard = threading.Event()

    def __call__(self, text: str) -> None:
        self.append(text)
        if "ended" in text:
            self.heard.set()


@pytest.mark.parametrize(
    ("program", "respawn", "how"), [(BAD_INPUT, True, "exit code 2"), (DIES, False, "SIGABRT")]
)
def test_the_driver_goes_on_without_a_node_that_cannot_be_restarted(
    program: str, respawn: bool, how: str
) -> None:
    said = Said()
    nodes = {"servo_driver": RUNS_ON, "stereo_bridge": program, "kinematics": RUNS_ON}
    with supervisor(said, respawn, **nodes) as graph:
        before = {name: graph.pid(name) for name in nodes}
        with pytest.raises(JobError, match=rf"stereo_bridge \({how}\)$"):
            graph.run(said.heard)
        for _ in range(3):
            graph.look()
        assert [text for text in said if "ended" in text] == [
            f"stereo_bridge ended ({how}) and is not started again; the other nodes go on"
        ]
        assert graph.gone == {"stereo_bridge": how}
        assert {name: graph.pid(name) for name in nodes} == before
        assert [name for name in nodes if is_alive(before[name])] == ["servo_driver", "kinematics"]
    assert not any(map(is_alive, before.values()))  # all end with the supervisor


def test_all_end_with_the_driver_and_with_the_last_node() -> None:
    said = Said()
    with (
        supervisor(said, servo_driver=BAD_INPUT, kinematics=RUNS_ON) as graph,
        pytest.raises(JobError, match=r"^servo_driver ended \(exit code 2\)$"),
    ):
        graph.run(said.heard)
    with (
        supervisor(lambda text: None, kinematics=BAD_INPUT, error_predictor=BAD_INPUT) as graph,
        pytest.raises(JobError, match=r"^\w+ ended \(exit code 2\)$"),
    ):
        graph.run(threading.Event())
    assert not said.heard.is_set()


def test_a_node_that_dies_is_restarted_and_the_end_is_good() -> None:
    said = Said()
    with supervisor(said, servo_driver=RUNS_ON, kinematics=DIES) as graph:
        graph.run(said.heard)
    assert "kinematics ended (SIGABRT), started again" in said[-1]
    assert graph.gone == {}
