"""The learned residual: sparrow search (SSA), BP network, a predictor with uncertainty.

``ensemble.train`` trains a ``predictor.Predictor``; ``predictor_file`` saves and loads it.
Nothing is imported here, so that a node that only predicts needs only numpy.
"""
