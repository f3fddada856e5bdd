"""Applies a diagnosis on a running graph: replaces its files, then has the nodes read them."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from std_srvs.srv import Trigger

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.errors import JobError
from longarm_comp.jobs.graph_client import FOUND_S, GraphClient, Interrupted
from longarm_comp.nodes import interfaces as graph
from longarm_comp.workflows.apply import Applied, apply, read_addition
from longarm_comp.workflows.inputs import Note, log_note
from longarm_comp.workflows.model_in_use import undo


@dataclass(frozen=True)
class FilesAtWork:
    """Files that a running graph reads; `predictor` is None if no `error_predictor` has a file."""

    arm: Path
    model: Path
    predictor: Path | None


def files_at_work(client: GraphClient) -> FilesAtWork:
    """Ask a graph for its files. Raises JobError if kinematics runs without a model file."""
    arm, model = client.parameters("kinematics", "arm", "model")
    if not model:
        reason = "kinematics runs without a model file: start it with --model FILE"
        raise JobError(f"{reason} (the file need not exist yet)")
    predictor = ""
    try:
        (predictor,) = client.parameters("error_predictor", "predictor", within_s=FOUND_S)
    except Interrupted:
        raise
    except JobError:  # none is running
        pass
    return FilesAtWork(Path(arm), Path(model), Path(predictor) if predictor else None)


def apply_on_graph(
    client: GraphClient, diagnosis: Path, *, network: bool = True, note: Note = log_note, **how: Any
) -> Applied:
    """Apply a diagnosis to the files of a running graph and have its nodes read them.

    The options are those of `workflows.apply.apply`. No predictor is trained if the graph has no
    file for one.

    Raises:
        InputError: the folder holds no diagnosis.
        JobError: the diagnosis adds nothing; kinematics has no model file; or a node did not read
            its new file. In the last case the change is undone.
    """
    read_addition(diagnosis)  # before the graph is waited for
    files = files_at_work(client)
    if network and files.predictor is None:
        note("no predictor is trained: error_predictor is not there or was started without a file")
    network = network and files.predictor is not None
    at_work = Arm.load(files.arm), files.model, files.predictor
    done = apply(diagnosis, *at_work, network=network, note=note, **how)
    try:
        reload(client, "kinematics")
        if done.predictor is not None:
            reload(client, "error_predictor")
    except JobError:
        undo(files.model, files.predictor)
        raise
    if (back := undo_command(done, files)) != done.undo:
        note(f"{back}: takes it back with its predictor, which is in another folder")
    return done


def undo_command(done: Applied, files: FilesAtWork) -> str:
    """Return the shell command that restores the version before, and its predictor."""
    if files.predictor is None or files.predictor.parent == files.model.parent:
        return done.undo
    return f"{done.undo} --predictor {files.predictor}"


def reload(client: GraphClient, node: str) -> None:
    """Have a node read its file again. Raises JobError if it does not take it up."""
    answer = client.ask(node, graph.RELOAD, Trigger.Request())
    if not answer.success:
        raise JobError(f"{node} did not take up its file: {answer.message}")
