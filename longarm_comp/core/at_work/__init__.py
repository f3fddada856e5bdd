"""The model at work: what sightings of ordinary moves say of it, without a stop."""
