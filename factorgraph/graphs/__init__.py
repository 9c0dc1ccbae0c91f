"""GTSAM factor graphs: variables on a time grid, vectorised measurement blocks, our own outer loop.

`variables` owns keys and trajectories, `blocks` the measurements, `inertial_block` the IMUs, `inertial` priors of states and
motion, `optimizer` the iterations, `ordering` the order of elimination, `covariance` the joint covariances, `batch` the whole
flight.
"""
