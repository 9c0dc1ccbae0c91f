"""Measurement and motion models, each written once as a CasADi expression; Jacobians follow by automatic differentiation.

A model is model(symbols, *options) -> {output: expression}; `symbols` says what inputs and local columns are.
"""
