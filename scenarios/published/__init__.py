"""Scenarios of publications, with their published constants, data sets and faults."""
