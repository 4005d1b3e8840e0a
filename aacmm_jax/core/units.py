"""Units as multiples of mm and rad: a value times its unit is in mm or rad."""

import math

M = 1000.0  # mm
INCH = 25.4  # mm
UM = 1e-3  # mm
DEG = math.pi / 180  # rad
ARCMIN = math.pi / (180 * 60)  # rad
ARCSEC = math.pi / (180 * 3600)  # rad
ANGLE_UNITS = {"rad": 1.0, "deg": DEG, "arcsec": ARCSEC, "gon": math.pi / 200, "mrad": 1e-3}  # as files name them
LENGTH_UNITS = {"mm": 1.0, "m": M, "um": UM, "inch": INCH}  # as files name them


def length_unit(size: float) -> str | None:
    """The name of a unit of length of this size, mm; None: there is none."""
    return next((name for name, value in LENGTH_UNITS.items() if math.isclose(size, value)), None)


# The unit in which people read a value, or a small change of one, and the factor to it.
_VALUES = {"rad": (1 / DEG, "deg"), "1": (1.0, ""), "1/K": (1e6, "um/(m K)")}
_CHANGES = _VALUES | {"rad": (1 / ARCSEC, "arcsec"), "1": (1e6, "ppm")}


def people_read(unit: str) -> tuple[float, str]:
    """The factor to the unit in which people read a value, and that unit: degrees for radians, um/(m K) for 1/K."""
    return _VALUES.get(unit, (1.0, unit))


def people_read_change(unit: str) -> tuple[float, str]:
    """The same of a small change of a value: um, arcsec, urad/m, ppm."""
    if unit.startswith("mm"):
        return 1 / UM, unit.replace("mm", "um", 1)
    return _CHANGES.get(unit, (1e6, f"u{unit}") if unit.startswith("rad") else (1.0, unit))


def error_unit(unit: str) -> tuple[float, str]:
    """The same of errors of parameters: mm, but arcsec, ppm and urad/m of others."""
    return (1.0, "mm") if unit == "mm" else people_read_change(unit)
