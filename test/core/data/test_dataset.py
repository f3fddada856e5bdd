"""Sessions: directions from the order, subsets, context, splits."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_arm import ARM, measured

from longarm_comp.core.arm.history import recorded_history
from longarm_comp.core.compensation.result import Status
from longarm_comp.core.data.holdout import blocked_split, spread_rows
from longarm_comp.core.data.session import Session
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.model import Model
from longarm_comp.workflows.compensate import compensate


def test_direction_comes_from_the_row_before() -> None:
    q = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, -2.0], [0.5, -2.0], [0.5, -2.0]])
    made = recorded_history(q, np.arange(5)).approach
    assert made.tolist() == [[0, 0], [1, 0], [1, -1], [-1, -1], [-1, -1]]


def test_a_recorded_direction_stands_for_all_joints_and_is_kept_by_those_that_rest() -> None:
    q = np.array([[0.0, 5.0], [1.0, 5.0], [0.0, 5.0]])
    made = recorded_history(q, np.arange(3), np.array([-1.0, np.nan, 0.0])).approach
    assert made.tolist() == [[-1, -1], [1, -1], [-1, -1]]


def test_two_markers_at_one_index_share_the_direction() -> None:
    q = np.array([[0.0], [1.0], [1.0], [0.0]])
    assert recorded_history(q, np.array([0, 1, 1, 2])).approach.ravel().tolist() == [0, 1, 1, -1]


def test_subsets_keep_the_directions_of_the_whole(rng: np.random.Generator) -> None:
    session = measured(40, rng)
    part = session.take(slice(0, 40, 3))
    assert (part.approach == session.approach[::3]).all()
    assert (part.approach != recorded_history(part.q, part.index).approach).any()


def test_context_carries_what_was_recorded(rng: np.random.Generator) -> None:
    session = measured(
        6,
        rng,
        columns={"temperature_c": np.linspace(20, 25, 6)},
        labels={"group": ["a", "a", "b", "b", "b", "b"]},
    )
    context = session.context().take(np.array([1, 4]))
    assert np.allclose(context.column("temperature_c"), [21, 24])
    assert context.is_label("group", "b").tolist() == [0.0, 1.0]
    assert np.array_equal(np.stack(context.approach, -1), session.approach[[1, 4]])
    assert not context.has("payload_kg")
    assert "payload_kg" not in session.columns
    assert len(session.where("group", "b")) == 4
    with pytest.raises(InputError, match="there are: group"):
        session.where("marker", "left")


def test_one_row_knows_no_direction(rng: np.random.Generator) -> None:
    assert not measured(1, rng).context().has("approach")


def test_arrays_cannot_be_changed(rng: np.random.Generator) -> None:
    session = measured(3, rng)
    with pytest.raises(ValueError, match="read-only"):
        session.q[0, 0] = 1.0


def test_the_arrays_that_a_session_is_made_of_stay_the_callers(rng: np.random.Generator) -> None:
    warmth, distance = np.full(3, 20.0), np.ones((3, 1))
    labels = {"anchor": np.array(["p", "p", "p"])}
    readings, q = {"distance": distance}, rng.normal(size=(3, 2))
    session = Session.record(
        q,
        np.zeros((3, 3)),
        columns={"temperature_c": warmth},
        labels=labels,
        readings=readings,
    )
    before = [session.q.copy(), session.columns["temperature_c"].copy()]
    for values in (q, warmth, distance):
        values += 1.0
    labels["anchor"][:] = "r"
    assert np.array_equal(session.q, before[0])
    assert np.array_equal(session.columns["temperature_c"], before[1])
    assert np.array_equal(session.readings["distance"], np.ones((3, 1)))
    assert session.labels["anchor"].tolist() == ["p", "p", "p"]


def test_a_reading_that_is_partly_blank_is_called_so(rng: np.random.Generator) -> None:
    ray = np.array([[0.0, 0.0, 1.0], [0.0, np.nan, 1.0], [np.nan, np.nan, np.nan]])
    labels = {"sensor": np.array(["left"] * 3)}
    with pytest.raises(InputError, match=r"row 2, ray_x.*allowed: numbers, or all blank"):
        measured(3, rng, labels=labels, readings={"ray": ray})


def test_a_reading_is_finite_and_one_of_blanks_alone_is_none(rng: np.random.Generator) -> None:
    blank = np.full((3, 1), np.nan)
    assert not measured(3, rng, readings={"read_q1": blank}).readings
    with pytest.raises(InputError, match=r"row 2, read_q1.*numbers, or all blank"):
        measured(3, rng, readings={"read_q1": np.array([[0.1], [np.inf], [0.2]])})


def test_positions_of_a_table_of_mixed_columns_are_read(rng: np.random.Generator) -> None:
    """Such a table holds Python objects, None where a cell was blank."""
    xyz = np.array([[0.1, 0.2, 0.3], [None, None, None], [0.4, 0.5, 0.6]], dtype=object)
    session = Session.record(rng.normal(size=(3, 2)), xyz)
    assert session.has_position.tolist() == [True, False, True]
    xyz[2, 0] = np.inf
    with pytest.raises(InputError, match="numbers in m, or NaN"):
        Session.record(rng.normal(size=(3, 2)), xyz)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("q", np.full((3, 4), np.nan)),
        ("xyz", np.full((3, 3), np.inf)),
        ("xyz", np.zeros((2, 3))),
        ("xyz", None),
        ("index", np.arange(2)),
        ("columns", {"t_s": np.array([0.0, np.nan, 1.0])}),
        ("q", np.ones((3, 4)) + 1j),
        ("q", np.ma.masked_less(np.ones((3, 4)), 2)),
        ("index", np.ma.masked_less(np.arange(3), 1)),
        ("sigma", np.zeros((3, 3))),
        ("sigma", np.full((3, 3), -1e-4)),
    ],
)
def test_what_is_no_session_is_refused(name: str, value: object, rng: np.random.Generator) -> None:
    good = measured(3, rng)
    fields = {"q": good.q, "xyz": good.xyz} | {name: value}
    with pytest.raises(InputError):
        Session.record(**fields)  # type: ignore[arg-type]


def test_what_an_array_masks_was_not_measured(rng: np.random.Generator) -> None:
    good = measured(5, rng)
    lost = np.repeat([[False], [True], [False], [False], [True]], 3, axis=1)
    session = Session.record(good.q, np.ma.masked_array(good.xyz, mask=lost))
    assert session.seen.tolist() == [True, False, True, True, False]
    targets = np.ma.masked_array(good.xyz, mask=lost)
    status = [answer.status for answer in compensate(Model(ARM), targets, frame="base")]
    assert [each is Status.BAD_TARGET for each in status] == [False, True, False, False, True]


def test_a_history_of_other_rows_is_refused(rng: np.random.Generator) -> None:
    session = measured(3, rng)
    with pytest.raises(InputError, match="legs: 'shape"):
        dataclasses.replace(session, legs=session.legs[:2])


def test_hash_follows_the_contents(rng: np.random.Generator) -> None:
    session = measured(5, rng)
    same = Session.record(session.q, session.xyz, source="another file")
    moved = session.xyz.copy()
    moved[3, 1] += 1e-9
    assert same.hash == session.hash
    assert Session.record(session.q, moved).hash != session.hash
    assert session.take([0, 1, 2, 3]).hash != session.hash


def test_lost_markers_are_not_seen(rng: np.random.Generator) -> None:
    session = measured(4, rng)
    xyz = session.xyz.copy()
    xyz[2] = np.nan
    assert Session.record(session.q, xyz).seen.tolist() == [True, True, False, True]


@settings(max_examples=40, deadline=None)
@given(poses=st.integers(2, 90), visits=st.integers(0, 60), seed=st.integers(0, 2**31))
def test_no_pose_straddles_a_split(poses: int, visits: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    q = rng.random((poses, 2))[np.r_[np.arange(poses), rng.integers(0, poses, visits)]]
    order = rng.permutation(len(q))
    session = Session.record(q[order], np.zeros((len(q), 3)))
    train, hold_out = blocked_split(session, rng=seed)
    assert len(train) + len(hold_out) == len(session)
    assert len(train) > 0
    assert len(hold_out) > 0
    assert not set(map(tuple, train.q)) & set(map(tuple, hold_out.q))


def test_blocks_are_contiguous_and_large_enough(rng: np.random.Generator) -> None:
    session = measured(300, rng)
    train, hold_out = blocked_split(session, rng=4)
    assert 60 <= len(hold_out) <= 100
    runs = 1 + np.count_nonzero(np.diff(hold_out.index) > 1)
    assert runs <= 7  # whole blocks of 12 rows; single rows would make about 50 runs
    again, _ = blocked_split(session, rng=4)
    other, _ = blocked_split(session, rng=5)
    assert again.hash == train.hash
    assert other.hash != train.hash


def test_repeats_stay_together_even_when_commanded_a_little_differently() -> None:
    q = np.arange(20.0)[:, None] + np.zeros(2)
    q[15] = q[3] + 1e-3
    repeat = np.full(20, -1)
    repeat[[3, 15]] = 7
    session = Session.record(q, np.zeros((20, 3)), repeat_id=repeat)
    assert session.pose_id[3] == session.pose_id[15]
    for seed in range(12):
        _, hold_out = blocked_split(session, rng=seed)
        assert (3 in hold_out.index) == (15 in hold_out.index)


def test_one_pose_cannot_be_split() -> None:
    session = Session.record(np.zeros((5, 2)), np.zeros((5, 3)))
    with pytest.raises(InputError, match="2 distinct poses"):
        blocked_split(session)


def test_of_a_long_session_runs_are_taken_from_end_to_end(rng: np.random.Generator) -> None:
    rows = measured(1000, rng)
    assert spread_rows(rows, 1000).all()
    taken = rows.take(spread_rows(rows, 400))
    assert 350 <= len(taken) <= 400
    assert (taken.index[0], taken.index[-1]) == (rows.index[0], rows.index[-1])
    gaps = np.diff(taken.index)
    assert (gaps >= 1).all() and (gaps > 1).sum() == 7, "eight runs of fifty"
    assert gaps[gaps > 1].max() - gaps[gaps > 1].min() <= 1, "evenly"


def test_a_marker_of_few_rows_is_among_the_rows_of_a_long_session(
    rng: np.random.Generator,
) -> None:
    rows = measured(1000, rng)
    marker = np.where(np.isin(np.arange(1000), [71, 72, 780]), "elbow", "tip")
    marked = dataclasses.replace(rows, labels={"marker": marker})
    taken = spread_rows(rows, 400)
    assert not taken[[71, 72, 780]].any()
    assert (np.flatnonzero(spread_rows(marked, 400) & ~taken) == [71, 72, 780]).all()
