"""Least squares without a graph library: the linear problem of a whole flight, solved along time.

`fronts` takes rows over a few variables each, with the stages these live at, and gives steps, covariances and marginals by
a chain of dense fronts; it knows nothing of sensors. `functions` evaluates symbolic models over all samples of a flight.
"""
