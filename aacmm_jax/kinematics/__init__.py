"""The arm: its Denavit-Hartenberg chain, parameters, inverse kinematics and workspace."""
