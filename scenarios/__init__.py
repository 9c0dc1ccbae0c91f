"""Flights and their readers, simulators, reports and the command line."""
