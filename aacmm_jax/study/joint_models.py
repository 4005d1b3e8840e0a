"""What the joints of a study's arms do besides their readings, and what of it each cell identifies, with which prior.

The true arms of all cells have the corrections of every model that the study names, so that trials of all cells are
drawn by one program; a cell whose true arms or model lack some of them has zeros there.
"""

from collections.abc import Iterable, Mapping
from typing import Any

from ..core.errors import InputError
from ..core.units import ARCSEC, DEG
from ..files.arm_tables import masses_of, prior_of_text
from ..kinematics.arm import DOWN, Arm, correction_names, is_length, parameter_unit, value_of, without_corrections
from ..kinematics.corrected_arm import loads_of, with_corrections
from ..kinematics.parameters import ArmSpecification, Parameters
from ..kinematics.priors import Prior, default_prior, is_of_group

# Kind and unit of coefficients; the key of `DeviationTable`, and its unit in that of the coefficient.
_COEFFICIENTS = (
    ("harmonics", "rad", "harmonics_arcsec", ARCSEC),
    ("harmonics", "mm", "harmonics_mm", 1.0),
    ("gear", "1", "gear_ppm", 1e-6),
    ("coupled", "1", "coupled_ppm", 1e-6),
    ("gravity", "rad/m", "gravity_mrad_per_m", 1e-3),
    ("gravity", "rad/(kN m)", "gravity_mrad_per_knm", 1e-3),
)


def coefficients_of(nominal: ArmSpecification, model: str | None) -> tuple[str, ...]:
    """Coefficients of a model of the joints; without one, those of the nominal arm's own corrections."""
    if model is not None and not model.strip():
        raise InputError("a model is empty; give the model dh for an arm without joint corrections.")
    arm = nominal.arm if model is None else _modelled(nominal, model)
    return tuple(name for name in correction_names(arm) if not name.startswith("gravity_"))


def all_joints(nominal: ArmSpecification, models: Iterable[str | None]) -> Arm:
    """The nominal arm with the corrections of all models, 0 where it has not got them itself."""
    stated = correction_names(nominal.arm)
    names = tuple(dict.fromkeys(name for model in (None, *models) for name in coefficients_of(nominal, model)))
    if not set(names) - set(stated):
        return nominal.arm
    arm = _modelled(nominal, names)
    return arm.replace(**{name: value_of(nominal.arm, name) for name in stated})


def space_of(nominal: ArmSpecification, joints: Arm, held: list[str] | None, model: str | None) -> Parameters:
    """The free parameters of a cell, on an arm with all corrections: with a model, from coefficients of 0."""
    if model is None:
        space = nominal.space() if held is None else Parameters.free_of(nominal.arm, held=held)
        names = space.names
    else:
        corrections, chosen = correction_names(joints), held
        if held is None and nominal.held is not None:
            chosen = [name for name in nominal.held if name not in correction_names(nominal.arm)]
        without = None if chosen is None else tuple(name for name in chosen if name not in corrections)
        free = () if held is not None else tuple(name for name in nominal.free if name not in corrections)
        space = Parameters.free_of(without_corrections(nominal.arm), held=without, free=free)
        names = (*space.names, *(name for name in coefficients_of(nominal, model) if name not in (chosen or ())))
        joints = joints.replace(**{name: 0.0 for name in corrections if not name.startswith("gravity_")})
    return Parameters(joints if space.base.beta is None else joints.replace(beta=space.base.beta), names)


def prior_of(nominal: ArmSpecification, space: Parameters, model: str | None, text: str | None) -> Prior | None:
    """The prior of a cell: what it states, else that of the arm's file, or the default one of a model of joints."""
    if text is not None:
        return prior_of_text(text, space.base)
    if nominal.prior is None and model is not None and coefficients_of(nominal, model):
        return default_prior(_modelled(nominal, model))
    return nominal.prior


def deviation_of(cell: Mapping[str, Any], arm: Arm, name: str) -> tuple[Any, float]:
    """The distribution of a parameter's deviation, that of its kind or of all lengths or angles, and its unit in mm,
    rad or that of the coefficient; None where it does not deviate."""
    if name in correction_names(arm):
        key, unit = _coefficient(arm, name)
        return cell.get(f"deviation.{key}"), unit
    kind, (general, measure, unit) = name.rpartition("_")[0], ("angle", "deg", DEG)
    if is_length(name):
        general, measure, unit = "length", "mm", 1.0
    return cell.get(f"deviation.{kind}_{measure}", cell[f"deviation.{general}_{measure}"]), unit


def check_deviations(given: Iterable[str], arm: Arm, names: Iterable[str]) -> None:
    """Raise `InputError` for a deviation of coefficients that no arm of the study has."""
    present = {_coefficient(arm, name)[0] for name in names if name in correction_names(arm)}
    for kind, _, key, _ in _COEFFICIENTS:
        if key in given and key not in present:
            raise InputError(
                f"deviation.{key} applies to coefficients that no arm of this study has; add these coefficients in "
                f"deviation.model, for example model = '{kind}'."
            )


def _coefficient(arm: Arm, name: str) -> tuple[str, float]:
    unit = parameter_unit(arm, name)
    return next((row[2:] for row in _COEFFICIENTS if is_of_group(row[0], name) and row[1] == unit), ("", 1.0))


def _modelled(nominal: ArmSpecification, model: str | tuple[str, ...]) -> Arm:
    """The plain nominal arm with corrections, with the masses and the gravity that are known of it."""
    arm, masses = nominal.arm, masses_of(nominal)
    loads = None if arm.corrections is None else loads_of(arm)
    if loads is not None:
        masses = {"mass": loads.mass, "centre": loads.centre}
    return with_corrections(arm, model, gravity=DOWN if arm.gravity is None else arm.gravity, **masses)
