"""One posterior over explanations, beside the search until it takes its place."""
