"""What every test may ask for: measured data, seeded numbers, an empty ROS graph of its own."""

from __future__ import annotations

import os

for _pool in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_pool, "1")  # tests run side by side; read when numpy is first imported

import fcntl
import gc
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from cli_shell import Shell, made_by_commands
from own_graph import own_graph
from places import DATA, DEMO_ARM, ROOT

from longarm_comp.core.arm.arm import Arm

if TYPE_CHECKING:
    from driver_rig import Rig
    from nodes_bench import Bench

NOT_SHIPPED = Path(os.environ.get("LONGARM_DATA", ROOT.parent / "shared" / "data")) / "real"


LONGEST = (
    *("test_stops", "test_kept_stops", "test_hidden_effect", "test_loop_graph", "test_explain"),
    *("test_servo_setup", "test_promise", "test_turns_in_doubt", "test_orders"),
    *("test_no_code_from_data", "test_fuzz", "test_servo_driver", "test_functions"),
    *("test_paths", "test_belonging", "test_demo", "test_diagnosed", "test_nonsense"),
    *("test_kind_of_arm", "test_error_predictor", "test_package", "test_fleet_cluster"),
    *("test_diagnose", "test_readings_on_the_graph", "test_fleet", "test_tracker_on_the_graph"),
    *("test_other_networks", "test_arm_folder_graph", "test_touch", "test_tip_on_the_graph"),
    *("test_python_api", "test_trim", "test_readings", "test_kinematics", "test_history"),
    *("test_at_work_graph", "test_imports", "test_away", "test_predictor", "test_arm_folder"),
    *("test_sentences", "test_ready", "test_holdout", "test_view", "test_apply"),
    *("test_stereo_calibrate", "test_apply_broken_off", "test_servo_written_back"),
    *("test_measurements", "test_browser", "test_written", "test_collect_run"),
    *("test_realisable_commands", "test_keep_out", "test_placement", "test_driver_link"),
    *("test_crane", "test_collect", "test_model_tolerance", "test_touch_graph"),
    *("test_set_aside", "test_close_the_loop", "test_commands", "test_open_catalogue"),
    *("test_far_base", "test_ik", "test_study_day", "test_strict_files", "test_public_robots"),
)
"""Files that take longest, those that wait for nodes between those that compute. They begin first:
no worker is left alone with one."""


def pytest_collection(session: pytest.Session) -> None:
    """Collect without scans of the heap, which only grows meanwhile: a fifth of the time."""
    gc.disable()


def pytest_collection_finish(session: pytest.Session) -> None:
    """What was imported stays: later scans leave it out."""
    gc.enable()
    gc.freeze()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest files first (`--no-loadscope-reorder` keeps this order)."""
    order = {name: place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: order.get(item.path.stem, len(order)))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Say why each test ran once more."""
    for report in terminalreporter.stats.get("rerun", []):
        why = getattr(report.longrepr, "reprcrash", None)
        terminalreporter.line(f"again: {report.nodeid}: {why.message if why else report.longrepr}")


Once = Callable[[str, Callable[[Path], object]], Path]


@pytest.fixture(scope="module", autouse=True)
def state_of_this_file(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Give each file of tests its own folder of stops and setups: a stop that lasts is not met."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        yield


@pytest.fixture(scope="module", autouse=True)
def no_long_collections(request: pytest.FixtureRequest) -> None:
    """Keep emulated servos within a driver's patience.

    Python's collector stops every thread while it scans the heap: after a thousand tests, on a busy
    machine, for half a second.  So it scans what these files make, not what was there before.
    """
    if request.path.parent.name in ("devices", "nodes", "jobs"):
        gc.collect()
        gc.freeze()


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real and simulated measurements (`test/data/README.md`)."""
    return DATA


def not_shipped(name: str) -> Path:
    """Folder of measurements that have no licence to be shipped; skips where it is absent."""
    if not (NOT_SHIPPED / name).is_dir():
        pytest.skip(f"no {NOT_SHIPPED / name}: its owners state no licence, so it is not shipped")
    return NOT_SHIPPED / name


@pytest.fixture(scope="session")
def justin_data() -> Path:
    """The folder that holds `dlr_justin`."""
    return not_shipped("dlr_justin").parent


@pytest.fixture(scope="session")
def photographs() -> Path:
    """25 stereo pairs of a chessboard."""
    return not_shipped("stereo_chessboard")


@pytest.fixture(scope="session")
def demo_arm_path() -> Path:
    """The declared arm of the demonstration."""
    return DEMO_ARM


@pytest.fixture(scope="session")
def demo(demo_arm_path: Path) -> Arm:
    """The arm of the demonstration, as declared."""
    return Arm.load(demo_arm_path)


@pytest.fixture(scope="session")
def stepped(demo: Arm) -> Arm:
    """The same arm with servos of 1000 steps a turn, and slides of 0.1 mm."""
    data = demo.model_dump(mode="json", exclude_defaults=True)
    for joint in data["joints"]:
        joint |= {"step_deg": 0.36} if joint["type"] == "revolute" else {"step_m": 1e-4}
    return Arm.parse(data, "stepped demo")


@pytest.fixture(scope="session")
def arm(demo: Arm) -> Arm:
    """The arm of the demonstration too, in a file that has no other one."""
    return demo


@pytest.fixture(scope="session")
def twin(data_dir: Path) -> Arm:
    """The declared arm of the shared twin cases."""
    return Arm.load(data_dir / "twin" / "arm.yaml")


@pytest.fixture
def rng() -> np.random.Generator:
    """A generator with a fixed seed, new for every test."""
    return np.random.default_rng(20240521)


@pytest.fixture
def catalogue_of_ours(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a test registers in the catalogue of effects is gone after it."""
    from longarm_comp.core.effects import catalogue

    monkeypatch.setattr(catalogue, "_others", {})


@pytest.fixture
def few_names() -> Iterator[None]:
    """A diagnosis in this test tries few names: its choice among all is not the question."""
    from few_effects import few_effects

    with few_effects():
        yield


@pytest.fixture(scope="module")
def few_names_here() -> Iterator[None]:
    """The same in all tests of a file."""
    from few_effects import few_effects

    with few_effects():
        yield


@pytest.fixture
def shell(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Shell:
    """The program ``longarm``, run in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return Shell(tmp_path, capsys)


@pytest.fixture(scope="session")
def once(tmp_path_factory: pytest.TempPathFactory) -> Once:
    """A folder by its name, filled once in a run, by whichever worker needs it first; read only."""
    of_worker = tmp_path_factory.getbasetemp()
    run = of_worker.parent if "PYTEST_XDIST_WORKER" in os.environ else of_worker

    def filled(name: str, fill: Callable[[Path], object]) -> Path:
        folder, done = run / name, run / f"{name}.done"
        with (run / f"{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not done.exists():
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir()
                fill(folder)
                done.touch()
        return folder

    return filled


@pytest.fixture(scope="session")
def work(once: Once) -> Path:
    """A folder with an arm, sessions, a model and a predictor; to be read only."""
    return once("work", made_by_commands)


@pytest.fixture(scope="session")
def reports(once: Once) -> Path:
    """The folders of a report a verdict; to be read only."""
    from report_pages import write_all

    return once("reports", write_all)


@pytest.fixture(scope="module")
def running_driver(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    """`servo_driver` on an emulated bus, one for all tests of a file."""
    from driver_rig import driver_rig

    with driver_rig(tmp_path_factory.mktemp("driver")) as made:
        yield made


@pytest.fixture
def rig(running_driver: Rig) -> Rig:
    """The driver, running and in order."""
    return running_driver.in_order()


@pytest.fixture
def fresh(running_driver: Rig) -> Rig:
    """A new driver that nobody has stopped, ready."""
    return running_driver.anew()


@pytest.fixture
def ros_domain(tmp_path: Path) -> Iterator[int]:
    """A ROS graph of this test's own: set in the environment, so child processes share it."""
    with own_graph(tmp_path) as domain:
        yield domain


@pytest.fixture
def stage(ros_domain: int) -> Iterator[Bench]:
    """Processes of nodes on this test's own graph."""
    from nodes_bench import bench

    with bench() as made:
        yield made
