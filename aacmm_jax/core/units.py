"""Units as multiples of mm and rad: a value times its unit is in mm or rad."""

import math

M = 1000.0  # mm
INCH = 25.4  # mm
UM = 1e-3  # mm
DEG = math.pi / 180  # rad
ARCMIN = math.pi / (180 * 60)  # rad
ARCSEC = math.pi / (180 * 3600)  # rad
