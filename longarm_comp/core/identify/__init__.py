"""The diagnosis: what the model lacks, the proof, and the poses that would tell more."""
