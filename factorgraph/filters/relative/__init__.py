"""Relative navigation of a formation: one filter of every follower's velocity and position against a reference vehicle.

`motion` predicts them (attitudes and accelerometers of all vehicles, or constant velocity and acceleration), `rows` states what
is measured, `filtering` runs, `flight` applies all of it to a navigation problem. With two vehicles it is the 12-state filter of
Lu et al. (2024).
"""
