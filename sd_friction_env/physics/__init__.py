"""The passive and the forced oscillator: parameters, motions, orbits, curves, basins; no Gymnasium, no drawing."""
