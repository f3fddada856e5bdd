"""What the report refuses: records, details, folders; nothing is written then."""

import copy
from pathlib import Path
from typing import Any

import pytest
from report_pages import sample, write_sample

from longarm_comp.core.errors import InputError

BAD: list[tuple[str, tuple[str | int, ...], Any, str]] = [
    ("not a number", ("held_out", "rows", 0, "mean_mm"), float("nan"), "mean_mm"),
    ("infinite", ("findings", 0, "log_bayes_factor"), float("inf"), "log_bayes_factor"),
    ("unknown verdict", ("verdict",), "maybe", "'noise', 'named'"),
    ("unknown key", ("noise", "sigma"), 1.0, "known keys: rho, sigma_mm, source"),
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
        write_sample(report, detail, tmp_path)
    assert said in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_missing_key_is_named(tmp_path: Path) -> None:
    report, detail = sample("named")
    del report["noise"]
    with pytest.raises(InputError, match=r"report\.json: noise: .*required"):
        write_sample(report, detail, tmp_path)


def test_unwritable_folder_is_a_clear_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="output folder"):
        write_sample(*sample("bad_data"), tmp_path / "file")
