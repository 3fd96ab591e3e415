"""The UNECE codes of engineering units (UN/CEFACT Recommendation 20), as OPC 10000-8, 5.6.4 requires for EngineeringUnits."""

from __future__ import annotations

UNECE_URI = "http://www.opcfoundation.org/UA/units/un/cefact"
UNKNOWN_ID = -1
"""The unit ID of a unit without a known code (OPC 10000-8, 5.6.4.3)."""

CODES = {
    "%": "P1", "1/min": "C94", "A": "AMP", "Ah": "AMH", "Hz": "HTZ", "J": "JOU", "K": "KEL", "MPa": "MPA", "MWh": "MWH",
    "N": "NEW", "Ohm": "OHM", "Pa": "PAL", "S/m": "D10", "V": "VLT", "VA": "D46", "W": "WTT", "Wh": "WHR", "bar": "BAR",
    "cm": "CMT", "d": "DAY", "deg": "DD", "degC": "CEL", "degF": "FAH", "g": "GRM", "g/kg": "GK", "h": "HUR", "hPa": "A97",
    "kPa": "KPA", "kV": "KVT", "kVA": "KVA", "kW": "KWT", "kWh": "KWH", "kg": "KGM", "km": "KMT", "kvar": "KVR", "l": "LTR",
    "l/min": "L2", "l/s": "G51", "m": "MTR", "m/s": "MTS", "m3": "MTQ", "m3/h": "MQH", "mA": "4K", "mV": "2Z", "mbar": "MBR",
    "min": "MIN", "mm": "MMT", "ms": "C26", "ppm": "59", "psi": "PS", "rad": "C81", "rpm": "RPM", "s": "SEC", "t": "TNE",
    "uS/cm": "G42", "var": "D44",
}  # fmt: skip
"""The code of each unit that profiles use, by its symbol in a profile."""


def unit_id(unit: str) -> int:
    """Return the UNECE unit ID: the characters of the code as bytes of a number. `UNKNOWN_ID` if the unit has no known code."""
    code = CODES.get(unit)
    return UNKNOWN_ID if code is None else int.from_bytes(code.encode("ascii"))
