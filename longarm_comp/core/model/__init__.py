"""The model of an arm with its effects: prediction, derivatives by parameters, model file."""
