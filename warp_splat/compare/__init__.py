"""Adjoint against adjoint, knob against knob, splats against physics: error and run time, measured."""
