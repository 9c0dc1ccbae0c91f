"""Flights with known truth: scenario descriptions, smooth trajectories, sensors with errors, flight folders.

`load_scenario` reads a description, `simulate` turns it and a seed into a navigation problem with a record of every
error put in, `scenarios.simulate.write.write_flight` writes it as a flight folder.
"""

from scenarios.simulate.flight import Record, SimulatedFlight, simulate
from scenarios.simulate.scenario import Scenario, load_scenario

__all__ = ["Record", "Scenario", "SimulatedFlight", "load_scenario", "simulate"]
