"""A problem as residual rows over one time grid: what all ways of solving it share, and no solver.

`variables` owns keys and trajectories, `blocks` and its siblings (`sensors`, `constraints`, `inertial_block`, `priors`, ...) the
rows with their Jacobians, `build` makes them from a problem, `optimizer` iterates, `integers` fixes ambiguities, `flight` is the
whole course from start values to `result`. What eliminates the linear systems is an `engine`.
"""
