"""Splats against the emission-absorption equation, in float64."""
