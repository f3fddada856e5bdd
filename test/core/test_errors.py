"""Errors say one line and survive the way between processes."""

import pickle

import numpy as np
import pytest

from longarm_comp.core.errors import InputError, JobError, LongarmError


def test_input_error_names_place_field_value_and_what_is_allowed() -> None:
    error = InputError("samples.csv", "row 12, q3", float("nan"), "a finite number [rad]")
    assert str(error) == "samples.csv: row 12, q3: nan; allowed: a finite number [rad]"
    assert (error.where, error.field, error.exit_code) == ("samples.csv", "row 12, q3", 2)


def test_job_error_carries_the_facts() -> None:
    error = JobError("the target is out of reach", residual_m=0.25, joint="q3")
    assert str(error) == "the target is out of reach (residual_m=0.25, joint='q3')"
    assert error.facts["residual_m"] == 0.25
    assert error.exit_code == 3


@pytest.mark.parametrize("value", ["two\nlines", np.zeros((40, 3)), list(range(1000)), None, ""])
def test_any_value_stays_on_one_short_line(value: object) -> None:
    for error in (InputError("a\nb", "field", value, "c\n d"), JobError("no\ngood", value=value)):
        assert len(str(error).splitlines()) == 1
        assert len(str(error)) < 300


def test_likely_mistakes_in_the_rows_are_said_whole() -> None:
    mistakes = (
        "row 61 on looks measured from another base, or of another arm and q4 and q5 look swapped"
        " and q1 looks negated: 188 -> 106 mm, so more is wrong, or it is something else"
    )
    assert f"'{mistakes}'; allowed" in str(InputError("s.csv", "rows", mistakes, "rows of the arm"))


@pytest.mark.parametrize("error", [InputError("f", "x", 1, "2"), JobError("why", at_m=0.5)])
def test_errors_cross_a_process_boundary(error: LongarmError) -> None:
    back = pickle.loads(pickle.dumps(error))  # noqa: S301 - our own bytes, as a worker pool sends them
    assert (type(back), str(back)) == (type(error), str(error))
