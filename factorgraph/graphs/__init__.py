"""GTSAM factor graphs: variables on a time grid, vectorised measurement blocks, our own outer loop.

`variables` owns keys and trajectories, `blocks` the measurements, `inertial` the native IMU factors and motion priors,
`optimizer` the iterations, `covariance` the joint covariances, `batch` the whole flight.
"""
