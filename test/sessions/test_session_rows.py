"""Rows of a session taken apart and joined: each keeps the side from which its joints came."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_arm import ARM

from longarm_comp.core.data.session import Session
from longarm_comp.core.errors import InputError
from longarm_comp.sessions.csv import read_csv, write_csv


def test_a_session_is_its_first_rows_followed_by_the_others(rng: np.random.Generator) -> None:
    n, runs = 7, (ARM.upper - ARM.lower) / 20
    q = ARM.mid + runs * rng.uniform(-1, 1, (n, ARM.n))
    told = rng.choice(np.array([-1, 0, 1]), (n, ARM.n))
    told[4] = 1  # the first of the others came from no row of the session
    told[[0, 3], 0], told[[1, 4], 0] = 1, 0
    q[[1, 4], 0] = q[[0, 3], 0]  # it stands, and keeps its side
    begun = (told != 0) & (rng.random((n, ARM.n)) < 0.5)
    begun[[0, 3], 0] = False
    run_up = np.where(begun, q - told * runs, np.nan)
    whole = Session.record(
        q,
        rng.normal(size=(n, 3)),
        index=np.arange(3, 3 + n),
        approach=told,
        run_up=run_up,
        repeat_id=np.array([0, -1, 0, -1, 1, 1, 1]),
        sigma=rng.uniform(1e-4, 1e-3, (n, 3)),
        columns={"payload_kg": rng.random(n)},
        labels={"role": np.array(["test", "", "train", "train", "", "test", ""])},
        readings={"orientation": np.tile([0.0, 0.0, 0.0, 1.0], (n, 1))},
        sigmas={"orientation": np.full(n, 1e-3)},
        touch_distances=(("a", "b", 0.05, 1e-4),),
    )
    parts = whole.take(slice(4)), whole.take(slice(4, None))
    again = parts[0].followed_by(parts[1])
    assert again.hash == whole.hash
    np.testing.assert_array_equal(again.legs, whole.legs)
    bare = Session.record(q[:2], np.full((2, 3), np.nan))
    joined = bare.followed_by(replace(parts[1], columns={}))
    assert joined.index.tolist() == [0, 1, 2, 3, 4]
    np.testing.assert_array_equal(joined.approach[2:], parts[1].approach)
    later = whole.take(slice(1, 4))
    assert later.approach[0, 0] == 1
    np.testing.assert_array_equal(later.followed_by(parts[1]).approach, whole.approach[1:])
    assert joined.labels["role"].tolist() == ["", "", "", "test", ""]
    assert joined.sigma is not None and np.isnan(joined.sigma[:2]).all()
    np.testing.assert_array_equal(joined.sigma[2:], parts[1].sigma)
    assert np.isnan(joined.sigmas["orientation"]).tolist() == [True] * 2 + [False] * 3
    with pytest.raises(InputError, match="payload_kg"):
        bare.followed_by(parts[1])


@pytest.mark.parametrize(("side", "begun"), [(1, 0.1), (-1, -0.1), (1, 0.0)])
def test_a_run_up_from_the_other_side_than_the_recorded_one_is_refused(
    side: int, begun: float
) -> None:
    q, xyz = np.tile(ARM.mid, (2, 1)), np.zeros((2, 3))
    run_up = np.full(q.shape, np.nan)
    run_up[1, 2] = ARM.mid[2] + begun
    with pytest.raises(InputError, match="row 2, run_up of q3"):
        Session.record(q, xyz, approach=np.full(2, side), run_up=run_up)
    if begun:
        assert Session.record(q, xyz, approach=np.full(2, -side), run_up=run_up).told[1, 1] == -side


def test_a_joint_that_stands_keeps_its_side_without_the_row_that_brought_it(tmp_path: Path) -> None:
    session = Session.record(
        np.tile(ARM.mid, (3, 1)), np.zeros((3, 3)), approach=np.array([1, 0, 0])
    )
    write_csv(session.take([0, 2]), tmp_path / "s.csv")
    assert (read_csv(tmp_path / "s.csv", ARM).approach == 1).all()
