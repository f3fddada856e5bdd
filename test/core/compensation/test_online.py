"""What is known right now becomes a context: freshness, sides, and the pose at rest."""

import dataclasses
from functools import partial

import numpy as np
import pytest
from small_arm import ARM

from longarm_comp.core.arm.history import History
from longarm_comp.core.arm.parts import Payload
from longarm_comp.core.compensation.arrive import compensate_move
from longarm_comp.core.compensation.online import Readings, StaleContext
from longarm_comp.core.compensation.result import Status
from longarm_comp.core.data.rest import RestWatch
from longarm_comp.core.effects.measured_tilt import MeasuredTilt
from longarm_comp.core.effects.plays import Backlash
from longarm_comp.core.effects.slow_changes import ThermalGrowth
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.link_frames import exaggerate_sag, outline
from longarm_comp.core.model.model import Model

WARM = Model(ARM, (ThermalGrowth(8e-5),))


def told(**columns: float) -> Readings:
    made = Readings()
    for name, value in columns.items():
        made = made.with_reading(name, {name: value}, 100.0)
    return made


def test_only_what_the_model_needs_must_be_fresh() -> None:
    made = told(temperature_c=30.0)
    assert made.context(WARM, 105.0, 10.0).columns == {"temperature_c": 30.0}
    with pytest.raises(StaleContext, match=r"temperature_c is 20\.0 s old"):
        made.context(WARM, 120.0, 10.0)
    with pytest.raises(StaleContext, match="temperature_c was never published"):
        told().context(WARM, 100.0, 10.0)
    assert made.context(Model(ARM), 120.0, 10.0).columns == {}


def test_a_payload_that_was_told_holds_for_a_while_and_then_says_so() -> None:
    """Never told, it is the declared one; told long ago, nobody knows what hangs there."""
    carrying = Model(ARM.model_copy(update={"payload": Payload(mass_kg=0.2, frame=4)}))
    made = told(payload_kg=0.1)
    assert made.context(carrying, 110.0, 10.0).columns == {"payload_kg": 0.1}
    for model, now_s in ((carrying, 110.1), (carrying, 1e6)):
        with pytest.raises(StaleContext, match=r"payload_kg is \S+ s old"):
            made.context(model, now_s, 10.0)
    assert Readings().context(carrying, 1e6, 10.0).columns == {}
    assert made.context(Model(ARM), 1e6, 10.0).columns == {}, "it carries nothing"


def test_circumstances_that_an_arm_cannot_be_in_are_a_doubt_until_better_ones_are_told() -> None:
    wrong = told(temperature_c=30.0).with_reading(
        "temperature_c", {"temperature_c": 900.0}, 101.0, "hot!"
    )
    assert wrong.fresh("temperature_c", 101.0, 10.0) == {}
    for now_s in (102.0, 1e6):
        with pytest.raises(StaleContext, match="hot!"):
            wrong.context(WARM, now_s, 10.0)
    assert wrong.context(Model(ARM), 102.0, 10.0).columns == {}, "nothing needs it"
    better = wrong.with_reading("temperature_c", {"temperature_c": 31.0}, 102.0)
    assert better.context(WARM, 102.0, 10.0).columns == {"temperature_c": 31.0}
    weighed = told(payload_kg=9.0).with_reading(
        "payload_kg", {"payload_kg": 9.0}, 101.0, "too heavy"
    )
    carrying = Model(ARM.model_copy(update={"payload": Payload(mass_kg=0.2, frame=4)}))
    with pytest.raises(StaleContext, match="too heavy"):
        weighed.context(carrying, 102.0, 10.0)
    with pytest.raises(StaleContext, match="too heavy"):  # wherever it hangs
        weighed.context(Model(ARM), 102.0, 10.0)
    felt = weighed.with_reading("load", {"payload_kg": 0.3}, 102.0)
    assert felt.context(carrying, 102.0, 10.0).columns == {"payload_kg": 0.3}, "what is felt counts"


def test_an_inclinometer_belongs_to_its_frame() -> None:
    tilted = Model(ARM, (MeasuredTilt(frame=0),))
    reading = Readings().with_reading("0", {"incl_0_x": 0.01, "incl_0_y": 0.0}, 1.0)
    assert reading.context(tilted, 2.0, 5.0).columns["incl_0_x"] == 0.01
    other = Readings().with_reading("3", {"incl_3_x": 0.01, "incl_3_y": 0.0}, 1.0)
    with pytest.raises(StaleContext, match="incl_0_x"):
        other.context(tilted, 2.0, 5.0)


def test_joints_arrive_from_where_they_last_moved() -> None:
    path = np.array([[0, 0, 0, 0], [1, 1, 1, 0], [2, 0.5, 1, 0]], float)
    before = np.array([-1, -1, -1, -1])
    history = dataclasses.replace(History.unknown(4), approach=before)
    assert history.after(path[1:], path[0]).approach.tolist() == [1, -1, 1, -1]
    assert history.after(path[:1], path[0]).approach.tolist() == before.tolist()


def test_backlash_is_compensated_for_the_side_of_this_move() -> None:
    gap = 0.02
    model = Model(ARM, (Backlash(joint=ARM.commanded[0], width=gap),))
    rigid = Model(ARM)
    target = rigid.tip(ARM.mid)
    commands = []
    for step in (-0.2, 0.2):
        start = ARM.mid + step * (ARM.upper - ARM.lower) * [1, 0, 0, 0]
        arrival = compensate_move(
            model, None, target, start=start, history=History.unknown(ARM.n),
            context_after=partial(told().context, model, 100.0, 10.0),
        )  # fmt: skip
        made, context = arrival.outcome, arrival.context
        assert made.status is Status.NO_PREDICTOR
        assert context.approach[0] == -np.sign(step)
        np.testing.assert_allclose(model.tip(made.command, context), target, atol=2e-6)
        commands.append(made.command[0])
    assert commands[0] != pytest.approx(commands[1], abs=gap / 4)


def test_a_rest_pose_is_handed_out_once_and_only_at_rest() -> None:
    watch = RestWatch(settle_s=0.5, sightings=2)
    goal, side = np.full(4, 0.3), History.unknown(4)
    variance = np.full(3, 4e-8)
    assert watch.on_sighting(np.zeros(3), variance, 0.0) is None  # never commanded
    watch.on_command(goal, side)
    watch.joints(goal + 0.1, 1.0)
    assert watch.on_sighting(np.zeros(3), variance, 1.1) is None  # on the way
    watch.joints(goal, 2.0)
    assert watch.on_sighting(np.zeros(3), variance, 2.4) is None  # not settled
    assert watch.on_sighting(np.array([1.0, 0, 0]), variance, 2.6) is None  # the first of two
    assert watch.on_sighting(np.full(3, np.nan), variance, 2.7) is None  # lost
    rest = watch.on_sighting(np.array([3.0, 0, 0]), variance, 2.8)
    assert rest is not None
    np.testing.assert_allclose(rest.tip, [2.0, 0, 0])
    np.testing.assert_allclose(rest.variance, variance / 2)
    assert watch.on_sighting(np.array([3.0, 0, 0]), variance, 3.0) is None  # once
    watch.on_command(goal, side)
    watch.joints(goal, 4.0)
    watch.joints(goal + 0.01, 4.2)  # it moved after all
    watch.joints(goal, 4.4)
    assert watch.on_sighting(np.zeros(3), variance, 4.7) is None
    watch.joints(goal, 1.0)  # the clock jumped back
    assert watch.on_sighting(np.zeros(3), variance, 1.6) is None  # the first of two
    assert watch.on_sighting(np.zeros(3), variance, 1.7) is not None
    with pytest.raises(InputError):
        RestWatch(sightings=0)


def test_the_outline_runs_from_the_foot_to_the_tip() -> None:
    line = outline(Model(ARM), ARM.mid)
    np.testing.assert_allclose(line[-1], Model(ARM).tip(ARM.mid))
    np.testing.assert_allclose(exaggerate_sag(line + 1.0, line, 3.0), line + 3.0)
