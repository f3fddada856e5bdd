"""Rows to learn from, and a predictor that is trained in a moment."""

import pytest
from quick_predictor import quick_predictor, rows


@pytest.fixture(name="data")
def data_():
    return rows()


@pytest.fixture(name="small")
def small_():
    return quick_predictor()
