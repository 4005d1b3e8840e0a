"""Arrays, errors, units, 64-bit floats and small linear algebra: what every other folder imports."""
