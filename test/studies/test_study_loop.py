"""The loop study: its cases, its judgement, its file, its engines."""

import json
import math

import numpy as np
import pytest
from few_effects import few_effects

from longarm_comp.cli.run import run as command_line
from longarm_comp.core.effects.catalogue import BUILT_IN
from longarm_comp.core.effects.drive_errors import JointGain
from longarm_comp.core.effects.plays import Backlash, FrictionHysteresis
from longarm_comp.core.errors import InputError
from longarm_comp.workflows import cluster
from studies import loop
from studies.interval import wilson
from studies.loop_cases import GROUPS, NAMES, SPOILED, Case, Design
from studies.loop_score import told_apart, true_fit
from studies.loop_setting import set_up
from studies.loop_table import by_effect, failures, reliability, share, summary
from studies.loop_truth import at_one_place, places, values
from studies.true_camera import hidden


def case(group: str = "single", effects: tuple[str, ...] = ("backlash",), **other) -> Case:
    plain = {
        "one_place": False,
        "spoiled": "usual",
        "plan": "grid",
        "rows": 40,
        "noise": 1.0,
        "arm": 0,
        "number": 0,
    }
    return Case(group, effects, **{**plain, **other})


@pytest.mark.long
def test_soft_beams_are_told_from_a_load_that_bends_them(arm):
    """Columns tell a part only: each rival is fitted, and what fits better begins anew."""
    soft = case(effects=("link_stiffness",), one_place=False, rows=300)
    found = loop.run_case(soft, arm)["result"]
    assert (found["verdict"], found["found"]) == ("named", [["link_stiffness"]])


def test_a_design_holds_every_combination_once():
    design = Design(plans=("grid", "sobol"), arms=2, repeats=3, pairs=190)
    cases = design.cases()
    assert len({c.id for c in cases}) == len(cases)
    places = 2 * 3 * 2 * 2  # arms, repeats, plans, rows
    count = {g: sum(c.group == g for c in cases) for g in GROUPS}
    assert count["none"] == places * len(SPOILED)
    assert count["single"] == count["removed"] == places * len(NAMES)
    assert count["pair"] == places * 190
    pairs = {frozenset(c.effects) for c in cases if c.group == "pair"}
    assert len(pairs) == math.comb(len(NAMES), 2)
    assert {c.one_place for c in cases if c.group == "single" and c.arm == 0} == {True, False}


@pytest.mark.parametrize(
    ("field", "value"), [("groups", ("some",)), ("effects", ("rust",)), ("rows", (20,))]
)
def test_a_design_refuses_what_it_does_not_know(field, value):
    with pytest.raises(InputError, match=field):
        Design(**{field: value})


def test_a_case_is_reproducible_and_differs_from_the_next(arm):
    one, same, other = (set_up(case(number=k), arm) for k in (0, 0, 1))
    np.testing.assert_array_equal(one.train.xyz, same.train.xyz)
    assert one.train.hash != other.train.hash
    assert len(one.train) == 40


@pytest.mark.parametrize("name", ["joint_gain", "camera_scale"])
def test_visible_means_left_after_a_geometry_refit(arm, name):
    """Hardly any of a small dose is left; the size asked for is reached, with fresh noise."""
    made = set_up(case(effects=(name,), rows=60), arm)
    assert made.visible[0] >= 1.0
    known = true_fit(made)
    blind = true_fit(set_up(case("none", (), rows=60), arm))
    assert {t.name for t in known.model.terms} - {t.name for t in blind.model.terms} == {name}


def test_geometry_errors_are_not_visible_effects(arm):
    """A joint zero is taken up by the refit whole."""
    from longarm_comp.core.data.plan import grid
    from studies.loop_setting import _Gauge

    rng = np.random.default_rng(5)
    gauge = _Gauge(arm, grid(arm, 60, rng).q, np.full(3, 3e-4), rng)
    assert gauge.visibility(hidden("joint_zero", arm, 1.0, rng)) < 0.3
    assert gauge.visibility(hidden("backlash", arm, 1.0, rng)) > 1.0


@pytest.mark.parametrize("name", sorted(set(NAMES) - {"measured_tilt"}))
def test_truth_speaks_the_words_of_the_library(arm, name):
    """Places and parameters of the simulator's effect are ones that the library's effect has."""
    effect = hidden(name, arm, 1.0, np.random.default_rng(1))
    terms = BUILT_IN[name].for_arm(arm)
    assert places(effect, arm) <= {t.where for t in terms}
    known = {(t.where if t.where in places(effect, arm) else "arm", p.name) for t in terms
             for p in t.declared()}  # fmt: skip
    assert set(values(effect, arm)) <= known
    lone = at_one_place(effect, arm, np.random.default_rng(2))
    assert len(places(lone, arm)) == min(1, len(places(effect, arm)))
    assert set(values(lone, arm).items()) <= set(values(effect, arm).items())


def test_true_values_are_recovered_by_the_true_model(arm):
    """Truth and library mean the same by a number: the true model's fit finds it."""
    for name in ("joint_gain", "backlash"):
        made = set_up(case(effects=(name,), rows=120, plan="sobol", noise=0.1), arm)
        fitted = true_fit(made)
        true = values(made.effects[0], made.arm)
        assert true
        for k, slot in enumerate(fitted.slots):
            key = slot.owner.where, slot.parameter.name
            if slot.owner.name == name and key in true:
                slack = 4 * fitted.standard_errors[k] + 0.02 * abs(true[key])
                assert abs(fitted.model.values[k] - true[key]) < slack, (name, key)


@pytest.mark.parametrize(("name", "tells"), [("joint_gain", True), ("servo_droop", False)])
def test_a_wrong_name_counts_where_the_rows_tell_it_from_the_right_one(arm, name, tells):
    """Droop of the servo and a soft joint turn the tip alike; a gain does not."""
    made = set_up(case(effects=("joint_compliance",), rows=120), arm)
    assert not told_apart(made, BUILT_IN["joint_compliance"].for_arm(arm))
    assert told_apart(made, BUILT_IN[name].for_arm(arm)) is tells


def test_wilson_interval():
    """Against the closed form's known values (Newcombe 1998, table I: 81/263 and 0/20)."""
    assert wilson(81 / 263, 263) == pytest.approx((0.2553, 0.3662), abs=1e-4)
    assert wilson(0.0, 20) == pytest.approx((0.0, 0.1611), abs=1e-4)
    assert share("x", "y", [None]) is None
    assert share("x", "y", [True, None, False])["share"] == 0.5


@pytest.fixture(scope="module")
def study(arm, tmp_path_factory):
    """A few small cases, run once: a name, nothing, and an effect that the arm cannot have."""
    out = tmp_path_factory.mktemp("study") / "loop.jsonl"
    cases = [
        case(effects=("friction_hysteresis",), one_place=True, rows=60),
        case("none", (), spoiled="clean"),
    ]
    with few_effects((FrictionHysteresis, Backlash, JointGain)):
        return cases, out, loop.run(cases, arm, out, jobs=1)


@pytest.mark.long
def test_results_say_what_was_hidden_and_found(study):
    cases, _, lines = study
    assert [x["case"]["id"] for x in lines] == [c.id for c in cases]
    lag, nothing = (x["result"] for x in lines)
    assert lag["covered"]
    assert lag["located"]
    assert lag["errors_mm"]["with_effects"] < lag["errors_mm"]["calibrated"]
    assert not nothing["found"]
    assert not nothing["dangerous"]


@pytest.mark.long
def test_tables(study):
    _, _, lines = study
    rows = {(r["of"], r["measure"]): r for r in summary(lines)}
    assert rows["none, grid 40", "adds an effect"]["hits"] == 0
    assert rows["single, grid 60", "right name, or a set with it"]["share"] == 1.0
    assert by_effect(lines)[0]["effect"] == "friction_hysteresis"
    assert not failures(lines)


def test_a_study_goes_on_where_it_was_broken_off(arm, tmp_path, monkeypatch):
    cases = [case("none", (), number=k) for k in range(2)]
    lines = [{"case": each.as_dict(), "result": {"found": []}} for each in cases]
    copy = tmp_path / "loop.jsonl"
    text = "".join(json.dumps(line) + "\n" for line in lines)
    copy.write_text(text + '{"case": {"id": "torn')
    ran = []
    monkeypatch.setattr(loop, "run_case", lambda c, a: ran.append(c.id))
    assert loop.run(cases, arm, copy, jobs=1) == lines
    assert not ran
    assert copy.read_text() == text


def test_a_foreign_file_is_refused(tmp_path, arm):
    path = tmp_path / "loop.jsonl"
    path.write_text('{"name": 1}\n')
    with pytest.raises(InputError, match="line 1"):
        loop.run([], arm, path)
    assert path.read_text() == '{"name": 1}\n'


def test_an_error_is_a_result(arm, monkeypatch):
    def broken(*_):
        raise InputError("here", "it", 1, "2")

    monkeypatch.setattr(loop, "set_up", broken)
    line = loop.run_case(case(), arm)
    assert "here" in line["error"]
    assert failures([line])
    assert not summary([line])


@pytest.mark.long
def test_processes_give_the_same_lines(arm, tmp_path):
    cases = [case("none", (), spoiled="clean")]
    lines = loop.run(cases, arm, tmp_path / "one.jsonl", jobs=1)
    made = loop.run(cases, arm, tmp_path / "a.jsonl", jobs=2)
    assert [x["result"] for x in made] == [x["result"] for x in lines]


@pytest.mark.long
def test_a_dask_cluster_gives_the_same_lines(arm, tmp_path):
    distributed = pytest.importorskip("dask.distributed")
    cases = [case("none", (), spoiled="clean")]
    lines = loop.run(cases, arm, tmp_path / "one.jsonl", jobs=1)
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, memory_limit=None
    ) as two:
        made = loop.run(cases, arm, tmp_path / "a.jsonl", dask=two.scheduler_address)
    assert [x["result"] for x in made] == [x["result"] for x in lines]


def test_a_dead_scheduler_is_one_clear_error(arm, tmp_path, monkeypatch):
    pytest.importorskip("dask.distributed")
    monkeypatch.setattr(cluster, "ANSWER_S", 1.0)
    with pytest.raises(InputError, match="--dask"):
        loop.run([case()], arm, tmp_path / "a.jsonl", dask="tcp://127.0.0.1:9")


@pytest.mark.long
def test_the_command_reads_the_file_and_prints(study, tmp_path, capsys):
    _, _, lines = study
    copy = tmp_path / "loop.jsonl"
    wanted = Design(groups=("none",), rows=(40,), arms=1, repeats=1).cases()
    made = [{"case": c.as_dict(), "result": lines[1]["result"]} for c in wanted]
    copy.write_text("".join(json.dumps(x) + "\n" for x in made))
    flags = ["--groups", "none", "--rows", "40", "--arms", "1", "--repeats", "1", "--json"]
    assert command_line(["study", "loop", "-o", str(copy), *flags]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["summary"][0]["n"] == len(SPOILED)
    assert command_line(["study", "loop", "-o", str(copy), "--groups", "no"]) == 2


def test_reliability_counts_every_name_at_its_probability():
    def line(group: str, true: list[str], *found: dict[str, float]) -> dict:
        stated = [[next(iter(names)), 1.0, names] for names in found]
        return {"case": {"group": group, "effects": true}, "result": {"probabilities": stated}}

    rows = reliability(
        [
            line("single", ["backlash"], {"backlash": 0.99, "joint_gain": 0.01}),
            line("single", ["backlash"], {"joint_gain": 0.97}),
            line("pair", ["backlash", "joint_gain"], {"joint_gain": 0.5, "backlash": 0.5}),
            line("none", [], {"joint_gain": 0.97}),
            line("removed", ["backlash"], {"joint_gain": 1.0}),
        ]
    )
    counted = {row["of"]: (row["hits"], row["n"], row["stated"]) for row in rows}
    assert counted["0.95 to 1"] == (1, 3, pytest.approx((0.99 + 0.97 + 0.97) / 3))
    assert counted["0.4 to 0.6"] == (2, 2, 0.5)
    assert counted["0.001 to 0.05"] == (0, 1, 0.01)
    assert len(counted) == 3
