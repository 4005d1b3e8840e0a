"""Units, in mm and rad: a value times its unit is in mm or rad; one in mm or rad divided by a unit is in that unit."""

import math

M = 1000.0  # mm
INCH = 25.4  # mm
UM = 1e-3  # mm
DEG = math.pi / 180  # rad
ARCMIN = DEG / 60  # rad
ARCSEC = DEG / 3600  # rad
