"""The model of an arm with its effects: prediction, columns of parameters, model file."""
