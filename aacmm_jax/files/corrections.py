"""Joint corrections in arm files: the table ``[corrections]``, and variables of HDF5 files."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from jaxtyping import Float
from pydantic import Field, FiniteFloat, NonNegativeFloat, model_validator

from ..kinematics.arm import Arm, correction_names
from ..kinematics.chain import Geometry
from ..kinematics.corrected_arm import corrected_like, loads_of, with_corrections
from .hdf5 import Variable, columns
from .toml import Strict

if TYPE_CHECKING:
    from tomlkit.items import Table as TomlTable

_Vector = Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]
_KINDS = ("alpha", "a", "d", "theta", "beta", "probe")
_LENGTHS = ("a", "d", "probe")


class CorrectionsTable(Strict):
    """The table ``[corrections]``: a model, or coefficients by name with the nominal arm that they are of."""

    model: str | None = None
    coefficients: dict[str, FiniteFloat] = Field(default_factory=dict)  # rad, or mm of a prismatic joint
    gravity: _Vector = Field(default_factory=lambda: [0.0, 0.0, -1.0])
    mass: list[NonNegativeFloat] | None = None  # of each link, kg
    centre: list[_Vector] | None = None  # of its mass in its frame, in the unit of lengths
    nominal: dict[str, list[FiniteFloat]] = Field(default_factory=dict)  # in the file's units

    @model_validator(mode="after")
    def _one_of_both(self) -> "CorrectionsTable":
        if (self.model is None) == (not self.coefficients):
            raise ValueError("give either model, such as 'gravity,harmonics=1', or coefficients by name.")
        if self.nominal and not self.coefficients:
            raise ValueError("nominal is of coefficients; leave it out of a model.")
        unknown = set(self.nominal) - {*_KINDS}
        if unknown:
            raise ValueError(f"nominal has no '{min(unknown)}'; it has lists of alpha, a, d, theta, beta, and probe.")
        return self

    def corrected(self, arm: Arm, length: float, angle: float) -> Arm:
        """The arm with these corrections; ``length`` and ``angle`` are the file's units in mm and rad."""
        centre = None if self.centre is None else length * np.array(self.centre)
        options: dict[str, Any] = {"mass": self.mass, "centre": centre, "gravity": self.gravity}
        if self.model is not None:
            return with_corrections(arm, self.model, **options)
        units = {kind: length if kind in _LENGTHS else angle for kind in _KINDS}
        nominal = {kind: units[kind] * np.array(row) for kind, row in self.nominal.items()}
        return _rebuilt(arm, self.coefficients, nominal, options)


def corrections_toml(arm: Arm) -> "TomlTable":
    """The table ``[corrections]`` of an arm that has some, mm and rad."""
    import tomlkit

    assert arm.corrections is not None
    table = tomlkit.table()
    table["gravity"] = np.asarray(arm.gravity).tolist()
    loads = loads_of(arm)
    if loads is not None:
        table["mass"], table["centre"] = list(loads.mass), [list(centre) for centre in loads.centre]
    names = correction_names(arm)
    values = np.asarray(arm.coefficients).tolist()
    table["coefficients"] = dict(zip(names[: len(values)], values, strict=True))
    table["nominal"] = {kind: np.asarray(values).tolist() for kind, values in _arrays(arm.corrections.nominal).items()}
    return table


def correction_variables(arm: Arm) -> dict[str, Variable]:
    """Variables of an arm's table, mm and rad; none for an arm without corrections."""
    if arm.corrections is None:
        return {}
    values = np.asarray(arm.coefficients)
    names = list(correction_names(arm)[: len(values)])
    units = [function.unit for function in arm.corrections.functions.terms]
    variables = columns(
        "coefficient",
        coefficient=(names, "", "name of the coefficient"),
        coefficients=(values, "1", "coefficient of a joint correction, in its own unit"),
        coefficient_unit=(units, "", "unit of the coefficient"),
    )
    variables |= columns("axis", gravity=(np.asarray(arm.gravity), "1", "direction of gravity in the base frame"))
    for kind, array in _arrays(arm.corrections.nominal).items():
        unit, dimension = "mm" if kind in _LENGTHS else "rad", "axis" if kind == "probe" else "joint"
        variables[f"nominal_{kind}"] = Variable((dimension,), array, unit, f"{kind} of the arm of the functions")
    loads = loads_of(arm)
    if loads is not None:
        variables["mass"] = Variable(("joint",), list(loads.mass), "kg", "mass of the link")
        variables["centre"] = Variable(("joint", "axis"), np.array(loads.centre), "mm", "centre of mass in its frame")
    return variables


def corrected_of(arm: Arm, arrays: Mapping[str, np.ndarray]) -> Arm:
    """The arm with the corrections of its table in an HDF5 file, if it has any."""
    if "coefficients" not in arrays:
        return arm
    nominal = {kind: arrays[f"nominal_{kind}"] for kind in _KINDS if f"nominal_{kind}" in arrays}
    coefficients = dict(zip(map(str, arrays["coefficient"]), arrays["coefficients"], strict=True))
    options = {key: arrays.get(key) for key in ("mass", "centre", "gravity")}
    return _rebuilt(arm, coefficients, nominal, options)


def _rebuilt(
    arm: Arm, coefficients: Mapping[str, float], nominal: Mapping[str, np.ndarray], options: Mapping[str, Any]
) -> Arm:
    """The arm with coefficients of functions that are of another, nominal, arm."""
    corrected = with_corrections(arm.replace(**nominal), list(coefficients), **options)
    values = np.array(list(coefficients.values()), dtype=float)
    return corrected_like(corrected, arm).replace(coefficients=values, gravity=options["gravity"])


def _arrays(geometry: Geometry) -> dict[str, Float[np.ndarray, "..."]]:
    arrays = {kind: getattr(geometry, kind) for kind in _KINDS}
    return {kind: np.asarray(values) for kind, values in arrays.items() if values is not None}
