"""A surface from a trained model: depth maps of its views fused, and what simulators need of it."""
