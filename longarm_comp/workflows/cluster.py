"""Runs work on the workers of a dask cluster; needs the extra ``cluster``.

joblib's backend for dask is not used, because it waits forever for a task whose worker died.
"""

import logging
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import ExitStack
from typing import Any, TypeVar

from longarm_comp.core.errors import InputError, JobError
from longarm_comp.core.processes import starting_workers

ANSWER_S, WORKER_S = 20.0, 60.0
"""Times (s) within which a scheduler must answer, and have a worker."""

Task = TypeVar("Task", bound=tuple)
Made = TypeVar("Made")


def run_tasks(
    work: Callable[..., Made], tasks: Sequence[Task], address: str, *, workers: int, asked: str
) -> Iterator[tuple[Task, Made | JobError]]:
    """Run tasks on the workers of a cluster; yield each task with its result when it is done.

    The result is a `JobError` if every worker that was given the task died.

    Args:
        work: called with a task's items. An exception in it is raised here.
        address: address of a scheduler (``tcp://host:8786``), or ``local`` for one that lasts for
            this call.
        workers: number of processes of ``local``.
        asked: the command, for its error messages.

    Raises:
        InputError: dask is not installed, or its scheduler not found.
        JobError: the scheduler has no worker, or is lost.
    """
    try:
        from dask import config
        from dask.distributed import Client, KilledWorker, LocalCluster, as_completed
    except ImportError:
        wanted = "pip install 'longarm_comp[cluster]'"
        raise InputError(asked, "--dask", "not installed", wanted) from None
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # tracebacks of what is told
    with ExitStack() as stack:
        target: Any = address
        if address == "local":
            kept = {"distributed.nanny.pre-spawn-environ.PYTHONSAFEPATH": "1"}  # when started again
            with config.set(kept), starting_workers():
                own = LocalCluster(
                    n_workers=workers,
                    threads_per_worker=1,
                    dashboard_address=":0",
                    silence_logs=logging.ERROR,
                )
            target = stack.enter_context(own)
        try:
            client = stack.enter_context(Client(target, timeout=ANSWER_S))
        except (OSError, ValueError) as error:
            raise InputError(asked, "--dask", address, f"a scheduler ({error})") from error
        try:
            client.wait_for_workers(1, timeout=WORKER_S)
        except TimeoutError as error:
            raise JobError(f"{asked}: the scheduler {address} has no worker") from error
        begun = {client.submit(work, *task, pure=False): task for task in tasks}
        suspects: list[Task] = []
        try:
            for future in as_completed(list(begun)):
                task = begun.pop(future)  # with the last of its futures the cluster drops a result
                try:
                    yield task, future.result()
                except KilledWorker:
                    suspects.append(task)
            for task in suspects:  # some died of another that was beside them: alone they do not
                try:
                    yield task, client.submit(work, *task, pure=False).result()
                except KilledWorker as error:
                    yield task, JobError(f"every worker died that was given it ({error})")
        except CancelledError as error:
            raise JobError(f"{asked}: the scheduler {address} was lost: call again") from error
