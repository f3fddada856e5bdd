"""The diagnosis: the effects that the model lacks, their proof, and poses that would tell more."""
