"""Identification and calibration: one, many at once, repeated, cross-validated; and their results."""
