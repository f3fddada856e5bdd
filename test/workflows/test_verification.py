"""The comparison of two runs over the same targets, and when another round is expected to pay."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from longarm_comp.core.errors import InputError, JobError
from longarm_comp.jobs.loop import NEAR_NOISE, Journal, LoopSettings, another_round
from longarm_comp.jobs.targets import Trial, one_by_one
from longarm_comp.workflows.verification import compare_runs

NAMES = ("without", "with")


def trial(target: np.ndarray, error: np.ndarray) -> Trial:
    lost = np.full_like(target, np.nan)
    return Trial("run", target, target + error, lost, np.zeros(len(target), int))


def test_the_error_is_tip_minus_target(rng: np.random.Generator, tmp_path: Path) -> None:
    target = rng.normal(size=(12, 3))
    low = np.tile([0.001, 0.002, -0.02], (12, 1))
    run = trial(target, low)
    np.testing.assert_allclose(run.off, low)
    result = compare_runs(NAMES, run.off, 0.1 * run.off)
    without, compensated = result.rows
    assert [without[f"mean_{axis}_mm"] for axis in "xyz"] == pytest.approx([1.0, 2.0, -20.0])
    assert compensated["mean_mm"] == pytest.approx(0.1 * without["mean_mm"])
    result.picture(tmp_path / "tip.png")
    assert (tmp_path / "tip.png").read_bytes().startswith(b"\x89PNG")


def test_it_helps_only_beyond_chance(rng: np.random.Generator) -> None:
    worse = rng.normal(size=(20, 3))
    clearly = compare_runs(NAMES, worse, 0.1 * worse)
    assert clearly.helps and clearly.gain_m > 0
    low, high = clearly.gain_ci95_m
    assert 0 < low < clearly.gain_m < high
    harmed = compare_runs(NAMES, 0.1 * worse, worse)
    assert not harmed.helps and harmed.gain_m == pytest.approx(-clearly.gain_m)
    assert "does not help" in harmed.summary
    along = np.array([[0.0, 0.0, 1.0]])
    mixed = along * np.tile([0.5, 1.45], 10)[:, None]  # as often farther as nearer
    alike = compare_runs(NAMES, np.repeat(along, 20, axis=0), mixed)
    assert alike.gain_m > 0 and not alike.helps
    assert compare_runs(NAMES, worse, 0.1 * worse).gain_ci95_m == clearly.gain_ci95_m


def test_runs_are_paired_where_the_marker_was_seen_in_both(rng: np.random.Generator) -> None:
    before, after = rng.normal(size=(2, 8, 3))
    before[1] = np.nan
    after[4, 2] = np.nan
    both = [0, 2, 3, 5, 6, 7]
    result = compare_runs(NAMES, before, after)
    np.testing.assert_array_equal(result.runs[NAMES[0]], before[both])
    np.testing.assert_array_equal(result.runs[NAMES[1]], after[both])
    lengths = np.linalg.norm(before[both], axis=1) - np.linalg.norm(after[both], axis=1)
    assert result.gain_m == pytest.approx(lengths.mean())
    before[both[1:]] = np.nan
    with pytest.raises(JobError, match="seen=1"):
        compare_runs(NAMES, before, after)


def test_refused_targets_are_counted(rng: np.random.Generator) -> None:
    target = rng.normal(size=(4, 3))
    run = trial(target, np.zeros((4, 3)))
    mixed = dataclasses.replace(run, status=np.array([0, 1, 3, 9]))
    assert (run.refused_count, mixed.refused_count) == (0, 2)


def test_a_run_that_comes_nearer_gains_against_the_one_before(rng: np.random.Generator) -> None:
    target, error = rng.normal(size=(12, 3)), 1e-3 * rng.normal(size=(12, 3))
    far, near = trial(target, 3.0 * error), trial(target, error)
    gain = near.against(far)
    assert gain.helps and gain.gain_m == pytest.approx(2.0 * np.linalg.norm(error, axis=1).mean())
    assert not far.against(near).helps


def test_targets_of_a_file_are_handed_out_once() -> None:
    given = np.arange(15.0).reshape(5, 3)
    draw = one_by_one(given)
    np.testing.assert_array_equal(draw(3), given[:3])
    np.testing.assert_array_equal(draw(3), given[3:])
    assert draw(1).shape == (0, 3)


def test_another_round_pays_while_it_gains_and_more_than_noise_is_left() -> None:
    sigma = (1e-4, 1e-4, 1e-4)
    alone = np.linalg.norm(1e-4 * np.random.default_rng(1).normal(size=(200_000, 3)), axis=1).mean()
    gain = (1e-4, 2e-4)
    assert another_round(gain, 1.05 * NEAR_NOISE * alone, sigma)[0]
    assert not another_round(gain, 0.95 * NEAR_NOISE * alone, sigma)[0]
    assert not another_round((-1e-6, 2e-4), 10 * alone, sigma)[0]
    assert "near the noise" in another_round(gain, alone, sigma)[1]


def test_a_journal_goes_on_where_it_was_left(rng: np.random.Generator, tmp_path: Path) -> None:
    path, facts = tmp_path / "steps.json", {"poses": 80, "seed": 1}
    target = rng.normal(size=(3, 3))
    run = trial(target, np.where(np.arange(3)[:, None] == 1, np.nan, 1e-3))
    journal = Journal(path, facts, resume=False)
    assert journal.once("a", lambda: [1, 2]) == [1, 2]
    journal.trial("run", lambda: run)
    again = Journal(path, facts, resume=True)
    assert "a" in again and "b" not in again
    assert again.once("a", lambda: pytest.fail("made twice")) == [1, 2]
    read = again.trial("run", lambda: pytest.fail("made twice"))
    for name in ("target", "seen", "true", "status"):
        np.testing.assert_array_equal(getattr(read, name), getattr(run, name))
    with pytest.raises(InputError, match="--resume"):
        Journal(path, facts, resume=False)
    with pytest.raises(InputError, match="80, as in the first call"):
        Journal(path, {**facts, "poses": 90}, resume=True)
    path.write_text(json.dumps([1]))
    with pytest.raises(InputError, match="longarm loop wrote"):
        Journal(path, facts, resume=True)


@pytest.mark.parametrize(("name", "value"), [("poses", 59), ("targets", 1), ("rounds", 0)])
def test_settings_that_cannot_be_judged_are_refused(name: str, value: int, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=f"--{name}"):
        LoopSettings(tmp_path, **{name: value})


def test_every_round_has_its_own_files(tmp_path: Path) -> None:
    settings = LoopSettings(tmp_path)
    names = [settings.path(what, k).name for what in ("session", "poses.csv") for k in (1, 2)]
    assert names == ["session", "session_2", "poses.csv", "poses_2.csv"]
