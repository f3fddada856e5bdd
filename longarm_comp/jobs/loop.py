"""The loop: drive targets, collect, diagnose, ask, apply, train, drive again; repeat if it pays."""

import json
import math
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from longarm_comp.core.compensation.result import Method
from longarm_comp.core.errors import InputError
from longarm_comp.core.files import write_text
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.jobs.apply import FilesAtWork, apply_on_graph, files_at_work, undo_command
from longarm_comp.jobs.client import ArmClient, Pace
from longarm_comp.jobs.collect.run import collect
from longarm_comp.jobs.collect.visits import list_visits
from longarm_comp.jobs.loop_plan import plan_round
from longarm_comp.jobs.targets import (
    Say,
    TargetRunner,
    Trial,
    Witness,
    at_random,
    choose_targets,
    method_at_work,
)
from longarm_comp.report.pages import loop_page
from longarm_comp.report.record import DiagnosisReport, read_report
from longarm_comp.sessions.poses import FILE as NEXT_POSES
from longarm_comp.sessions.poses import write_poses
from longarm_comp.workflows.apply import nothing_to_apply, take_back
from longarm_comp.workflows.diagnose import diagnose_files
from longarm_comp.workflows.verification import error_row

NEAR_NOISE = 2.0
"""The loop ends at a mean error below this many times the mean error that noise alone causes."""

RULE = (
    "another round follows if the last one brought the tip nearer by more than chance and the mean "
    f"error is still more than {NEAR_NOISE:g} times what the noise of the measurement alone shows"
)


def another_round(
    gain_ci95_m: tuple[float, float], mean_m: float, sigma_m: tuple[float, float, float]
) -> tuple[bool, str]:
    """Tell by `RULE` whether another round should follow, and say why.

    Args:
        gain_ci95_m: 95 % interval of the decrease of the mean error by the last round.
        mean_m: mean error after it.
        sigma_m: noise of a sighting along x, y, z.
    """
    rms = math.sqrt(sum(s * s for s in sigma_m) / 3.0)
    alone = math.sqrt(8.0 / math.pi) * rms  # mean length of a normal vector in three dimensions
    shown = f"the mean error is {1e3 * mean_m:.3f} mm, the noise alone shows {1e3 * alone:.3f} mm"
    if gain_ci95_m[0] <= 0.0:
        return False, f"this round did not bring the tip nearer by more than chance; {shown}"
    if mean_m <= NEAR_NOISE * alone:
        return False, f"the error that is left is near the noise: {shown}"
    return True, f"the error that is left is more than noise: {shown}"


@dataclass(frozen=True)
class Names:
    """Names of the runs over the targets; ``{k}`` is replaced by the number of the round."""

    without: str = "not compensated"
    before: str = "before"
    found: str = "round {k}: effects found"
    learned: str = "round {k}: effects found + network"


@dataclass(frozen=True)
class LoopSettings:
    """The settings of a loop."""

    out: Path
    rounds: int = 3  # at most
    poses: int = 180  # to measure in a round
    targets: int = 40  # fresh ones, by which the gain is judged
    network: bool = True  # a predictor is trained in every round
    seed: int = 1
    pace: Pace = field(default_factory=Pace)
    names: Names = field(default_factory=Names)

    def __post_init__(self) -> None:
        # With fewer poses the diagnosis cannot weigh a library of some 170 parameters
        for name, least in (("rounds", 1), ("poses", 60), ("targets", 2)):
            if (given := getattr(self, name)) < least:
                raise InputError("loop", f"--{name}", given, f"at least {least}")

    def path(self, what: str, k: int) -> Path:
        """Return a file or folder of round k: ``session``, ``session_2``, ..."""
        name, dot, ending = what.partition(".")
        return self.out / (what if k == 1 else f"{name}_{k}{dot}{ending}")

    def facts(self) -> dict[str, Any]:
        """Return the settings that a resumed loop must keep: all but the folder and ``rounds``."""
        return {k: v for k, v in asdict(self).items() if k not in ("out", "rounds")}


_TRIAL = ("target", "seen", "true", "status")
_CHANGE = ("what", "where", "kind", "tip_mm")


class Journal:
    """A file of step results by name, saved after every step, so that a run can be resumed.

    ``facts`` are the settings of the run; a resumed run must have the same ones.
    """

    def __init__(self, path: Path, facts: dict[str, Any], *, resume: bool) -> None:
        self._path = path
        self._steps: dict[str, Any] = {"settings": facts}
        if not path.is_file():
            return
        if not resume:
            raise InputError(path, "file", "exists", "a new folder, or --resume")
        try:
            self._steps = json.loads(path.read_text(encoding="utf-8"))
            begun = dict(self._steps["settings"])
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(path, "json", str(error), "a file that longarm loop wrote") from error
        for name, value in facts.items():
            if begun.get(name) != value:
                raise InputError(path, name, value, f"{begun.get(name)}, as in the first call")

    def __contains__(self, step: str) -> bool:
        return step in self._steps

    def once(self, step: str, make: Callable[[], Any]) -> Any:
        """Return the saved result of a step (plain data); without one, call `make` and save it."""
        if step not in self._steps:
            self._steps[step] = make()
            write_text(self._path, json.dumps(self._steps))
        return self._steps[step]

    def trial(self, step: str, make: Callable[[], Trial]) -> Trial:
        """Return the saved run over targets of a step; without one, call `make` and save it."""

        def plain() -> dict[str, Any]:
            trial = make()
            return {"name": trial.name, **{k: getattr(trial, k).tolist() for k in _TRIAL}}

        data = self.once(step, plain)
        return Trial(data["name"], *(np.array(data[name]) for name in _TRIAL))


class Loop:
    """Rounds of collecting, diagnosing, applying and driving targets again, on a running graph.

    ``agree`` shows a diagnosis and tells whether to apply it. ``witness`` is another instrument
    that measures the tip.
    """

    def __init__(
        self,
        client: ArmClient,
        settings: LoopSettings,
        agree: Callable[[DiagnosisReport], bool],
        *,
        witness: Witness | None = None,
        resume: bool = False,
        say: Say = lambda text, share: None,
    ) -> None:
        self._client, self._settings, self._agree, self._say = client, settings, agree, say
        self._runner = TargetRunner(client, settings.pace, witness)
        self._journal = Journal(settings.out / "steps.json", settings.facts(), resume=resume)
        self._seconds: dict[str, float] = {}
        self._begun = time.monotonic()

    def run(self, ready_s: float = 30.0) -> tuple[list[Trial], dict[str, Any]]:
        """Run rounds of the loop while `RULE` holds; write loop.json and loop.html.

        Returns:
            All runs over the targets, the first not compensated; and what loop.json holds.

        Raises:
            InputError: the graph's model file is in the loop's folder for the diagnosis.
        """
        client, names = self._client, self._settings.names
        client.ready(ready_s)
        declared = declared_model(client.arm)
        self._runner.ready(declared.tip(client.arm.mid), ready_s)
        files = files_at_work(client)
        if files.model.resolve().parent == self._settings.path("diagnosis", 1).resolve():
            raise InputError(files.model, "model", "in the loop's folder", "another folder")
        method = method_at_work(client)
        self._time_step("bring_up")
        learned = files.predictor is not None and files.predictor.is_file()
        now = method if learned else Method.DEFLECTION

        def draw_targets() -> dict[str, Any]:
            settings = self._settings
            draw = at_random(declared, np.random.default_rng(settings.seed + 1))
            kept, left = choose_targets(self._runner, draw, settings.targets, (Method.NONE, now))
            refused = [{"target": xyz.tolist(), "why": why} for xyz, why in left]
            return {"xyz": kept.tolist(), "refused": refused}

        chosen = self._journal.once("targets", draw_targets)
        targets = np.array(chosen["xyz"])
        trials = [
            self._drive_phase(names.without, targets, Method.NONE),
            self._drive_phase(names.before, targets, now),
        ]
        rounds: list[dict[str, Any]] = []
        while len(rounds) < self._settings.rounds and (not rounds or rounds[-1]["again"]):
            rounds.append(self._run_round(len(rounds) + 1, files, targets, method, trials))
        return trials, self._write_result(files, chosen["refused"], trials, rounds)

    def _drive_phase(self, name: str, targets: np.ndarray, method: Method) -> Trial:
        run = partial(self._runner.run, name, targets, method, self._say)
        trial = self._journal.trial(f"run: {name}", run)
        self._time_step(name)
        return trial

    def _run_round(
        self, k: int, files: FilesAtWork, targets: np.ndarray, method: Method, trials: list[Trial]
    ) -> dict[str, Any]:
        """Run round k (from 1), add its runs to `trials`, and return its entry in loop.json."""
        names = self._settings.names
        measured = self._journal.once(f"measured {k}", partial(self._collect_rows, k))
        self._time_step(f"collect_{k}")
        found = self._journal.once(f"diagnosed {k}", partial(self._diagnose_rows, k, files))
        self._time_step(f"diagnose_{k}")
        folder = self._settings.path("diagnosis", k)
        report = read_report(folder)

        made = {
            "number": k,
            "collected": measured["made"],
            "not_driven": measured["not_driven"],
            "verdict": report.verdict,
            "found": report.summary,
            "effects_found": found,
            "changes": [],
            "applied": None,
            "gain": None,
            "again": False,
            "session": str(self._settings.path("session", k)),
            "diagnosis": str(folder),
            "report": str(Path(folder.name) / "report.html"),
        }
        if nothing := nothing_to_apply(report):
            return {**made, "why": f"nothing to apply: {nothing}"}
        if f"applied {k}" not in self._journal and not self._agree(report):
            return {**made, "why": "not applied: there was no answer yes"}
        applied = self._journal.once(f"applied {k}", partial(self._apply_model, k, files))
        self._time_step(f"train_{k}")
        before = trials[-1]
        trials.append(self._drive_phase(names.found.format(k=k), targets, Method.DEFLECTION))
        if applied["predictor"] is not None:
            trials.append(self._drive_phase(names.learned.format(k=k), targets, method))
        gain = trials[-1].against(before)
        x, y, z = (1e-3 * s for s in report.noise.sigma_mm or (0.0, 0.0, 0.0))
        mean = float(np.linalg.norm(trials[-1].error, axis=1).mean())
        again, why = another_round(gain.gain_ci95_m, mean, (x, y, z))
        told = {"changes": applied["changes"], "applied": applied, "gain": gain.summary}
        return {**made, **told, "again": again, "why": why}

    def _collect_rows(self, k: int) -> dict[str, Any]:
        settings, seed = self._settings, self._settings.seed + k - 1
        asked = settings.path("diagnosis", k - 1) / NEXT_POSES if k > 1 else None
        plan, not_driven = plan_round(self._client, settings.poses, seed, asked)
        write_poses(plan, settings.path("poses.csv", k))
        repeats = min(5, settings.poses // 10)
        bag = settings.path("session", k)
        done = collect(
            self._client,
            list_visits(plan, self._client.arm, repeats=repeats, seed=seed),
            bag,
            pace=settings.pace,
            resume=bag.exists(),
            progress=lambda now: self._say(str(now), now.share),
        )
        blocked = Counter(f"no way there: {why.partition(':')[0]}" for why in done.blocked.values())
        return {"made": done.made + done.before, "not_driven": {**not_driven, **blocked}}

    def _diagnose_rows(self, k: int, files: FilesAtWork) -> list[list[str]]:
        model = files.model if files.model.is_file() else None
        result = diagnose_files(
            self._client.arm,
            self._settings.path("session", k),
            self._settings.path("diagnosis", k),
            model=model,
            network=False,
            seed=self._settings.seed,
            progress=lambda step: self._say(f"diagnose: {step}", 0.3),
        )
        # Each effect, what cannot be told from it, and what could stand for a part of it
        each = ((*f.names, *(a.name for a in f.partial_aliases)) for f in result.findings)
        return [list(dict.fromkeys(names)) for names in each]

    def _apply_model(self, k: int, files: FilesAtWork) -> dict[str, Any]:
        settings = self._settings
        take_back(settings.path("diagnosis", k), files.model, files.predictor)
        done = apply_on_graph(
            self._client,
            settings.path("diagnosis", k),
            session=settings.path("session", k),
            network=settings.network,
            seed=settings.seed,
            progress=lambda text, share: self._say(f"train: {text}", 0.6 + 0.4 * share),
        )
        return {
            "model": str(done.model),
            "version": done.version,
            "predictor": None if done.predictor is None else str(done.predictor),
            "network_refused": done.refused,
            "undo": undo_command(done, files),
            "changes": [
                {"text": str(c)} | {name: getattr(c, name) for name in _CHANGE}
                for c in done.changes
            ],
        }

    def _time_step(self, step: str) -> None:
        now = time.monotonic()
        self._seconds[step], self._begun = now - self._begun, now

    def _write_result(
        self,
        files: FilesAtWork,
        refused: list[dict[str, Any]],
        trials: list[Trial],
        rounds: list[dict[str, Any]],
    ) -> dict[str, Any]:
        page = self._settings.out / "loop.html"
        structure = read_report(Path(rounds[-1]["diagnosis"])).structure_left
        left = "The last diagnosis found no structure in the residual of its session."
        if structure.flag:
            left = f"Of the last diagnosis: {structure.text}; no effect of the library explains it."
        gains = [trial.against(trials[0]) for trial in trials[1:]]
        intervals = [[None, None], *([1e3 * g for g in gain.gain_ci95_m] for gain in gains)]
        rows = [
            {**error_row(t.name, t.error), "gain_ci95_mm": interval, "refused": t.refused_count}
            for t, interval in zip(trials, intervals, strict=True)
        ]
        data = {
            "arm": self._client.arm.name,
            "rows": rows,
            "helps": gains[-1].helps,
            "summary": gains[-1].summary,
            "rule": RULE,
            "ended": rounds[-1]["why"],
            "rounds": rounds,
            "left": left,
            "refused": refused,
            "files": {
                "model": str(files.model),
                "predictor": None if files.predictor is None else str(files.predictor),
                "page": str(page),
            },
            "undo": next((r["applied"]["undo"] for r in reversed(rounds) if r["applied"]), None),
            "seconds": {**self._seconds, "total": sum(self._seconds.values())},
        }
        write_text(self._settings.out / "loop.json", json.dumps(data, indent=2))
        write_text(page, loop_page(data, {t.name: t.error for t in trials}))
        return data
