"""GTSAM as the engine of assembled problems: elimination in the order of time, covariances, the whole flight as one graph.

`engine` linearises and eliminates, `ordering` says in what order, `covariance` reads joint covariances off the Bayes net,
`batch` is the method.
"""
