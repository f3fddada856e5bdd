"""`error_predictor`: predicts the learned error at given joints; refuses outside its domain."""

import math
from pathlib import Path

from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import String

from longarm_comp.core.errors import LongarmError
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.clock import steady_timer
from longarm_comp.nodes.frames import prefix_of
from longarm_comp.nodes.health import ERROR, OK, PERIOD, WARN, Report
from longarm_comp.nodes.messages import error_message, joints_of, sides_of, vector_message
from longarm_comp.nodes.model_files import ModelFiles
from longarm_comp.nodes.node import WATCH, ArmNode, program
from longarm_comp.nodes.params import Param
from longarm_comp.nodes.predictor_client import BEAT_S, ServedPredictor
from longarm_comp.nodes.worker import Reply
from longarm_interfaces.srv import PredictError

PARAMS = (
    Param("arm", "", "arm.yaml: the declared arm that the predictor must belong to"),
    Param("model", "", "model.yaml that it must have been trained with; empty: none"),
    Param("predictor", "", "predictor file; empty: none, every question is refused"),
    Param("base_frame", "base", "frame of the predicted errors"),
    WATCH,
    PERIOD,
)

_OUTSIDE = "outside the training data"


class _ErrorPredictor(ArmNode):
    """The node, which answers requests on one thread and loads files on another."""

    def __init__(self, executor: SingleThreadedExecutor) -> None:
        super().__init__(executor, "error_predictor", PARAMS)
        p = self.p
        self._model = ModelFiles(p["arm"], p["model"])
        self._arm = self._model.arm
        self._path, self._base_frame = p["predictor"], prefix_of(self) + p["base_frame"]
        self._loaded: ServedPredictor | None = None
        self._fault = self._of_model = ""
        self.tally.counts |= {"answered": 0, _OUTSIDE: 0, "refused": 0}
        asked, files = self.worker(100), self.worker(4)
        self._errors = graph.PREDICTED_ERROR.publisher(self)
        self._served = graph.SERVED.publisher(self)
        self._reload_files()
        # On the thread that reloads, so that the last message always names the file in use
        steady_timer(self, BEAT_S, lambda: files.submit_once(self._tell_served))
        self.on_request(graph.RELOAD, files, lambda request: self._reload_files())
        self.on_change((self._path, p["model"]), files, self._reload_files)
        self.health.parts["predictor"] = self._report_predictor
        files.start()
        asked.serve(graph.PREDICT_ERROR, self._on_predict)
        asked.start()

    def _on_predict(self, request: PredictError.Request, reply: Reply, sent: float | None) -> None:
        response = PredictError.Response(sigma=math.nan, error=vector_message([math.nan] * 3))
        loaded = self._loaded
        try:
            if loaded is None:
                response.message = self._fault or "no predictor file is configured"
                self.tally.count("refused", "")
            else:
                q = joints_of(request.joints, self._arm, "predict_error")
                names = request.joints.name
                side = sides_of(request.approach, names, self._arm, "predict_error")
                sides = tuple(side.tolist())
                found = loaded.expand(q, sides, request.temperature_c, request.payload_kg)
                response.success = response.in_domain = found.in_domain
                response.error = vector_message(found.error)
                response.sigma = float(found.sigma[0])
                response.message = loaded.file_hash if found.in_domain else found.reason
                response.jacobian = found.jacobian.ravel()
                response.reach = found.reach
                response.beside_deflection = loaded.beside_deflection
                self.tally.count("answered" if found.in_domain else _OUTSIDE, "")
                self.tally.last = found.reason or self.tally.last
        except LongarmError as error:
            self.tally.count("refused", str(error))
            response.message = str(error)
            response.sigma = math.inf  # a predictor is loaded, but the request was invalid
        except Exception as error:
            self.health.fault(error)
            response.message = f"{type(error).__name__}: {error}"
        reply(response)
        if response.success:
            stamp = self.get_clock().now().to_msg()
            self._errors.publish(error_message(response.error, stamp, self._base_frame))

    def _reload_files(self) -> tuple[bool, str]:
        """Read the predictor's file again; on failure keep it, unless model.yaml has changed."""
        if not self._path:
            return False, "no predictor file is configured"
        self._model.reload()
        model = self._model.loaded.file_hash
        try:
            self._loaded = ServedPredictor.read(self._path, self._arm, model)
        except LongarmError as error:
            self._fault = str(error)
            if self._of_model != model:
                self._loaded = None
            return False, self._fault
        finally:
            self._tell_served()
        self._fault, self._of_model = "", model
        return True, f"{self._path} {self._loaded.file_hash[:12]}"

    def _tell_served(self) -> None:
        """Publish which predictor file is in use; an empty text if none is."""
        told = self._loaded.describe(self._path) if self._loaded else ""
        self._served.publish(String(data=told))

    def _report_predictor(self) -> Report:
        network = self._loaded.predictor.network if self._loaded else None
        facts = {
            "file": self._path,
            "sha256": self._loaded.file_hash if self._loaded else "",
            **({"network": f"{network.name}, with torch"} if network else {}),
            **self.tally.facts,
        }
        if self._loaded is None:
            if self._fault and Path(self._path).exists():
                return Report(ERROR, self._fault, facts)
            which = f"{self._path} is not there" if self._path else "no file is configured"
            return Report(WARN, f"no predictor: {which}; physics alone is used", facts)
        if self._fault:
            return Report(WARN, f"the last good predictor is kept: {self._fault}", facts)
        return Report(OK, "predicting", facts)


main = program(_ErrorPredictor)

if __name__ == "__main__":
    main()
