"""Sizes of normal errors, and how their covariance is written."""

import numpy as np
import pytest

from longarm_comp.core.model.uncertainty import (
    LEVEL,
    decode_triangle,
    encode_triangle,
    sizes,
    triangular,
)


@pytest.mark.parametrize("axes", [(1.0, 1.0, 1.0), (1.0, 0.3, 0.01), (1.0, 1e-3, 1e-3)])
@pytest.mark.parametrize("known", [(0.0, 0.0, 0.0), (1.5, 0.2, 0.0)])
def test_lengths_of_normal_errors(
    axes: tuple[float, ...], known: tuple[float, ...], rng: np.random.Generator
) -> None:
    turned = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    factor = turned * np.array(axes)
    mean = turned @ np.array(known)
    drawn = np.linalg.norm(mean + rng.standard_normal((200_000, 3)) @ factor.T, axis=1)
    expected, within = sizes(factor @ factor.T, mean)
    assert expected == pytest.approx(drawn.mean(), rel=0.025)
    assert within == pytest.approx(np.quantile(drawn, LEVEL), rel=0.025)


def test_an_error_that_is_known_is_its_own_length() -> None:
    assert np.allclose(sizes(np.zeros((3, 3)), np.array([3.0, 0.0, 4.0])), 5.0)
    assert np.allclose(sizes(np.zeros((3, 3))), 0.0)


def test_a_triangle_is_written_and_read(rng: np.random.Generator) -> None:
    factor = rng.standard_normal((7, 3)) * 10.0 ** rng.uniform(-8, 1, (7, 1))
    made = triangular(factor)
    assert np.allclose(made, np.tril(made))
    np.testing.assert_allclose(made @ made.T, factor @ factor.T, rtol=1e-9)
    np.testing.assert_allclose(decode_triangle(encode_triangle(made)), made, rtol=1e-6)
