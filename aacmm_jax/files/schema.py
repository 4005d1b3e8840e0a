"""What the HDF5 files of captures, calibrations and evaluations hold: every field with its unit, said once; and whether
the values of a file make sense, whoever wrote it: checked whenever it is loaded, and before it is shown.

Nothing here needs JAX, so that ``aacmm show`` checks a file and prints the summary in it quickly.
"""

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..acceptance.standards import STANDARDS
from .hdf5 import Entries, Stored, StoredTable, check_sense, is_moment, read_tables, undamaged
from .records import Field, Fields, check_fields, count, mapping, number, part, text, truth

_ROUNDING = 1e-6  # of k
_LARGEST_U = 0.1  # of k: beyond it the scale is as good as unknown
_BOTH = "see unit"
_EITHER = "mm or rad"

RECORDING: Fields = {
    "seed": count("seed of a simulated capture"),
    "sources": text("files that were read, with their SHA-256"),
    "measured": text("day of the measurement"),
    "acceptance": text("standards whose acceptance procedure was followed", among=("", *STANDARDS)),
    "measuring_range": number("diameter of the measuring volume, as the maker states it", "mm"),
}

NOISE: Fields = {
    "encoder_arcsec": Field("standard deviation of a reading, arcsec", name="encoder_arcsec", least=0),
    "linear_encoder": number("standard deviation of the reading of a prismatic joint", "mm", least=0),
    "seating": number("standard deviation of a coordinate of the seated tip", "mm", least=0),
}

USUAL_NOISE: Fields = {
    "arm_class": text("class of the arm"),
    "source": text("where the noise is stated"),
    "noise": part(NOISE),
}

LENGTHS: Fields = {
    "start": text("socket at one end"),
    "end": text("socket at the other end"),
    "value": number("calibrated length", "mm"),
    "u": number("standard uncertainty", "mm", least=0),
}

# A row for each group of a sphere, whose numbers stand in every one.
SPHERES: Fields = {
    "name": text("reference sphere", name="sphere"),
    "test": text("acceptance test for which the sphere was touched"),
    "diameter": number("calibrated diameter", "mm"),
    "u": number("standard uncertainty of the diameter", "mm", least=0),
    "stylus": number("diameter of the probe's ball", "mm", least=0),
    "form": number("calibrated form error", "mm", least=0),
    "u_form": number("standard uncertainty of the form error", "mm", least=0),
}

_COEFFICIENTS = ("coefficient", "coefficient_2")
_GEOMETRY: Fields = {
    "alpha": number("link twist", "rad", "joint"),
    "a": number("link length", "mm", "joint"),
    "d": number("link offset", "mm", "joint"),
    "theta": number("joint zero offset", "rad", "joint"),
    "beta": number("Hayati's angle", "rad", "joint"),
    "probe": number("tip in the last frame", "mm", "axis"),
}
ARM: Fields = {
    "name": text("what the arm is called"),
    "length": number("half-width of the bounds of lengths", "mm", name="half_width_length_mm"),
    "angle": number("half-width of the bounds of angles", "rad", name="half_width_angle_rad"),
    "override": mapping("half-widths of single parameters, mm or rad"),
    "held": text("fixed parameters"),
    "free": text("parameters that are free in addition"),
    "stated": text("what a person chose: parameters, bounds", among=("parameters", "bounds")),
    **_GEOMETRY,
    "coefficient": text("name of the coefficient", "coefficient"),
    "coefficients": number("coefficient of a joint correction, in its own unit", "1", "coefficient"),
    "coefficient_unit": text("unit of the coefficient", "coefficient"),
    "gravity": number("direction of gravity in the base frame", "1", "axis"),
    **{
        f"nominal_{kind}": field._replace(
            says=f"{field.says}, nominal arm at which the correction functions are evaluated"
        )
        for kind, field in _GEOMETRY.items()
    },
    "mass": number("mass of the link", "kg", "joint"),
    "centre": number("centre of mass in its frame", "mm", "joint", "axis"),
    "lowest": number("lowest reading of the joint", "rad", "joint"),
    "highest": number("highest reading of the joint", "rad", "joint"),
    "prismatic": count("prismatic joints"),
    "thermometer": truth("whether the temperature is recorded after the readings"),
    "prior_groups": text("groups of parameters with a prior"),
    "prior_sd": number("standard deviations of these groups, mm or rad", ""),
    "prior_learned": text("groups whose standard deviation is learned"),
    "prior_mean_of": text("parameters or groups with a mean"),
    "prior_mean": number("means of these parameters or groups, mm or rad", ""),
}

_SQUARE = ("parameter", "parameter_2")
CALIBRATION: Fields = {
    "names": text("free parameter", "parameter", name="parameter"),
    "lower": number("lower bound of the identification", _BOTH, "parameter"),
    "upper": number("upper bound of the identification", _BOTH, "parameter"),
    "active_stage1": count(
        "-1 on the lower bound, +1 on the upper, in stage 1", "parameter", least=None, among=(-1, 0, 1)
    ),
    "active": count("-1 on the lower bound, +1 on the upper", "parameter", least=None, among=(-1, 0, 1)),
    "determined": truth("whether the parameter is determined, and not only in combination with others", "parameter"),
    "open": number("projector onto the combinations that are not determined, in mm and mrad", "1", *_SQUARE),
    "covariance": number("covariance", "products of units", *_SQUARE),
    "held": text("fixed parameters"),
    "hold": text("scale anchor of stage 1"),
    "scale_set_by": text("fixed lengths that set the scale"),
    "k": number("scale factor: measured divided by certified lengths", "1"),
    "u_k": number("standard uncertainty of k", "1", least=0),
    "surplus_k": number("part of the variance of k that comes from the disagreement of the lengths", "1", least=0),
    "noise": part(NOISE),
    "noise_model": text("model of the tip errors"),
    "degrees_of_freedom": number("degrees of freedom of the scatter of single poses", "1", least=0),
    "reduced_chi": number("size of the residuals, in units of the given noise", "1", least=0),
    "method": text("method", among=("two-stage", "joint", "repeatability")),
    "steps": count("number of evaluations"),
    "converged": truth("whether the solve converged"),
    "reason": text("why the solve ended"),
    "divided": truth("whether the lengths of the arm are those of stage 1 divided by k"),
    "against_division": text("why the lengths were not divided by k"),
    "decisions": text("what was decided by default"),
    "sampled_says": text("result of the Monte Carlo simulation"),
    "robust": text("robust loss"),
}

SAMPLED: Fields = {
    "quantity": text("parameter, k or length", "quantity"),
    "estimate": number("value found by the calibration", "mm or rad; 1 for k", "quantity"),
    "u": number("standard uncertainty by Monte Carlo", "mm or rad; 1 for k", "quantity"),
    "low": number("lower end of the Monte Carlo interval", "mm or rad; 1 for k", "quantity"),
    "high": number("upper end of the Monte Carlo interval", "mm or rad; 1 for k", "quantity"),
    "linear_u": number("standard uncertainty by the law of propagation", "mm or rad; 1 for k", "quantity"),
    "agrees": truth("whether the linear interval is within the tolerance of JCGM 101", "quantity"),
}

NOISY_ENCODERS: Fields = {
    "joint": count("joint whose encoder is noisier than expected", least=1),
    "expected": number("standard deviation as given, or that of the other encoders", "rad, or mm of a prismatic joint"),
    "found": number("estimated standard deviation", "rad, or mm of a prismatic joint"),
    "u": number("standard uncertainty of the estimate", "rad, or mm of a prismatic joint"),
    "probability": number("probability of such residuals if the noise were as expected", "1"),
}

LEFT_OUT: Fields = {
    "sockets": text("sockets left out together", "left_out_socket"),
    "poses": count("number of poses in sockets with more than one pose"),
    "rms": number("RMS distance from the centroid, observed", "mm"),
    "rms_predicted": number("RMS distance from the centroid, predicted", "mm"),
    "length_error": number("error of a length that was left out", "mm", "left_out_length"),
    "length_u": number("predicted standard uncertainty of this error", "mm", "left_out_length"),
    "converged": truth("whether the calibration with the others converged"),
    "rms_degrees_of_freedom": number("effective degrees of freedom of rms_predicted", "1"),
    "length_degrees_of_freedom": number("effective degrees of freedom of length_u", "1"),
    "noise_degrees_of_freedom": number("degrees of freedom of the noise, used by both predictions", "1"),
}

REMOVED: Fields = {
    "kind": text("kind of group"),
    "group": text("group left out, because it contradicts the rest"),
    "members": text("socket or observation left out", "removed_member"),
    "ratio": number("F: mean square that the group added, divided by that of the rest", "1"),
    "degrees_of_freedom": count("degrees of freedom of numerator and denominator", "fraction"),
    "probability": number("probability of an F this large if nothing is wrong", "1"),
    "rms_with": number("RMS distance of the other poses from their geometry, if the group is used", "mm"),
    "rms_without": number("RMS distance of the other poses from their geometry, without the group", "mm"),
    "changed_most": text("parameter that changed most"),
    "change": number("change of this parameter, in standard uncertainties", "1"),
}

OBSERVED: Fields = {
    "name": text("observation", name="observation"),
    "kind": text("kind of the observation"),
    "rms_before": number("root mean square distance from the geometry, nominal arm", "mm", least=0),
    "rms_after": number("root mean square distance from the geometry, calibrated arm", "mm", least=0),
    "reduced_chi": number("root mean square of the residuals, in standard deviations", "1"),
    "weights": number("weight of a pose; below 1 if a robust loss reduced it", "1", "pose", least=0),
}

GEOMETRY: Fields = {
    "part": text("part of the unknown geometry"),
    "unit": text("unit"),
    "value": number("value", "mm or rad, see unit"),
    "covariance": number("row of the covariance matrix of the values of this part", "products of units", "entry"),
}

OTHER_POSES: Fields = {
    "names": text("observation", "observation", name="observation"),
    "poses": count("number of poses that were not used in the calibration", "observation"),
    "rms": number("root mean square distance of these poses from the estimated geometry", "mm", "observation"),
    "rms_angle": number("root mean square angle of these poses from the estimated geometry", "rad", "observation"),
}

PRIOR: Fields = {
    "groups": text("group of parameters with one prior", "prior_group", name="prior_group"),
    "learned": truth("whether the standard deviation of the group was learned from the data", "prior_group"),
    "units": text("unit of the standard deviation", "prior_group"),
    "parameters": count("number of free parameters in the group", "prior_group"),
    "sd": number("standard deviation, given or learned", "mm or rad, see unit", "prior_group"),
    "effective": number("number of parameters of the group that the data determine (effective)", "1", "prior_group"),
    "supported": truth("whether the data support a deviation from the mean", "prior_group"),
    "names": text("free parameter", "prior_parameter", name="prior_parameter"),
    "mean": number("mean", _EITHER, "prior_parameter"),
    "weight": number("reciprocal of the standard deviation; 0 without a prior", "1/mm or 1/rad", "prior_parameter"),
}


def _law(dimension: str) -> Field:
    possible = f"{dimension}_variance"
    return part(
        {
            "degrees_of_freedom": number("degrees of freedom of the variance", "1", dimension),
            "ratios": number("possible variances, divided by the stated variance", "1", dimension, possible),
            "weights": number("probabilities of the possible variances", "1", dimension, possible),
        }
    )


SHARED_ERRORS: Fields = {
    "kinds": text("kind of shared error", "shared_kind", name="shared_kind"),
    "units": text("unit of the standard deviation", "shared_kind"),
    "names": text("coefficient of a function", "coefficient", name="coefficient"),
    "sd": number("standard deviation, learned from the residuals", "mm or rad, see units", "shared_kind"),
    "moments": number("second moments of the coefficients about 0", "products of units", *_COEFFICIENTS),
    "follow": number(
        "derivatives of the parameters with respect to the coefficients",
        "quotients of units",
        "shared_parameter",
        "coefficient",
    ),
    "correlation_length": number("correlation length of successive poses", "1"),
    "added": number(
        "part of the covariance", "products of units", "tip_kind", "shared_parameter", "shared_parameter_2"
    ),
    "by_group": number(
        "derivatives of the moments with respect to the logarithm of each kind's variance", "products of units",
        "function_kind", *_COEFFICIENTS,
    ),
    "law": _law("shared_kind"),
}  # fmt: skip

COMPONENTS: Fields = {
    "names": text("source of a part of the covariance", "component", name="component"),
    "matrices": number(
        "part of the covariance", "products of units", "component", "component_parameter", "component_parameter_2"
    ),
    "law": _law("component"),
}

UNCERTAINTY: Fields = {
    "names": text("free parameter", "parameter", name="parameter"),
    "covariance": number("covariance", "products of units", *_SQUARE),
    "open": number("projector onto the combinations that are not determined, in mm and mrad", "1", *_SQUARE),
    "noise": part(NOISE),
    "scatter_degrees_of_freedom": number("degrees of freedom of the noise", "1", least=0),
}

JUDGED: Fields = {
    "limits": mapping("MPE of each metric: fixed part (mm) and divisor of the length"),
    "u_test": number("standard uncertainty that seat and fixture add", "mm", least=0),
    "standards": text("standards whose tests are run", among=("", *STANDARDS)),
    "influences": mapping("uncertainty (mm, and relative to a length), and thermal expansion of artefact and arm"),
    "rule": text("decision rule"),
}

EVALUATION: Fields = {
    "used": text("sockets from which the arm was identified"),
    "warnings": text("warnings about the results"),
    "calibration_warnings": text("warnings about the calibration"),
    "maxima": mapping("largest values allowed, mm"),
    **JUDGED,
}

POINTS: Fields = {
    "sources": text("files that were read, with their SHA-256"),
    "measured": text("day of the measurement"),
    "measuring_range": number("diameter of the measuring volume, as the maker states it", "mm"),
}

# By the name of the table.
TABLES: dict[str, Fields] = {
    "usual_noise": USUAL_NOISE,
    "reference": LENGTHS,
    "sphere": SPHERES,
    "parameters": CALIBRATION,
    "monte_carlo": SAMPLED,
    "noisy_encoders": NOISY_ENCODERS,
    "cross_validation": LEFT_OUT,
    "removed": REMOVED,
    "observed": OBSERVED,
    "geometry": GEOMETRY,
    "other_poses": OTHER_POSES,
    "prior": PRIOR,
    "shared_errors": SHARED_ERRORS,
    "components": COMPONENTS,
    "uncertainty": UNCERTAINTY,
    "evaluation": EVALUATION,
    "points": JUDGED,
}


def read_checked(path: str | os.PathLike, kinds: Sequence[str]) -> Stored:
    """The tables of a capture, calibration or evaluation, with values that they can have. Raises `InputError`."""
    stored = read_tables(path, kinds)
    with undamaged(path):
        check_fields(RECORDING, Entries(path, "entry", {}), stored.attributes)
        for name, fields in TABLES.items():
            if name in stored.tables:
                check_fields(fields, stored.tables[name], stored.tables[name].attributes)
        measured = stored.attributes.get("measured")
        check_sense(path, {"the day of measurement is not a date": measured and not is_moment(measured[:10])})
        if "capture" in stored.tables:
            joints = stored.tables["capture"]["angle"].shape[1]
            arms = [table["alpha"].shape for name, table in stored.tables.items() if name.endswith("_arm")]
            others = any(shape != (joints,) for shape in arms)
            check_sense(path, {"the numbers of joints of its arm and of its readings differ": others})
        if stored.attributes["kind"] == "calibration":
            _check_calibration(path, stored.tables["parameters"], stored.tables["reference"])
        if "uncertainty" in stored.tables:
            covariance = stored.tables["uncertainty"]["covariance"]
            check_sense(
                path,
                {
                    "the covariance matrix has negative eigenvalues or is not symmetric": not _is_semidefinite(
                        covariance
                    )
                },
            )
        if "points" in stored.tables:
            _check_points(path, stored.tables["points"])
    return stored


def check_shown(path: str | os.PathLike, kind: str, summary: Mapping[str, Any]) -> None:
    """Raise `InputError` where values of a file, or the summary in it, make no sense."""
    stored = read_checked(path, (kind,))
    with undamaged(path):
        if kind == "calibration":
            attributes = stored.tables["parameters"].attributes
            names = {"scale_k": "k", "scale_u": "u_k", "converged": "converged"}
            shown = [np.nan if summary[name] is None else summary[name] for name in names]
            held = [attributes[name] for name in names.values()]
            same = np.allclose(np.array(shown, float), np.array(held, float), rtol=0, atol=0, equal_nan=True)
            check_sense(path, {"its summary does not agree with its values": not same})


def _check_calibration(path: str | os.PathLike, table: StoredTable, reference: StoredTable) -> None:
    """Raise `InputError` where values of a calibration contradict each other.

    k is a weighted mean of measured over certified lengths, so it lies between the least and the largest of them; its
    lengths are between positions by weighted poses, and those stored between centroids, which differ by less than u.
    """
    attributes, covariance, names = table.attributes, table["covariance"], table["parameter"].tolist()
    k, u_k, converged = (attributes[name] for name in ("k", "u_k", "converged"))
    lengths = [
        reference[f"measured_{stage}"] / reference["value"]
        for stage in ("stage1", "calibrated")
        if len(reference["value"]) and f"measured_{stage}" in reference
    ]
    scaled = attributes["method"] == "two-stage"  # only the division by k needs reference lengths
    finite = all(np.all(np.isfinite(x)) for x in ((k, u_k, covariance) if scaled else (covariance,)))
    slack = _ROUNDING + (3 * u_k if u_k < _LARGEST_U else 0.0)
    of_lengths = any(ratio.min() - slack <= k <= ratio.max() + slack for ratio in lengths)
    needed = converged and lengths and (scaled or not np.isnan(k))
    check_sense(
        path,
        {
            "a parameter is named twice": len(set(names)) != len(names),
            "a parameter is both free and fixed": set(names) & set(attributes["held"] or ()),
            "a lower bound is above the upper": not np.all(table["lower"] <= table["upper"]),
            "the scale k is not positive": not k > 0 and not np.isnan(k),
            "a converged calibration has a scale or covariance that is not finite": converged and not finite,
            "the scale k does not agree with its lengths": needed and not of_lengths,
            "the covariance matrix has negative eigenvalues or is not symmetric": finite
            and not _is_semidefinite(covariance),
        },
    )


def _check_points(path: str | os.PathLike, table: StoredTable) -> None:
    """Raise `InputError` where the points of an evaluation, or what is stated about the arm's reach, cannot be."""
    position, attributes = table["position"], table.attributes
    shoulder = attributes.get("shoulder_mm", [0.0] * 3)
    finite = position.shape == (len(table["socket"]), 3) and np.all(np.isfinite(position))
    check_sense(
        path,
        {
            "a position is not three finite numbers": not finite,
            "the reach is not positive and finite": not 0 < attributes.get("radius_mm", 1.0) < np.inf,
            "the shoulder is not three finite numbers": len(shoulder) != 3 or not np.all(np.isfinite(shoulder)),
        },
    )


def _is_semidefinite(covariance: np.ndarray) -> bool:
    """Whether a matrix is symmetric, and its correlations have no eigenvalue below zero, to rounding."""
    variance = np.diag(covariance)
    if np.any(variance < 0):
        return False
    root = np.sqrt(np.where(variance > 0, variance, 1.0))
    correlation = covariance / root / root[:, None]
    symmetric = np.allclose(correlation, correlation.T, rtol=0, atol=1e-9)
    return symmetric and bool(np.all(np.linalg.eigvalsh(correlation) > -1e-6))
