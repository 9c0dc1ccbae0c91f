"""Flight folders: description, readers, checks and a catalogue of flights that come with relnav."""

from scenarios.flights.load import LoadedFlight, load

__all__ = ["LoadedFlight", "load"]
