"""Nodes end by SIGINT whoever started them: shells start what runs in the background deaf to it."""

import signal
import sys
from collections.abc import Iterator

import pytest
from places import ROOT

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from nodes_bench import Bench, bench, gone
from own_graph import own_graph
from std_msgs.msg import String

from longarm_comp.nodes import interfaces as graph
from longarm_comp.share import folder

SUPPORT = ROOT / "test" / "support"
DEAF = (
    "import os, signal, sys; signal.signal(signal.SIGINT, signal.SIG_IGN);"
    "os.execv(sys.argv[1], sys.argv[1:])"
)

STUCK = """
from longarm_comp.nodes.health import PERIOD
from longarm_comp.nodes.node import ArmNode, program

class Stuck(ArmNode):
    def __init__(self, executor):
        super().__init__(executor, "stuck", (PERIOD,))
        worker = self.worker(1)
        worker.submit(lambda: self.wait_for_ever(worker))
        worker.start()

    def wait_for_ever(self, worker):
        print("begun", flush=True)
        while True:
            worker.wait(1e-3)

program(Stuck)()
"""

TALKER = """
from std_msgs.msg import String
from longarm_comp.nodes.health import PERIOD
from longarm_comp.nodes.node import ArmNode, program

class Talker(ArmNode):
    def __init__(self, executor):
        super().__init__(executor, "talker", (PERIOD,))
        self.voice = self.create_publisher(String, "last_words", LAST_WORDS)
        self.create_timer(0.05, lambda: self.voice.publish(String(data="here")))

    def close(self):
        for number in range(LAST_WORDS):
            self.voice.publish(String(data=str(number).ljust(60_000)))
        return super().close()

program(Talker)()
"""

RUN_OF_TESTS = """
import os, sys, tempfile, time
from forked import ForkedProgram
words = ["http.server", "0", "--bind", "127.0.0.1"]
print(ForkedProgram(words, os.getcwd(), dict(os.environ), tempfile.TemporaryFile("w+")).pid)
sys.stdout.flush()
time.sleep(600.0)
"""


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    with own_graph(tmp_path_factory.mktemp("shutdown")), bench() as made:
        yield made


@pytest.mark.parametrize("node", ["kinematics", "trajectory_compensator"])
def test_a_node_that_was_started_deaf_to_interrupts_ends(stage: Bench, node: str) -> None:
    heard = stage.collect(graph.DIAGNOSTICS)
    arm = folder("config") / "arm_demo.yaml"
    words = ["-m", f"longarm_comp.nodes.{node}", "--ros-args", "-p", f"arm:={arm}"]
    process = stage.program([sys.executable, "-c", DEAF, sys.executable, *words], ROOT, ROOT)
    stage.spin(lambda: any(s.name.startswith(f"/{node}") for array in heard for s in array.status))
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=300) == 0, stage.output(process)


def test_a_job_that_does_not_end_does_not_end_its_node_by_a_crash(stage: Bench) -> None:
    process = stage.program([sys.executable, "-c", STUCK], ROOT, ROOT)
    stage.spin(lambda: "begun" in stage.output(process))
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=300) == 0, stage.output(process)


def test_what_a_node_says_as_it_ends_is_heard(stage: Bench) -> None:
    heard, count = list[str](), 40
    words = stage.node.create_subscription(
        String, "last_words", lambda said: heard.append(said.data.strip()), count
    )
    program = TALKER.replace("LAST_WORDS", str(count))
    for _ in range(2):  # words so long are lost where the publisher does not wait
        process = stage.program([sys.executable, "-c", program], ROOT, ROOT)
        stage.spin(lambda: heard)
        process.send_signal(signal.SIGINT)
        stage.spin(lambda process=process: process.poll() is not None)
        assert process.returncode == 0, stage.output(process)
        stage.spin(lambda: words.get_publisher_count() == 0)
        assert [said for said in heard if said != "here"] == [str(k) for k in range(count)]
        heard.clear()


def test_what_a_run_of_tests_started_ends_with_it_also_where_it_is_killed(stage: Bench) -> None:
    run = stage.program([sys.executable, "-c", RUN_OF_TESTS], SUPPORT, ROOT)
    pid = int(stage.spin(lambda: stage.output(run)))
    assert not gone(pid)
    run.kill()
    stage.spin(lambda: gone(pid))
