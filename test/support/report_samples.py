"""Made-up but consistent diagnoses, one a verdict, for the tests of the report."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from longarm_comp.report.detail import Detail, Input, Marked, PageTable, SeenRows, SetSplit

Diagnosis = tuple[dict[str, Any], Detail]

JOINTS = tuple(f"q{k}" for k in range(1, 8))
UNITS = ("rad", "rad", "rad", "rad", "rad", "m", "m")
SIGMA_MM = (0.4, 0.4, 0.5)
LINKS_M = (0.12, 0.35, 0.25, 0.18, 0.12)


def centre_line(q: np.ndarray) -> np.ndarray:
    """(6, 3) a serial arm that turns about z first and then bends upwards, m."""
    bend = np.cumsum(0.5 * q[1:6] + 0.15)
    along = np.cumsum(np.array(LINKS_M) * np.cos(bend))
    up = 0.2 + np.cumsum(np.array(LINKS_M) * np.sin(bend))
    line = np.column_stack([along * np.cos(q[0]), along * np.sin(q[0]), up])
    return np.vstack([[0, 0, 0], [0, 0, 0.2], line])


def held_out_rows(rng: np.random.Generator) -> SeenRows:
    """Errors that fall from stage to stage; what is left before the effect follows q2's side."""
    n = 60
    q = rng.uniform(-1, 1, (n, 7)) * np.array([1.5, 0.9, 0.9, 0.7, 0.6, 0.05, 0.03])
    q[:, 5:] += (0.05, 0.03)
    approach = np.where(rng.random(n) < 0.5, -1.0, 1.0)
    lines = [centre_line(row) for row in q]
    noise = rng.normal(0, SIGMA_MM, (n, 3)) * 1e-3
    sag = np.column_stack(
        [0.004 * np.sin(q[:, 0]), 0.004 * np.cos(q[:, 0]), -0.015 - 0.01 * q[:, 1]]
    )
    lash = 0.0025 * approach[:, None] * np.column_stack([np.sin(q[:, 0]), np.cos(q[:, 0]), q[:, 1]])
    errors = {
        "nominal": sag + lash + noise,
        "frames_only": 0.5 * sag + lash + noise,
        "calibrated": 0.05 * sag + lash + noise,
        "with_effects": 0.05 * sag + noise,
        "with_network": 0.02 * sag + noise,
    }
    inputs = [
        Input(name, unit, q[:, k]) for k, (name, unit) in enumerate(zip(JOINTS, UNITS, strict=True))
    ]
    inputs += [
        Input("approach", "", approach),
        Input("temperature_c", "°C", 20 + 3 * rng.random(n)),
    ]
    return SeenRows(
        np.arange(240, 240 + n),
        np.array([line[-1] for line in lines]),
        errors,
        tuple(inputs),
        tuple(lines[:: max(1, n // 5)]),
    )


def error_rows(rows: SeenRows) -> list[dict[str, Any]]:
    """The table of report.json from the errors."""
    made: list[dict[str, Any]] = []
    for stage, error in rows.errors_m.items():
        length = np.linalg.norm(error, axis=1) * 1e3
        rms = float(np.sqrt((length**2).mean()))
        made.append(
            {
                "model": stage,
                "mean_mm": float(length.mean()),
                "commanded_mean_mm": float(length.mean()),
                "rms_mm": rms,
                "p95_mm": float(np.percentile(length, 95)),
                "max_mm": float(length.max()),
                "mean_abs_z_mm": float(np.abs(error[:, 2]).mean() * 1e3),
                "variance_mm2": float(error.var(axis=0).mean() * 1e6),
                "excess_mm": float(np.sqrt(max(0.0, rms**2 - np.square(SIGMA_MM).sum()))),
                "mean_mrad": None,
            }
        )
    return made


def held_out(
    rows: SeenRows | None, before: str | None, after: str | None, ci95: list[float] | None
) -> dict[str, Any]:
    """What report.json says of the hold-out, where a command has what is seen."""
    return {
        "n": 0 if rows is None else len(rows.index),
        "rows": [] if rows is None else error_rows(rows),
        "before": before,
        "after": after,
        "before_after_ci95_mm": ci95,
        "commanded_ci95_mm": ci95,
        "not_commanded": [],
    }


def candidates(accepted: Mapping[tuple[str, str], float]) -> list[dict[str, Any]]:
    """Fifty-odd candidates; those named are accepted with their score."""
    made: list[dict[str, Any]] = [
        {
            "effect": e,
            "where": w,
            "log_bayes_factor": s,
            "state": "accepted",
            "why": "accepted first",
        }
        for (e, w), s in accepted.items()
    ]
    joints = [f"joint {k}" for k in range(1, 8)]
    families = (
        *("backlash", "friction_hysteresis", "joint_compliance", "bearing_tilt"),
        *("gear_eccentricity", "joint_gain", "servo_droop"),
    )
    for f, effect in enumerate(families):
        for k, where in enumerate(joints):
            if (effect, where) not in accepted:
                made.append(
                    {
                        "effect": effect,
                        "where": where,
                        "log_bayes_factor": round(3.1 - 1.3 * k - 0.7 * f, 3),
                        "state": "rejected" if (f + k) % 4 else "invisible",
                        "why": "below the 6.9 that acceptance asks for"
                        if (f + k) % 4
                        else "geometry takes up 99 % of it",
                    }
                )
    made.sort(key=lambda row: (-row["log_bayes_factor"], row["effect"], row["where"]))
    for effect, missing in (
        ("measured_tilt", "inclinometer"),
        ("creep", "time"),
        ("tip_payload", "payload"),
    ):
        made.append(
            {
                "effect": effect,
                "where": "arm",
                "log_bayes_factor": None,
                "state": "not_testable",
                "why": f"the session has no {missing}",
            }
        )
    return made


def base(rng: np.random.Generator) -> Diagnosis:
    """A diagnosis that found nothing."""
    rows = held_out_rows(rng)
    held = {stage: rows.errors_m[stage] for stage in ("nominal", "frames_only", "calibrated")}
    rows = SeenRows(rows.index, rows.measured_m, held, rows.inputs, rows.arms_m)
    report = {
        "schema": "longarm/diagnosis/1",
        "verdict": "noise",
        "summary": "Nothing beyond the noise of 0.43 mm per axis: no effect was added.",
        "findings": [],
        "candidates": candidates({}),
        "structure_left": {
            "flag": False,
            "text": "",
            "p_value": 0.41,
            "share_explained": None,
            "inputs": [],
            "size_mm": None,
        },
        "noise": {"sigma_mm": list(SIGMA_MM), "source": "repeats", "rho": 0.03},
        "held_out": held_out(rows, "nominal", "calibrated", None),
        "proof": {"folds": 5, "rows": 240, "passed": True, "why": ""},
        "set_aside": {"rows": 2, "share": 0.008, "shared_by": []},
        "next_poses": [],
        "outliers": [
            {"index": 17, "why": "31 mm off, 58 standard deviations", "point": "P17"},
            {"index": 203, "why": "12 mm off, 22 standard deviations", "point": ""},
        ],
        "discovered": [],
        "none_of_these": 0.59,
        "written": {
            "model": "calibrated",
            "expected_commanded_mm": {"calibrated": 0.71},
            "believed_mm": None,
        },
        "doubtful": [],
        "called": {},
        "provenance": {
            "seed": 7,
            "data_sha256": "9f86d081884c7d659a2feaa0c55ad015a3bf4f1b2b0b822cd15d6c15b0f00a08",
            "version": "0.1.0",
            "holdout_uses": ["9f86d081884c7d65"],
            "model_given": False,
        },
    }
    detail = Detail(
        title="samples.csv, arm of 7 joints",
        held_out=rows,
        detectable=PageTable(
            "Smaller ones may exist.",
            ("Effect", "Where", "Parameter", "Size", "Unit", "At the tip, mm RMS"),
            (
                ("backlash", "joint 2", "gap", 0.0004, "rad", 0.31),
                ("joint_compliance", "joint 2", "compliance", 2.1e-5, "rad/(N m)", 0.35),
                ("gear_eccentricity", "joint 6", "amplitude", None, "not excited", None),
            ),
        ),
        provenance={"Session": "samples.csv", "numpy": "2.2.1"},
    )
    return report, detail


def noise(rng: np.random.Generator) -> Diagnosis:
    """Nothing found."""
    return base(rng)


def named(rng: np.random.Generator) -> Diagnosis:
    """One effect named and proven."""
    report, detail = base(rng)
    rows = held_out_rows(rng)
    report |= {
        "verdict": "named",
        "summary": "backlash at joint 2: gap 0.0071 rad (95 % CI 0.0066 to 0.0077), log Bayes"
        " factor 214.6, runner-up friction_hysteresis at joint 2 with odds of 1 : 10^34.",
        "findings": [
            {
                "effect": "backlash",
                "title": "play",
                "reading": "",
                "set": ["backlash"],
                "probability": 0.9999,
                "set_probability": {"backlash": 0.9999},
                "unnamed": "",
                "where": ["joint 2"],
                "log_bayes_factor": 214.6,
                "parameters": [
                    {
                        "name": "gap",
                        "where": "joint 2",
                        "value": 0.0071,
                        "unit": "rad",
                        "ci95": [0.0066, 0.0077],
                        "prior_scale": 0.004,
                    },
                    {
                        "name": "threshold",
                        "where": "joint 2",
                        "value": 1.4,
                        "unit": "N m",
                        "ci95": [-0.2, 2.6],
                        "prior_scale": 2.0,
                    },
                ],
                "runner_up": {"effect": "friction_hysteresis", "log_bayes_factor": 136.2},
                "compensated": True,
                "tip_mm": {"median": 2.4, "max": 3.9},
                "seen_mm": [2.41, 0.71],
                "commanded_mm": [2.41, 0.71],
                "doubts": ["servo_droop could stand for its deadband"],
                "action": "Tighten or replace the gear, coupling or clamp of the joint.",
            }
        ],
        "candidates": candidates({("backlash", "joint 2"): 214.6}),
        "held_out": held_out(rows, "calibrated", "with_effects", [1.42, 1.93]),
        "written": {
            "model": "with_effects",
            "expected_commanded_mm": {"calibrated": 2.61, "with_effects": 0.71},
            "believed_mm": None,
        },
    }
    report["structure_left"] = report["structure_left"] | {"share_explained": 0.97}
    line = rows.arms_m[0]
    detail = Detail(
        title="samples.csv, arm of 7 joints",
        held_out=rows,
        marked=(Marked(line, {"joint 2": line[2]}),),
        guilty=("approach", "q2"),
        correlation=PageTable(
            "Strongest correlations of every parameter",
            ("Parameter", "Geometry (correlation)"),
            (("backlash joint 2 gap", "dh_error joint 1 a (+0.41), dh_error joint 3 d (−0.22)"),),
        ),
        detectable=detail.detectable,
        provenance=detail.provenance,
    )
    return report, detail


def a_set(rng: np.random.Generator) -> Diagnosis:
    """Effects that cannot be told apart on these poses."""
    report, detail = named(rng)
    poses = [list(map(float, row)) for row in rng.uniform(-0.5, 0.5, (6, 7))]
    finding = report["findings"][0]
    members = ["backlash", "friction_hysteresis"]
    report |= {
        "verdict": "set",
        "summary": "backlash or friction_hysteresis at joint 2: odds of 2.1 : 1, too close.",
        "findings": [finding | {"set": members}],
        "next_poses": poses,
    }
    split = SetSplit(tuple(members), 12.4, len(poses))
    return report, _with(detail, splits=(split,))


def partly(rng: np.random.Generator) -> Diagnosis:
    """An effect named, structure left."""
    report, detail = named(rng)
    report |= {
        "verdict": "partly",
        "summary": "backlash at joint 2 explains 71 %; structure of 0.9 mm over q4 and"
        " temperature_c is left.",
        "structure_left": {
            "flag": True,
            "text": "0.90 mm of structure depends on q4, temperature_c",
            "p_value": 0.0004,
            "share_explained": 0.71,
            "inputs": ["q4", "temperature_c"],
            "size_mm": 0.9,
        },
    }
    return report, _with(detail, guilty=("approach", "q4", "temperature_c"))


def unknown(rng: np.random.Generator) -> Diagnosis:
    """Structure that nothing explains; only the network helps."""
    report, detail = base(rng)
    rows = held_out_rows(rng)
    kept = ("nominal", "frames_only", "calibrated", "with_network")
    rows = SeenRows(
        rows.index,
        rows.measured_m,
        {stage: rows.errors_m[stage] for stage in kept},
        rows.inputs,
        rows.arms_m,
    )
    report |= {
        "verdict": "unknown",
        "summary": "Structure of 2.1 mm over q5 and q6 that no effect of the library explains.",
        "structure_left": {
            "flag": True,
            "text": "2.10 mm of structure depends on q5, q6",
            "p_value": 1e-7,
            "share_explained": 0.0,
            "inputs": ["q5", "q6"],
            "size_mm": 2.1,
        },
        "held_out": held_out(rows, "calibrated", "with_network", [-0.02, 1.1]),
    }
    return report, _with(detail, held_out=rows, guilty=("q5", "q6"))


def bad_data(rng: np.random.Generator) -> Diagnosis:
    """Refused at the door: nothing to draw."""
    report, _ = base(rng)
    report |= {
        "verdict": "bad_data",
        "summary": "samples.csv: x, y, z: tip at 812 m from the base; allowed: metres, not mm.",
        "candidates": [],
        "noise": {"sigma_mm": None, "source": None, "rho": None},
        "held_out": held_out(None, None, None, None),
        "outliers": [],
        "discovered": [],
    }
    report["structure_left"] = report["structure_left"] | {"p_value": None}
    return report, Detail(title="samples.csv")


VERDICTS: Mapping[str, Callable[[np.random.Generator], Diagnosis]] = {
    "noise": noise,
    "named": named,
    "set": a_set,
    "partly": partly,
    "unknown": unknown,
    "bad_data": bad_data,
}


def _with(detail: Detail, **changes: Any) -> Detail:
    return dataclasses.replace(detail, **changes)
