"""Estimation: measurement streams, the navigation problem, estimators and their solution.

`measurements` and `problem` say what is known, `registry.solve` runs a method, `solution` is what comes back.
Engines (GTSAM, CasADi) are imported only in the rooms that use them.
"""
