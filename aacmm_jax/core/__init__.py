"""Arrays, errors, units and 64-bit floats: what every other folder stands on."""
