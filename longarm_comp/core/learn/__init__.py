"""The learned residual: sparrow search (SSA), BP network, predictor with its own doubts."""

from longarm_comp.core.learn.ensemble import train
from longarm_comp.core.learn.predictor import Prediction, Predictor, Provenance
from longarm_comp.core.learn.predictor_file import load

__all__ = ["Prediction", "Predictor", "Provenance", "load", "train"]
