"""One posterior over explanations: a sum of single effects, each with its credible set."""
