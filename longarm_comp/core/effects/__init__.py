"""Effects: the physical causes of errors, each a small twist at one frame; and biases."""
