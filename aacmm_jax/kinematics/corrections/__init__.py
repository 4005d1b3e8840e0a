"""What a joint does besides its Denavit-Hartenberg motion: coefficients times known functions of the readings.

One file a kind: harmonics of encoders, gear ratios, compliance under gravity, coupled joints, thermal expansion.
"""
