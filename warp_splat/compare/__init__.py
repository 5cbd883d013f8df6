"""Adjoints, knobs and shortcuts of splatting compared: error against run time."""
