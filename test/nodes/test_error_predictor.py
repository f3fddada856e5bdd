"""`error_predictor` as a process: answers, refuses, reloads; `kinematics` takes its error off."""

import math
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from nodes_bench import Bench, bench
from own_graph import own_graph
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from std_msgs.msg import String
from std_srvs.srv import Trigger
from target_requests import pose as posed

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.files import file_hash
from longarm_comp.core.learn.ensemble import train
from longarm_comp.core.learn.others import load_file
from longarm_comp.core.learn.predictor import Predictor, Provenance
from longarm_comp.core.learn.predictor_file import load, save
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model_file import save_model, store
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes import predictor_client
from longarm_comp.nodes.messages import joints_message
from longarm_comp.nodes.predictor_client import NoAnswer, PredictorClient, ServedPredictor
from longarm_interfaces.srv import Compensate, PredictError

BIAS = np.array([0.002, -0.001, 0.004])


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    with own_graph(tmp_path_factory.mktemp("predictor"), freezes=True), bench() as made:
        yield made


def trained(arm: Arm, bias: np.ndarray, **settings: object) -> Predictor:
    """Learned around the middle of the joint box: a constant error and a slope."""
    rng = np.random.default_rng(3)
    q = arm.mid + 0.2 * (arm.upper - arm.lower) * (rng.random((60, arm.n)) - 0.5)
    residual = bias + 0.01 * (q[:, :3] - arm.mid[:3]) + 1e-4 * rng.standard_normal((60, 3))
    return train(
        q, residual, init="xavier", ensemble=2, hidden=4, inputs="joints",
        provenance=Provenance(arm_hash=arm.hash, joint_names=arm.joint_names, settings=settings),
    )  # fmt: skip


def question(arm: Arm, q: np.ndarray) -> PredictError.Request:
    return PredictError.Request(
        joints=joints_message(arm, q), temperature_c=math.nan, payload_kg=math.nan
    )


def test_a_network_of_others_is_served_and_said(
    stage: Bench, arm: Arm, demo_arm_path: Path, tmp_path: Path
) -> None:
    small, path = tmp_path / "small.py", tmp_path / "predictor.safetensors"
    small.write_text("import torch\nnetwork = torch.nn.Linear\n")
    rng = np.random.default_rng(3)
    q = arm.mid + 0.2 * (arm.upper - arm.lower) * (rng.random((60, arm.n)) - 0.5)
    residual = BIAS + 0.05 * (q[:, :3] - arm.mid[:3]) + 1e-4 * rng.standard_normal((60, 3))
    origin = Provenance(arm_hash=arm.hash, joint_names=arm.joint_names)
    made = train(q, residual, ensemble=2, network=load_file(small), provenance=origin)
    save(made, path)
    said = stage.collect(graph.DIAGNOSTICS)
    files = {"arm": demo_arm_path, "predictor": path}
    stage.start("error_predictor", files, namespace="other", words=("--network", str(small)))
    ask = stage.node.create_client(PredictError, "/other/predict_error")
    answer = stage.call(ask, question(arm, arm.mid))
    assert answer.success, answer.message
    told = np.array([answer.error.x, answer.error.y, answer.error.z])
    np.testing.assert_allclose(told, made.predict(arm.mid[None]).error[0], atol=1e-12)
    np.testing.assert_allclose(
        np.reshape(answer.jacobian, (3, arm.n))[:, :3].diagonal(), 0.05, atol=5e-3
    )
    assert not any(answer.reach)
    assert ServedPredictor.find(f"{file_hash(path)} {path}", arm) is None  # it takes torch
    stage.spin(lambda: "small, with torch" in str(said))


def test_the_learned_error_is_predicted_taken_off_and_replaced(
    stage: Bench, arm: Arm, demo_arm_path: Path, tmp_path: Path
) -> None:
    path = tmp_path / "predictor.npz"
    first = trained(arm, BIAS)
    save(first, path)
    files = {"arm": demo_arm_path, "predictor": path, "watch_period_s": 0.1}
    predictor = stage.start("error_predictor", files)
    stage.start("kinematics", {"arm": demo_arm_path})
    handed_out = stage.collect(graph.PREDICTED_ERROR)
    ask = graph.PREDICT_ERROR.client(stage.node)
    compensate = graph.COMPENSATE.client(stage.node)

    answer = stage.call(ask, question(arm, arm.mid))
    assert answer.success and answer.in_domain
    told = np.array([answer.error.x, answer.error.y, answer.error.z])
    np.testing.assert_allclose(told, first.predict(arm.mid[None]).error[0], atol=1e-12)
    stage.spin(lambda: handed_out)
    assert handed_out[0].vector == answer.error
    assert handed_out[0].header.frame_id == "base"

    outside = stage.call(ask, question(arm, arm.upper))
    assert not outside.success and not outside.in_domain
    assert "training range" in outside.message
    nameless = question(arm, arm.mid)
    nameless.joints.name[2] = "elbow"
    wrong = stage.call(ask, nameless)
    assert not wrong.success and "elbow" in wrong.message

    model = declared_model(arm)
    target = model.pose(arm.mid)
    request = Compensate.Request(
        target=posed(target), seed=joints_message(arm, arm.mid), position_only=True
    )
    met = lambda: stage.call(compensate, request).status == Compensate.Response.SUCCESS  # noqa: E731
    stage.spin(met)  # kinematics hears of the predictor on its own, not when this process does
    answer = stage.call(compensate, request)
    assert answer.status == Compensate.Response.SUCCESS, answer.message
    assert answer.in_domain and answer.passes >= 1
    command = np.array(answer.command.position)
    error = first.predict(command[None]).error[0]
    np.testing.assert_allclose(model.tip(command) + error, target[:3, 3], atol=3e-5)

    before = len(handed_out)
    assert stage.call(compensate, request).success
    stage.spin(lambda: len(handed_out) > before)  # whoever computed it
    assert handed_out[-1].header.frame_id == "base"

    stories = stage.collect(graph.COMPENSATION)
    far = Compensate.Request(
        target=posed(model.pose(arm.upper)), seed=joints_message(arm, arm.upper)
    )
    answer = stage.call(compensate, far)
    assert answer.status == Compensate.Response.OUT_OF_DOMAIN
    assert answer.success and "physics only" in answer.message
    np.testing.assert_allclose(answer.command.position, answer.ideal.position)

    second = trained(arm, -BIAS)
    save(second, path)

    def taken_up() -> bool:
        error = stage.call(ask, question(arm, arm.mid)).error
        return error.z < 0

    stage.spin(taken_up)
    path.write_bytes(b"no predictor")
    reload = graph.RELOAD.client(stage.node, of="error_predictor")
    answer = stage.call(reload, Trigger.Request())
    assert not answer.success and str(path) in answer.message
    assert stage.call(ask, question(arm, arm.mid)).success  # the last good one is kept

    # one that hangs is asked a second later: one target waits for it, the others do not
    told = []

    def lost() -> bool:
        told.append(stage.call(compensate, request))
        return bool(told[-1].status == Compensate.Response.NO_PREDICTOR)

    predictor.send_signal(signal.SIGSTOP)
    stage.spin(lost)
    told = [told[-1], *(stage.call(compensate, request) for _ in range(4))]
    predictor.send_signal(signal.SIGCONT)
    assert {answer.status for answer in told} == {Compensate.Response.NO_PREDICTOR}
    assert "did not answer within" in told[0].message
    assert all("does not answer" in answer.message for answer in told[1:])
    stage.spin(lambda: stage.call(compensate, request).status == Compensate.Response.SUCCESS)

    predictor.kill()
    predictor.wait(timeout=300)

    def alone() -> bool:
        answer = stage.call(compensate, request)
        return answer.status == Compensate.Response.NO_PREDICTOR

    stage.spin(alone)
    save(second, path)
    stage.start("error_predictor", files)
    stage.spin(lambda: stage.call(compensate, request).status == Compensate.Response.SUCCESS)
    stage.spin(lambda: stories and stories[-1].predictor_hash)


def test_a_predictor_of_another_model_is_refused(
    stage: Bench, arm: Arm, demo_arm_path: Path, tmp_path: Path
) -> None:
    """Another physics leaves another error: what was learned on the old one does not hold."""
    model, path = tmp_path / "model.yaml", tmp_path / "predictor.npz"
    save_model(model, store(declared_model(arm)))
    save(trained(arm, BIAS, model_hash=file_hash(model)), path)
    files = {"arm": demo_arm_path, "model": model, "predictor": path, "watch_period_s": 0.1}
    stage.start("error_predictor", files, namespace="bound")
    ask = stage.node.create_client(PredictError, "/bound/predict_error")
    good = lambda: stage.call(ask, question(arm, arm.mid)).success  # noqa: E731
    stage.spin(good)
    model.write_text("rubbish: [")  # kinematics keeps its last good model, and this does too
    reload = stage.node.create_client(Trigger, "/bound/error_predictor/reload")
    stage.call(reload, Trigger.Request())
    assert good()
    save_model(model, store(declared_model(arm).rigid))
    stage.spin(lambda: not good())
    answer = stage.call(ask, question(arm, arm.mid))
    assert math.isnan(answer.sigma) and "model_hash" in answer.message
    save(trained(arm, -BIAS, model_hash=file_hash(model)), path)
    stage.spin(good)
    assert stage.call(ask, question(arm, arm.mid)).error.z < 0


def test_a_predictor_that_learned_the_sag_too_is_not_added_to_it(
    stage: Bench, arm: Arm, demo_arm_path: Path, tmp_path: Path
) -> None:
    save(trained(arm, BIAS, deflection=False), tmp_path / "network.npz")
    files = {"arm": demo_arm_path, "predictor": tmp_path / "network.npz"}
    stage.start("error_predictor", files, namespace="rigid")
    stage.start("kinematics", {"arm": demo_arm_path}, namespace="rigid")
    compensate = stage.node.create_client(Compensate, "/rigid/compensate")
    request = Compensate.Request(
        target=posed(declared_model(arm).pose(arm.mid)), seed=joints_message(arm, arm.mid)
    )
    stage.spin(lambda: "'network'" in stage.call(compensate, request).message)
    answer = stage.call(compensate, request)
    assert answer.status == Compensate.Response.NO_PREDICTOR
    assert answer.command.position == answer.ideal.position

    change = stage.node.create_client(SetParameters, "/rigid/kinematics/set_parameters")
    value = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value="network")
    stage.call(change, SetParameters.Request(parameters=[Parameter(name="method", value=value)]))
    answer = stage.call(compensate, request)
    assert answer.status == Compensate.Response.SUCCESS, answer.message


class Asked:
    """A client of the service, as `PredictorClient` wants it; without one nobody is asked."""

    def __init__(self, stage: Bench, client: object = None) -> None:
        self._stage, self._client, self.present = stage, client, client is not None

    def send(self, request: PredictError.Request) -> PredictError.Request:
        return request

    def answer(self, request: PredictError.Request, within_s: float) -> PredictError.Response:
        return self._stage.call(self._client, request)


def test_the_error_computed_from_the_served_file_is_that_of_the_service(
    stage: Bench, arm: Arm, demo_arm_path: Path, tmp_path: Path
) -> None:
    model, path = tmp_path / "model.yaml", tmp_path / "predictor.npz"
    save_model(model, store(declared_model(arm)))
    rng = np.random.default_rng(7)
    q = arm.mid + 0.2 * (arm.upper - arm.lower) * (rng.random((120, arm.n)) - 0.5)
    side = rng.choice([-1.0, 1.0], (120, arm.n))
    warm = {"temperature_c": rng.uniform(15.0, 25.0, 120)}
    residual = 2e-3 * side[:, :3] + 1e-4 * warm["temperature_c"][:, None] * [1, 0, 1]
    origin = Provenance(arm.hash, "", arm.joint_names, {"model_hash": file_hash(model)})
    learn = {"init": "xavier", "ensemble": 2, "hidden": 4, "provenance": origin}
    save(train(q, residual, Context(tuple(side.T), warm), **learn), path)
    said = stage.collect(graph.SERVED, "twice")
    files = {"arm": demo_arm_path, "model": model, "predictor": path, "watch_period_s": 0.1}
    stage.start("error_predictor", files, namespace="twice")
    ask, told = stage.node.create_client(PredictError, "/twice/predict_error"), []
    service = PredictorClient(Asked(stage, ask), arm, 300.0)
    here = PredictorClient(Asked(stage), arm, 0.5, told.append)

    known = Context(tuple(side[0].tolist()), {"temperature_c": 21.0})

    def serves(digest: str) -> None:
        stage.spin(lambda: said and said[-1].data.partition(" ")[0] == digest)
        here.on_served(said[-1], time.monotonic() + 1e6)  # however long the test takes

    def alike() -> np.ndarray:
        """Compare them, and return the error at the first row."""
        serves(file_hash(path))
        service.on_served(String(data=f"{file_hash(path)} /nowhere/predictor.npz"), 0.0)
        for client in (here, service):  # also where it expects nothing, it is known who answered
            assert not client.ask(arm.upper, known).in_domain
            assert client.file_hash == file_hash(path)
        inside = set()
        for k, columns in enumerate(({"temperature_c": 21.0}, {}, {"payload_kg": 0.5})):
            for joints in (q[k], arm.upper):
                for sides in (tuple(side[k].tolist()), ()):
                    context = Context(sides, columns)
                    found, answer = here.ask(joints, context), service.ask(joints, context)
                    for name, value in vars(answer).items():
                        np.testing.assert_array_equal(getattr(found, name), value, err_msg=name)
                    inside.add(found.in_domain)
        assert inside == {True, False}
        assert here.file_hash == service.file_hash == file_hash(path)
        return here.ask(q[0], known).error

    first = alike()
    np.testing.assert_array_equal(told[-1], first)
    assert len(told) < 13  # inside the domain alone
    before = path.read_bytes()
    save(train(q, -residual, Context(tuple(side.T), warm), **learn), path)
    assert not np.allclose(alike(), first)
    second = said[-1].data
    path.write_bytes(before)
    assert ServedPredictor.find(second, arm) is None  # another file than it was told of
    with pytest.raises(NoAnswer, match="'both'"):
        here.ask(q[0], known, deflection=False)
    here.on_served(said[-1], time.monotonic() - 60.0)  # its sender may be gone by now
    with pytest.raises(NoAnswer, match="no error_predictor"):
        here.ask(q[0], known)
    assert not here.answers
    save_model(model, store(declared_model(arm).rigid))
    serves("")  # it lacks its model: nothing is served, and nothing computed here
    with pytest.raises(NoAnswer, match="no error_predictor"):
        here.ask(q[0], known)
    with pytest.raises(NoAnswer, match="model_hash"):
        service.ask(q[0], known)


def test_a_file_that_cannot_be_read_here_is_asked_for(
    arm: Arm, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "predictor.npz"
    save(trained(arm, BIAS), path)
    told = ServedPredictor.read(str(path), arm).describe(str(path))
    assert ServedPredictor.find(told, arm) is not None

    def refuse(path: str) -> str:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(predictor_client, "file_hash", refuse)
    assert ServedPredictor.find(told, arm) is None
    path.unlink()
    monkeypatch.undo()
    assert ServedPredictor.find(told, arm) is None


def test_a_file_that_changes_while_it_is_read_is_read_again(
    arm: Arm, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "predictor.npz"
    last = trained(arm, -BIAS)
    save(trained(arm, BIAS), path)

    def load_and_replace(*given: object, **more: object) -> Predictor:
        found = load(*given, **more)
        save(last, path)
        return found

    monkeypatch.setattr(predictor_client, "load", load_and_replace)
    found = ServedPredictor.read(str(path), arm)
    assert found.file_hash == file_hash(path)
    np.testing.assert_array_equal(found.predictor.weights, last.weights)


def test_every_joint_has_a_side_of_its_own(
    stage: Bench, arm: Arm, demo_arm_path: Path, tmp_path: Path
) -> None:
    rng = np.random.default_rng(5)
    q = arm.mid + 0.2 * (arm.upper - arm.lower) * (rng.random((60, arm.n)) - 0.5)
    side = rng.choice([-1.0, 1.0], (60, arm.n))
    learned = train(
        q, 2e-3 * side[:, :3] + 1e-4 * rng.standard_normal((60, 3)), Context(tuple(side.T)),
        init="xavier", ensemble=1, hidden=3,
        provenance=Provenance(arm_hash=arm.hash, joint_names=arm.joint_names),
    )  # fmt: skip
    save(learned, tmp_path / "sided.npz")
    files = {"arm": demo_arm_path, "predictor": tmp_path / "sided.npz"}
    stage.start("error_predictor", files, namespace="sided")
    ask = stage.node.create_client(PredictError, "/sided/predict_error")
    for mixed in (side[0], np.ones(arm.n)):
        request = question(arm, arm.mid)
        request.approach = mixed.astype(np.int8).tolist()
        request.joints.name.reverse()  # sides go with the names
        request.joints.position = request.joints.position[::-1]
        request.approach = request.approach[::-1]
        error = stage.call(ask, request).error
        want = learned.predict(arm.mid[None], Context(tuple(mixed))).error[0]
        np.testing.assert_allclose([error.x, error.y, error.z], want, atol=1e-12)
    request.approach = [1]
    assert stage.call(ask, request).error == error  # one for all
    for wrong, what in (([1, -1], "7 joints, 2 sides"), ([3] * arm.n, "-1, 0 or")):
        request.approach = wrong
        answer = stage.call(ask, request)
        assert not answer.success and what in answer.message
