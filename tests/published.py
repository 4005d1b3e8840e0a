"""Numbers printed by Cheng et al. 2018 (doi 10.1155/2018/1760190) that the tests need. Lengths mm, angles rad."""

import tomllib
from pathlib import Path

import numpy as np

_ALL = tomllib.loads((Path(__file__).resolve().parents[1] / "benchmarks/cheng2018/published.toml").read_text())
ORDER = tuple(_ALL["parameter_order"])
LENGTHS = np.array([not name.startswith(("alpha", "theta")) for name in ORDER])
_SIMULATIONS = {number: _ALL["simulation"][str(number)] for number in (1, 2)}
# Section 3; two of the printed vectors lost elements in print and are repaired there.
BOXES = {number: (simulation["lower"], simulation["upper"]) for number, simulation in _SIMULATIONS.items()}
NOMINAL = _ALL["simulation"]["nominal"]
IDENTIFIED = {number: simulation["identified"] for number, simulation in _SIMULATIONS.items()}
EQUATION_18 = np.array(_ALL["experiment"]["identified"])
_LENGTH = _ALL["experiment"]["length_reference"]
LENGTH_NOMINAL, LENGTH_MEASURED, LENGTH_MEAN = _LENGTH["nominal"], _LENGTH["measured"], _LENGTH["mean"]
# Table 2 in the same order; angles in degrees.
_TABLE = _ALL["table2"]
TABLE_2_LENGTHS = np.array([*_TABLE["a"][:5], *_TABLE["d"][1:6], _TABLE["probe_z"]])
TABLE_2_ANGLES_DEG = np.array([*_TABLE["alpha_deg"][:5], *_TABLE["theta_deg"][1:6]])
