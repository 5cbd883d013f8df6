"""Stiff and extreme cases: what float64 says, and what every adjoint gives."""
