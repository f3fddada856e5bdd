"""Table I: arms that are really commanded, and the table made of them."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.calibration.calibrate import Errors
from longarm_comp.core.compensation.result import Method
from studies import table1, table1_bench
from studies.table1 import command
from studies.table1_figure import draw_table1

FEW = 100
SHORT = (
    table1_bench.as_printed("Original error", Method.NONE, (17.7, 223.94)),
    table1_bench.as_printed("Deflection only", Method.DEFLECTION, (15.39, 215.97)),
    table1_bench.RowSetting("learned", Method.BOTH, FEW, table1_bench.gaussian_process),
    table1_bench.RowSetting("network", Method.BOTH, FEW, table1_bench.ssa_bp, single_pass=True),
)


@pytest.fixture(scope="module")
def drawn(arm: Arm) -> table1_bench.Bench:
    """One arm with few rows."""
    return table1_bench.Bench.draw(arm, 3, 0, 5)


@pytest.fixture(scope="module")
def outcomes(arm: Arm) -> list[table1_bench.Outcome]:
    """A short table on one arm."""
    return table1_bench.one_arm(arm, 3, 0, SHORT)


def test_rows_of_the_paper_are_there_with_its_figures() -> None:
    """Six rows as printed, by the paper's scheme; then peer and best setting by this package's."""
    printed = [s.paper for s in table1_bench.SETTINGS if s.paper]
    assert printed == [
        (17.7, 223.94), (15.39, 215.97), (5.32, 52.83), (12.66, 214.37), (5.79, 57.15),
        (9.98, 180.81),
    ]  # fmt: skip
    assert all(s.single_pass == (s.learner is table1_bench.ssa_bp) for s in table1_bench.SETTINGS)
    rounded = [s.row for s in table1_bench.SETTINGS if not s.realisable]
    assert rounded == [
        *(s.row for s in table1_bench.SETTINGS if s.paper),
        "Calibrated + effects, 300, rounded",
    ]


@pytest.mark.long
def test_commanding_improves_in_the_expected_order(outcomes: list[table1_bench.Outcome]) -> None:
    """Deflection takes a little, what is learned with the approach direction takes most."""
    original, deflection, learned, network = (o.tip.mean_abs_z for o in outcomes)
    assert 0.010 < original < 0.030
    assert deflection < original
    assert learned < 0.35 * original
    assert network < deflection
    assert all(o.tip.n == table1_bench.TARGETS for o in outcomes)


def test_error_is_where_the_true_arm_went(drawn: table1_bench.Bench) -> None:
    """A sound arm without hidden effects goes where the deflected model says."""
    sound = table1_bench.replace(
        drawn,
        true=table1_bench.TrueArm(drawn.declared.arm),
        camera=table1_bench.TrueCamera.of(drawn.declared.arm),
    )
    stiff, sagging = (sound.run(s, 0) for s in SHORT[:2])
    assert sagging.tip.max < 1.5e-4
    assert stiff.tip.mean > 20 * sagging.tip.mean
    assert sagging.seen.mean == pytest.approx(sagging.tip.mean)


def test_steps_that_the_arm_declares_are_chosen_among(drawn: table1_bench.Bench) -> None:
    """With nothing hidden but the servos' steps: rounding misses, joints chosen together do not."""
    declared = drawn.declared.arm
    np.testing.assert_allclose(
        declared.steps, [2 * np.pi / 1000 * (s > 0) for s in declared.steps], rtol=1e-12
    )
    assert (declared.steps > 0).sum() == 5
    stepped = table1_bench.replace(
        drawn,
        true=table1_bench.TrueArm(declared, [table1_bench.ServoQuantisation(declared.steps)]),
        camera=table1_bench.TrueCamera.of(declared),
    )
    rounded, chosen = (
        stepped.run(table1_bench.RowSetting("", Method.DEFLECTION, realisable=r), 0).tip
        for r in (False, True)
    )
    assert rounded.mean > 2e-3
    assert chosen.mean < 0.15 * rounded.mean


def test_setting_of_the_paper(arm: Arm) -> None:
    """All from below, the grid in its order, few samples are its last."""
    bench = table1_bench.Bench.draw(arm, 3, 0, 30, as_paper=True)
    assert (bench.side == 1).all()
    assert (np.stack(bench.session.context().approach) == 1).all()
    first = bench.session.q[:, 0]
    assert (np.diff(first) >= 0).all() and np.ptp(first) > 0
    np.testing.assert_array_equal(bench.rows(10).q, bench.session.q[20:])
    mixed = table1_bench.Bench.draw(arm, 3, 0, 30)
    assert set(np.unique(mixed.side)) == {-1.0, 1.0}
    np.testing.assert_array_equal(mixed.rows(10).q, mixed.session.q[:10])


@pytest.mark.long
def test_the_network_of_the_paper_never_refuses(arm: Arm) -> None:
    bench = table1_bench.Bench.draw(arm, 3, 0, 40)
    q, residual, context = table1_bench.training_rows(bench.declared, bench.session)
    predictor = table1_bench.ssa_bp(q, residual, context, 0)
    far = predictor.predict(np.stack([q[0], q[0] + 100.0]))
    assert far.in_domain.all() and np.isfinite(far.error).all()


def test_same_seed_same_arm_and_other_number_other_arm(arm: Arm, drawn: table1_bench.Bench) -> None:
    """Everything follows from the seed."""
    again = table1_bench.Bench.draw(arm, 3, 0, 5)
    assert np.array_equal(drawn.targets, again.targets)
    assert np.array_equal(drawn.session.xyz, again.session.xyz)
    one, other = (table1_bench.random_arm(np.random.default_rng([3, k]), arm) for k in (0, 1))
    assert one.hash != other.hash


def _arm(*z_mm: float) -> list[table1_bench.Outcome]:
    made = []
    for setting, z in zip(SHORT, z_mm, strict=True):
        error = 1e-3 * np.array([[0.0, 0.0, z], [0.0, 0.0, -z]])
        made.append(table1_bench.Outcome(setting.row, Errors.of(error), Errors.of(2 * error), 1))
    return made


def test_summary_by_hand() -> None:
    """Means, spread, fallbacks, paired differences and their interval."""
    arms = [_arm(10, 12, 3, 5), _arm(20, 24, 4, 5), _arm(30, 33, 5, 5)]
    rows = table1.rows(arms, SHORT)
    assert rows[0]["mean_abs_z_mm"] == pytest.approx(20.0)
    assert rows[0]["sd_over_arms_mm"] == pytest.approx(10.0)
    assert rows[0]["seen_mean_abs_z_mm"] == pytest.approx(40.0)
    assert rows[0]["variance_mm2"] == pytest.approx((100 + 400 + 900) / 9)
    assert rows[0]["fallbacks"] == 3
    (difference,) = table1.differences(rows, [("Deflection only", "Original error")])
    assert difference["mean_mm"] == pytest.approx(3.0)
    assert difference["ci95_mm"] == pytest.approx([3 - 2.484, 3 + 2.484], abs=2e-3)
    assert difference["better_arms"] == 0
    (line,) = table1.contradictions(rows)
    assert "'Deflection only' below 'Original error' by 2.31 mm, here it is above by 3.00" in line


def test_command_writes_table_and_figure(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """JSON on stdout, the same in the folder, and a picture."""

    def measured(
        base: Arm, count: int, seed: int, jobs: int, **_: object
    ) -> list[list[table1_bench.Outcome]]:
        blank = Errors.of(np.zeros((2, 3)))
        full = [_arm(10, 8, 3, 4), _arm(12, 9, 2, 4)][:count]
        rest = [table1_bench.Outcome(s.row, blank, blank, 0) for s in table1_bench.SETTINGS[4:]]
        return [made + rest for made in full]

    monkeypatch.setattr(table1, "command_arms", measured)
    done = CliRunner().invoke(command, ["--arms", "2", "--json", "-o", str(tmp_path / "made")])
    assert done.exit_code == 0, done.output
    printed = json.loads(done.stdout)
    assert [row["row"] for row in printed["rows"]] == [s.row for s in table1_bench.SETTINGS]
    assert printed["rows"][0]["arms_mm"] == pytest.approx([10, 12])
    assert json.loads((tmp_path / "made" / "table1.json").read_text())["seed"] == 0
    assert (tmp_path / "made" / "table1.png").read_bytes().startswith(b"\x89PNG")


def test_the_figure_is_drawn_the_same_each_time(tmp_path: Path) -> None:
    rows: Any = [
        {"row": "Original error", "arms_mm": [15.0, 19.0, 16.0], "paper_mean_abs_z_mm": 17.7},
        {"row": "Gaussian process, 300", "arms_mm": [2.0], "paper_mean_abs_z_mm": None},
    ]
    for name in ("one.png", "one.svg", "one.pdf", "two.svg"):
        draw_table1(rows, tmp_path / name)
        assert len((tmp_path / name).read_bytes()) > 3000
    assert (tmp_path / "one.svg").read_bytes() == (tmp_path / "two.svg").read_bytes()
