"""What the report refuses: records, details, folders; nothing is written then."""

from __future__ import annotations

import copy
import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from report_pages import SEED, sample
from report_samples import named

from longarm_comp.core.errors import InputError
from longarm_comp.report import Detail, Input, write_report

BAD: list[tuple[str, tuple[str | int, ...], Any, str]] = [
    ("not a number", ("held_out", "rows", 0, "mean_mm"), float("nan"), "mean_mm"),
    ("infinite", ("findings", 0, "log_bayes_factor"), float("inf"), "log_bayes_factor"),
    ("unknown verdict", ("verdict",), "maybe", "'noise', 'named'"),
    ("unknown key", ("noise", "sigma"), 1.0, "known: rho, sigma_mm, source"),
    ("unknown key in a list", ("findings", 0, "place"), "x", "compensated, doubts, effect"),
    ("unknown model", ("held_out", "rows", 0, "model"), "best", "'nominal'"),
    ("another schema", ("schema",), "longarm/diagnosis/2", "longarm/diagnosis/1"),
    ("negative length", ("held_out", "rows", 0, "max_mm"), -1.0, "max_mm"),
    ("p above one", ("structure_left", "p_value"), 1.2, "p_value"),
]


@pytest.mark.parametrize(("path", "value", "said"), [b[1:] for b in BAD], ids=[b[0] for b in BAD])
def test_bad_record_is_refused_and_nothing_written(
    path: tuple[str | int, ...], value: Any, said: str, tmp_path: Path
) -> None:
    report, detail = sample("named")
    report = copy.deepcopy(report)
    node: Any = report
    for step in path[:-1]:
        node = node[step]
    node[path[-1]] = value
    with pytest.raises(InputError) as caught:
        write_report(report, detail, tmp_path)
    assert said in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_missing_key_is_named(tmp_path: Path) -> None:
    report, detail = sample("named")
    del report["noise"]
    with pytest.raises(InputError, match=r"report\.json: noise: .*required"):
        write_report(report, detail, tmp_path)


def test_table_that_contradicts_the_errors_is_refused(tmp_path: Path) -> None:
    report, detail = sample("named")
    report = copy.deepcopy(report)
    report["held_out"]["rows"][3]["mean_mm"] *= 0.9
    with pytest.raises(InputError, match=r"held_out\.with_effects\.mean_mm"):
        write_report(report, detail, tmp_path)


def test_unwritable_folder_is_a_clear_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="output folder"):
        write_report(*sample("bad_data"), tmp_path / "file")


def test_detail_refuses_what_cannot_be_drawn() -> None:
    rows = named(np.random.default_rng(SEED))[1].held_out
    assert rows is not None
    with pytest.raises(InputError, match="errors_m"):
        dataclasses.replace(rows, errors_m={"calibrated": np.zeros((3, 3))})
    with pytest.raises(InputError, match="nominal, frames_only"):
        dataclasses.replace(rows, errors_m={"best": np.zeros((60, 3))})
    with pytest.raises(InputError, match="not finite"):
        dataclasses.replace(rows, measured_m=np.full((60, 3), np.nan))
    with pytest.raises(InputError, match="input q1"):
        dataclasses.replace(rows, inputs=(Input("q1", "rad", np.zeros(2)),))
    with pytest.raises(InputError, match="joint_units"):
        Detail(joints=("q1",))


def test_unknown_guilty_input_is_refused(tmp_path: Path) -> None:
    report, detail = sample("named")
    with pytest.raises(InputError, match="q9"):
        write_report(report, dataclasses.replace(detail, guilty=("q9",)), tmp_path)
