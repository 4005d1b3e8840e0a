"""What data determine, and how well: covariance, propagation, identifiability."""
