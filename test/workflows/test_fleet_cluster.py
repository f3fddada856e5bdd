"""`longarm fleet --dask`: two workers, arms that fail, a task that ends its workers."""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from click.testing import CliRunner
from cluster_tasks import ends_its_worker, process_of
from fleet_arms import arm_yaml, rows_of

from longarm_comp.cli.diagnose import fleet as command
from longarm_comp.core.errors import InputError, JobError
from longarm_comp.core.files import write_text
from longarm_comp.sessions.csv import write_csv
from longarm_comp.workflows import cluster
from longarm_comp.workflows.fleet import fleet
from studies.fleet import command as study

if TYPE_CHECKING:
    from dask import distributed

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("distributed") is None,
    reason="dask is not installed: pip install 'longarm_comp[cluster]'",
)


@pytest.fixture(scope="module")
def two() -> Iterator[distributed.LocalCluster]:
    from dask import distributed  # a third of a second, for each worker of pytest

    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=":0", memory_limit=None
    ) as made:
        yield made


@pytest.fixture
def arms(tmp_path: Path) -> Path:
    """Two arms that can be diagnosed, one with a broken session and one with a broken file."""
    root = tmp_path / "arms"
    for number, name in enumerate(("a", "b", "no_rows", "no_arm")):
        arm_yaml(root / name)
        write_csv(rows_of(0.003 * number, 20 + number, n=30), root / name / "rows.csv")
    (root / "no_rows" / "rows.csv").write_text("q1,q2,q3,q4,x,y,z\n1,2,3,4,5,6,7\n")
    (root / "no_arm" / "arm.yaml").write_text("joints: 3\n")
    return root


@pytest.mark.long
def test_it_says_what_one_process_says_and_goes_on(
    arms: Path, two: distributed.LocalCluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = fleet(arms, tmp_path / "here", network=False)
    assert [a.name for a in here if a.verdict == "failed"] == ["no_arm", "no_rows"]
    monkeypatch.chdir(tmp_path)  # where workers are not
    seen: list[tuple[str, float]] = []

    def go_on() -> list[str]:
        seen.clear()
        address = two.scheduler_address
        told = fleet(
            Path("arms"), Path("there"), network=False, dask=address,
            progress=lambda name, share: seen.append((name, share)),
        )  # fmt: skip
        assert told == here
        return sorted(name for name, _ in seen)

    assert go_on() == ["a", "b", "no_arm", "no_rows"]
    assert [share for _, share in seen] == pytest.approx([0.25, 0.5, 0.75, 1.0])
    assert (tmp_path / "there" / "b" / "report.html").is_file()
    file = tmp_path / "there" / "fleet.json"
    held = json.loads(file.read_text("utf-8"))
    held["arms"] = [arm for arm in held["arms"] if arm["name"] != "b"]
    write_text(file, json.dumps(held))
    assert go_on() == ["b", "no_arm", "no_rows"]


def test_a_task_that_ends_its_workers_is_one_failure(
    two: distributed.LocalCluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(two.scheduler, "allowed_failures", 0)  # a new worker takes seconds
    tasks = [(n,) for n in range(8)]
    told = dict(
        cluster.run_tasks(
            ends_its_worker, tasks, two.scheduler_address, workers=1, asked="longarm fleet"
        )
    )
    failed = told.pop((2,))
    assert isinstance(failed, JobError) and "worker died" in str(failed)
    assert told == {(n,): 10 * n for n in range(8) if n != 2}


def test_a_scheduler_that_goes_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    from dask import distributed

    made = distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=":0")
    told = cluster.run_tasks(
        time.sleep, [(0.0,), (60.0,)], made.scheduler_address, workers=1, asked="fleet"
    )
    assert next(told) == ((0.0,), None)
    made.close()
    with pytest.raises(JobError, match="lost"):
        next(told)


def test_without_a_scheduler_a_worker_or_dask_it_is_refused(
    arms: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from dask import distributed

    monkeypatch.setattr(cluster, "ANSWER_S", 0.5)
    monkeypatch.setattr(cluster, "WORKER_S", 0.5)
    out = tmp_path / "out"
    for address in ("no scheduler", "tcp://127.0.0.1:9"):
        with pytest.raises(InputError, match=r"fleet: --dask: .*allowed: a scheduler"):
            fleet(arms, out, network=False, dask=address)
    with (
        distributed.LocalCluster(n_workers=0, dashboard_address=":0") as none,
        pytest.raises(JobError, match="has no worker"),
    ):
        fleet(arms, out, network=False, dask=none.scheduler_address)
    assert not (out / "fleet.json").exists()
    code = "import sys; sys.modules['dask'] = None; from longarm_comp.cli.run import run; "
    words = ["fleet", str(arms), "-o", str(out), "--dask", "local"]
    done = subprocess.run(
        [sys.executable, "-c", f"{code}sys.exit(run({words!r}))"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 2 and "pip install 'longarm_comp[cluster]'" in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_local_is_so_many_processes() -> None:
    told = list(cluster.run_tasks(process_of, [(0.5,)] * 6, "local", workers=2, asked="fleet"))
    assert len(told) == 6
    processes = {made for _, made in told}
    assert len(processes) == 2 and os.getpid() not in processes


@pytest.mark.long  # test_no_code_from_data.py runs the command on two arms that it refuses
def test_a_cluster_of_the_command_itself(arms: Path, tmp_path: Path) -> None:
    shutil.rmtree(arms / "a")
    words = [str(arms), "-o", str(tmp_path / "out"), "--no-network", "--json"]
    done = CliRunner().invoke(command, [*words, "--dask", "local", "--jobs", "2"])
    assert done.exit_code == 0, (done.output, done.exception)
    verdicts = {row["name"]: row["verdict"] for row in json.loads(done.stdout)["arms"]}
    assert len(verdicts) == 3 and [n for n, v in verdicts.items() if v == "failed"] == [
        "no_arm", "no_rows",
    ]  # fmt: skip


@pytest.fixture(scope="module")
def of_the_study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("many")


@pytest.mark.long
@pytest.mark.parametrize("count", range(25, 201, 25))
def test_two_hundred_simulated_arms(count: int, of_the_study: Path) -> None:
    """On two workers, each call going on after the last."""
    words = ["--arms", str(count), "-o", str(of_the_study), "--json"]
    done = CliRunner().invoke(study, [*words, "--dask", "local", "--jobs", "2"])
    assert done.exit_code == 0, (done.output, done.exception)
    (told,) = json.loads(done.stdout)["fleets"]
    assert (told["arms"], told["failed"]) == (count, 0)
    assert told["kind_found"] > 0.9 and told["another_name"] < 0.05
    assert told["diagnosed_mm"] < 0.3 * told["calibrated_mm"]
    assert told["peak_mb"] > 50 and told["worker_mb"] > 50
