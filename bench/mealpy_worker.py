"""The peer's process of the sparrow benchmark; it runs in mealpy's own environment.

Reads one JSON object a line (``data``: npz with x, y; ``hidden``, ``population``, ``epochs``,
``seed``), answers one JSON object a line. It must not import longarm_comp: that is not installed
there.
"""

import json
import sys
import time

import numpy as np
from mealpy import SSA, FloatVar


def main() -> None:
    """Answer requests until the input ends."""
    for line in sys.stdin:
        request = json.loads(line)
        with np.load(request["data"]) as data:
            x, y = data["x"], data["y"]
        hidden, inputs, outputs = request["hidden"], x.shape[1], y.shape[1]
        first = inputs * hidden
        second = first + hidden
        third = second + hidden * outputs
        size = third + outputs

        def fitness(w: np.ndarray) -> float:
            z = np.tanh(x @ w[:first].reshape(inputs, hidden) + w[first:second])  # noqa: B023
            e = z @ w[second:third].reshape(hidden, outputs) + w[third:] - y  # noqa: B023
            return float(np.mean(e * e))

        search = SSA.OriginalSSA(epoch=request["epochs"], pop_size=request["population"])
        box = FloatVar(lb=[-1.0] * size, ub=[1.0] * size)
        problem = {"bounds": box, "minmax": "min", "obj_func": fitness, "log_to": None}
        begin = time.perf_counter()
        best = search.solve(problem, seed=request["seed"])
        seconds = time.perf_counter() - begin
        answer = {
            "evaluations": int(search.nfe_counter),
            "seconds": seconds,
            "fitness": float(best.target.fitness),
        }
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
