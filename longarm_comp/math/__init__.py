"""Mathematics that arm and cameras share: arrays in, arrays out."""
