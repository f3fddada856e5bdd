"""Kinematics and error compensation of long, compliant robot arms.

A model is a declared arm plus a list of effects, each a small twist at one frame::

    import longarm_comp as la

    arm = la.Arm.load("arm.yaml")
    session = la.read_session("samples.csv", arm)
    found = la.diagnose(arm, session)
    predictor = la.train(arm, session, model=found.model)
    commands = la.compensate(found.model, [[0.7, 0.1, 0.4]], predictor)

Names are imported when they are first used (PEP 562): importing this package imports nothing heavy.
`docs/python.md` says what each returns.
"""

from longarm_comp.version import __version__ as __version__

_MODULE_OF = {
    "Arm": "core.arm.arm",
    "Context": "core.arm.context",
    "InputError": "core.errors",
    "JobError": "core.errors",
    "LongarmError": "core.errors",
    "Model": "core.model.model",
    "Monitor": "core.compensation.drift",
    "Session": "core.data.session",
    "calibrate": "workflows.calibrate",
    "compensate": "workflows.compensate",
    "compensate_path": "workflows.compensate_path",
    "declared_model": "core.model.declared_model",
    "diagnose": "workflows.diagnose",
    "effects": "core.effects.catalogue",
    "evaluate": "workflows.evaluate",
    "import_table": "workflows.inputs",
    "load_model": "core.model.model_file",
    "load_predictor": "workflows.inputs",
    "plan": "workflows.plan",
    "read_session": "sessions.read",
    "read_targets": "sessions.targets",
    "train": "workflows.train",
    "write_poses": "sessions.poses",
}
__all__ = sorted(_MODULE_OF)

TYPE_CHECKING = False  # as in `typing`, which costs more than the rest of this file
if TYPE_CHECKING:
    from longarm_comp.core.arm.arm import Arm as Arm
    from longarm_comp.core.arm.context import Context as Context
    from longarm_comp.core.compensation.drift import Monitor as Monitor
    from longarm_comp.core.data.session import Session as Session
    from longarm_comp.core.effects import catalogue as effects  # noqa: F401
    from longarm_comp.core.errors import InputError as InputError
    from longarm_comp.core.errors import JobError as JobError
    from longarm_comp.core.errors import LongarmError as LongarmError
    from longarm_comp.core.model.declared_model import declared_model as declared_model
    from longarm_comp.core.model.model import Model as Model
    from longarm_comp.core.model.model_file import load_model as load_model
    from longarm_comp.sessions.poses import write_poses as write_poses
    from longarm_comp.sessions.read import read_session as read_session
    from longarm_comp.sessions.targets import read_targets as read_targets
    from longarm_comp.workflows.calibrate import calibrate as calibrate
    from longarm_comp.workflows.compensate import compensate as compensate
    from longarm_comp.workflows.compensate_path import compensate_path as compensate_path
    from longarm_comp.workflows.diagnose import diagnose as diagnose
    from longarm_comp.workflows.evaluate import evaluate as evaluate
    from longarm_comp.workflows.inputs import import_table as import_table
    from longarm_comp.workflows.inputs import load_predictor as load_predictor
    from longarm_comp.workflows.plan import plan as plan
    from longarm_comp.workflows.train import train as train
else:

    def __getattr__(name):
        """Import a name of the list when it is first used."""
        if name not in _MODULE_OF:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        from importlib import import_module

        module = import_module(f"{__name__}.{_MODULE_OF[name]}")
        found = module if name == "effects" else getattr(module, name)
        globals()[name] = found
        return found


def __dir__() -> list[str]:
    """Return the names of the package, whether they were imported already or not."""
    return sorted({*globals(), *__all__})
