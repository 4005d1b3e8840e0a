"""Digital Calibration Certificates (DCC)."""
