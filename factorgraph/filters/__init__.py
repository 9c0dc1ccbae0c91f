"""Recursive filters.

Building blocks: `kalman`, `sigma_points`, `updates`, `adaptive`, `smoother`, `discretise`, `inertial`, `ahrs`. Published systems
of filters: `float_ambiguity`, `two_stage`, `tightly_coupled`, `relative`. Any assembled flight: `sequential` sees it stage by
stage, `recursive` filters it, `course` smooths it.
"""
