"""Carrier frequencies of RINEX signals, named system + band + attribute: "G1C", "E5Q", "R1C".

Source: RINEX 4.01, tables 9-16 (the same bands in 3.0x).
"""

from __future__ import annotations

from factorgraph.geodesy import C_MPS

# MHz of (system, band)
MEGAHERTZ = {
    "G": {"1": 1575.42, "2": 1227.60, "5": 1176.45},
    "E": {"1": 1575.42, "5": 1176.45, "6": 1278.75, "7": 1207.14, "8": 1191.795},
    "J": {"1": 1575.42, "2": 1227.60, "5": 1176.45, "6": 1278.75},
    "C": {"1": 1575.42, "2": 1561.098, "5": 1176.45, "6": 1268.52, "7": 1207.14, "8": 1191.795},
    "R": {"1": 1602.0, "2": 1246.0, "3": 1202.025, "4": 1600.995, "6": 1248.06},
    "I": {"1": 1575.42, "5": 1176.45, "9": 2492.028},
    "S": {"1": 1575.42, "5": 1176.45},
}
GLONASS_STEP_MHZ = {"1": 0.5625, "2": 0.4375}  # per FDMA channel
SYSTEMS = "GREJCIS"


def carrier_hz(signal: str, channel: int | None = None) -> float:
    """Carrier frequency of a signal; `channel` is the GLONASS FDMA number. NaN where the band or channel is unknown."""
    mhz = MEGAHERTZ.get(signal[0], {}).get(signal[1], float("nan"))
    if signal[0] == "R" and signal[1] in GLONASS_STEP_MHZ:
        mhz += float("nan") if channel is None else channel * GLONASS_STEP_MHZ[signal[1]]
    return mhz * 1e6


def wavelength_m(signal: str, channel: int | None = None) -> float:
    """Wavelength of a signal's carrier, as `carrier_hz`."""
    return C_MPS / carrier_hz(signal, channel)
