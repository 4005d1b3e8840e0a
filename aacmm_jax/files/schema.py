"""What the HDF5 files of captures, calibrations and evaluations hold: every field with its unit, said once.

Nothing here needs JAX, so that ``aacmm show`` checks a file and prints the summary in it quickly.
"""

from ..acceptance.standards import STANDARDS
from .records import Field, Fields, count, mapping, number, part, text, truth

_BOTH = "see unit"
_EITHER = "mm or rad"

RECORDING: Fields = {
    "seed": count("seed of a simulated capture"),
    "sources": text("files that were read, with their SHA-256"),
    "measured": text("day of the measurement"),
    "acceptance": text("standards whose acceptance procedure was followed", among=("", *STANDARDS)),
    "measuring_range": number("diameter of the measuring volume, as the maker states it", "mm"),
    "stated": text(
        "what the manifest states of the readings and points", among=("", "columns", "sign", "offset", "unit", "units")
    ),
    "read_as": count("recorded reading of each joint, from 1, negative where it counts the other way", least=None),
}

RECORDED_AS: Fields = {
    "names": text("column of the joint's readings", "joint"),
    "unit": text("unit of the readings"),
    "factors": number("joint value per reading", "rad or mm per unit", "joint", "reading"),
    "constants": number("joint value at readings of 0", "rad, or mm of a prismatic joint", "joint"),
}

NOISE: Fields = {
    "encoder_arcsec": Field("standard deviation of a reading, arcsec", name="encoder_arcsec", least=0),
    "linear_encoder": number("standard deviation of the reading of a prismatic joint", "mm", least=0),
    "seating": number("standard deviation of a coordinate of the seated tip", "mm", least=0),
}

USUAL_NOISE: Fields = {
    "arm_class": text("class of the arm"),
    "source": text("source of the stated noise"),
    "noise": part(NOISE),
}

LENGTHS: Fields = {
    "start": text("socket at one end"),
    "end": text("socket at the other end"),
    "value": number("calibrated length", "mm"),
    "u": number("standard uncertainty", "mm", least=0),
    "corrected": truth("whether the length contains the artefact's thermal expansion"),
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

IMAGES: Fields = {
    "observation": text("observation to which the image belongs"),
    "image": text("name of the image, or number of its pose"),
    "corners": count("number of corners"),
    "refused": text("why the image is not used; empty if it is used"),
    "preview": text("small picture of the image (JPEG, base64)"),
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
    "name": text("name of the arm"),
    "length": number("half-width of the bounds of lengths", "mm", name="half_width_length_mm"),
    "angle": number("half-width of the bounds of angles", "rad", name="half_width_angle_rad"),
    "override": mapping("half-widths of single parameters, mm or rad"),
    "held": text("fixed parameters"),
    "free": text("parameters that are free in addition to the default parameters"),
    "stated": text("what the user stated: parameters or bounds", among=("parameters", "bounds")),
    **_GEOMETRY,
    "coefficient": text("name of the coefficient", "coefficient"),
    "coefficients": number("coefficient of a joint correction, in its own unit", "1", "coefficient"),
    "coefficient_unit": text("unit of the coefficient", "coefficient"),
    "gravity": number("direction of gravity in the base frame", "1", "axis"),
    **{
        f"nominal_{kind}": field._replace(
            says=f"{field.says}, of the nominal arm for which the correction functions are evaluated"
        )
        for kind, field in _GEOMETRY.items()
    },
    "mass": number("mass of the link", "kg", "joint"),
    "centre": number("centre of mass of the link in the frame of the link", "mm", "joint", "axis"),
    "lowest": number("lowest reading of the joint", "rad", "joint"),
    "highest": number("highest reading of the joint", "rad", "joint"),
    "prismatic": count("prismatic joints"),
    "fixed": count("joints that do not move"),
    "mimic": number("joint, joint that it follows, factor and offset (rad, mm), one after the other", ""),
    "chains": text("joints of each chain of a robot, and its name"),
    "further_probes": number("tips of the chains after the first, mm, one after the other", ""),
    "torques": truth("whether torques of the joints follow their readings"),
    "directions": truth("whether directions of approach of the joints follow"),
    "load": truth("whether a load follows"),
    "load_centre": number("centre of mass of the load in the last frame, mm, of each chain", ""),
    "thermometer": truth("whether the last column of the readings is the temperature"),
    "prior_groups": text("groups of parameters with a prior"),
    "prior_sd": number("standard deviation of each group with a prior, mm or rad", ""),
    "prior_learned": text("groups whose standard deviation is learned"),
    "prior_mean_of": text("parameters or groups whose prior states a mean"),
    "prior_mean": number("means stated by the prior, mm or rad", ""),
}

_SQUARE = ("parameter", "parameter_2")
CALIBRATION: Fields = {
    "names": text("free parameter", "parameter", name="parameter"),
    "lower": number("lower bound of the identification", _BOTH, "parameter"),
    "upper": number("upper bound of the identification", _BOTH, "parameter"),
    "active_stage1": count(
        "bound that the parameter reached in stage 1: -1 the lower, +1 the upper, 0 none",
        "parameter",
        least=None,
        among=(-1, 0, 1),
    ),
    "active": count("bound reached: -1 the lower, +1 the upper, 0 none", "parameter", least=None, among=(-1, 0, 1)),
    "determined": truth("whether the data determine the parameter itself, not only a combination", "parameter"),
    "open": number("projector onto the combinations that the data do not determine, in mm and mrad", "1", *_SQUARE),
    "covariance": number("covariance", "products of units", *_SQUARE),
    "held": text("fixed parameters"),
    "hold": text("scale anchor of stage 1"),
    "scale_set_by": text("lengths held constant, or readings of prismatic joints, that set the scale"),
    "k": number("scale factor: measured lengths divided by certified lengths", "1"),
    "u_k": number("standard uncertainty of k", "1", least=0),
    "surplus_k": number("part of the variance of k due to disagreement between reference lengths", "1", least=0),
    "noise": part(NOISE),
    "noise_model": text("model of the tip errors"),
    "degrees_of_freedom": number("degrees of freedom of the estimated scatter of poses", "1", least=0),
    "reduced_chi": number("RMS of the residuals, in units of their stated standard deviations", "1", least=0),
    "method": text("method", among=("two-stage", "joint", "repeatability")),
    "steps": count("number of evaluations"),
    "converged": truth("whether the solve converged"),
    "reason": text("why the solve ended"),
    "divided": truth("whether the lengths of the arm are those of stage 1 divided by k"),
    "against_division": text("why the lengths were not divided by k"),
    "decisions": text("what was decided by default"),
    "sampled_says": text("result of the Monte Carlo simulation"),
    "robust": text("robust loss"),
    "held_out_nominal": number("distance of a held-out pose by the nominal arm", "mm", "held_out_pose"),
}

SAMPLED: Fields = {
    "quantity": text("parameter, k or length", "quantity"),
    "estimate": number("value estimated by the calibration", "mm or rad; k has no unit", "quantity"),
    "u": number("standard uncertainty by Monte Carlo", "mm or rad; k has no unit", "quantity"),
    "low": number("lower end of the Monte Carlo interval", "mm or rad; k has no unit", "quantity"),
    "high": number("upper end of the Monte Carlo interval", "mm or rad; k has no unit", "quantity"),
    "linear_u": number("standard uncertainty by the law of propagation", "mm or rad; k has no unit", "quantity"),
    "agrees": truth("whether propagation and Monte Carlo agree within the tolerance of JCGM 101", "quantity"),
}

NOISY_ENCODERS: Fields = {
    "joint": count("joint whose encoder is noisier than expected", least=1),
    "expected": number("expected standard deviation: stated, or of other encoders", "rad, or mm of a prismatic joint"),
    "found": number("estimated standard deviation", "rad, or mm of a prismatic joint"),
    "u": number("standard uncertainty of the estimate", "rad, or mm of a prismatic joint"),
    "probability": number("probability of such residuals if the noise were as expected", "1"),
}

LEFT_OUT: Fields = {
    "sockets": text("sockets or observations held out together", "left_out_socket"),
    "poses": count("number of held-out poses in sockets with more than one pose"),
    "rms": number("RMS distance from the centroid, observed", "mm"),
    "rms_predicted": number("RMS distance from the centroid, predicted", "mm"),
    "rms_nominal": number("RMS distance from the centroid by the nominal arm", "mm"),
    "length_error": number("error of a reference length that was held out", "mm", "left_out_length"),
    "length_u": number("predicted standard uncertainty of length_error", "mm", "left_out_length"),
    "converged": truth("whether the calibration from all other groups converged"),
    "rms_degrees_of_freedom": number("effective degrees of freedom of rms_predicted", "1"),
    "length_degrees_of_freedom": number("effective degrees of freedom of length_u", "1"),
    "noise_degrees_of_freedom": number("degrees of freedom of the estimated noise", "1"),
    "distances": number("distance of a held-out pose from its geometry; NaN alone in a socket", "mm", "left_out_pose"),
}

REMOVED: Fields = {
    "kind": text("kind of group"),
    "group": text("group of data that was left out because it contradicts the other data"),
    "members": text("socket or observation left out", "removed_member"),
    "ratio": number("F: mean square added by the group, divided by the mean square of the other data", "1"),
    "degrees_of_freedom": count("degrees of freedom of numerator and denominator", "fraction"),
    "probability": number("probability of an F at least this large if the data are consistent", "1"),
    "rms_with": number("RMS distance of the other poses from their geometry, calibrated with the group", "mm"),
    "rms_without": number("RMS distance of the other poses from their geometry, calibrated without the group", "mm"),
    "changed_most": text("parameter that changed most"),
    "change": number("change of the parameter that changed most, in standard uncertainties", "1"),
}

OBSERVED: Fields = {
    "name": text("observation", name="observation"),
    "kind": text("kind of the observation"),
    "rms_before": number("RMS distance of the poses from their geometry, nominal arm", "mm", least=0),
    "rms_after": number("RMS distance of the poses from their geometry, calibrated arm", "mm", least=0),
    "reduced_chi": number("RMS of the residuals, in units of their standard deviations", "1"),
    "weights": number("weight of a pose; below 1 if a robust loss reduced it", "1", "pose", least=0),
}

GEOMETRY: Fields = {
    "part": text("part of the unknown geometry"),
    "unit": text("unit"),
    "value": number("value", "mm or rad, see unit"),
    "covariance": number("row of the covariance matrix of all values of the part", "products of units", "entry"),
}

HELD_OUT: Fields = {
    "observation": text("socket or other observation of the held-out pose", "held_out_pose"),
    "pose": count("number of the pose in its observation, from 1", "held_out_pose", least=1),
    "use": text("what the pose was used for", "held_out_pose", among=("used", "held out")),
    "residual": number("residual in the base frame", "mm", "held_out_pose", "axis"),
    "distance": number("distance of the tip from the estimated geometry", "mm", "held_out_pose"),
    "angle": number("size of the residuals that are measured in rad", "rad", "held_out_pose"),
    "pixels": number("size of the residuals that are measured in px", "px", "held_out_pose"),
    "u": number("predicted standard uncertainty of the distance", "mm", "held_out_pose"),
}

PRIOR: Fields = {
    "groups": text("group of parameters that share a prior", "prior_group", name="prior_group"),
    "learned": truth("whether the standard deviation of the group was learned from the data", "prior_group"),
    "units": text("unit of the standard deviation", "prior_group"),
    "parameters": count("number of free parameters in the group", "prior_group"),
    "sd": number("standard deviation, given or learned", "mm or rad, see unit", "prior_group"),
    "effective": number("how many parameters of the group the data determine (effective number)", "1", "prior_group"),
    "supported": truth(
        "whether the data show that parameters of the group differ from the means of their prior", "prior_group"
    ),
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
    "sd": number("standard deviation, estimated from the residuals", "mm or rad, see units", "shared_kind"),
    "moments": number("second moments of the coefficients about 0", "products of units", *_COEFFICIENTS),
    "follow": number(
        "derivatives of the parameters with respect to the coefficients",
        "quotients of units",
        "shared_parameter",
        "coefficient",
    ),
    "correlation_length": number("correlation length of the errors of successive poses, in poses", "1"),
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
    "names": text("source of uncertainty that contributes to the covariance", "component", name="component"),
    "matrices": number(
        "part of the covariance", "products of units", "component", "component_parameter", "component_parameter_2"
    ),
    "law": _law("component"),
}

UNCERTAINTY: Fields = {
    "names": text("free parameter", "parameter", name="parameter"),
    "covariance": number("covariance", "products of units", *_SQUARE),
    "open": number("projector onto the combinations that the data do not determine, in mm and mrad", "1", *_SQUARE),
    "noise": part(NOISE),
    "scatter_degrees_of_freedom": number("degrees of freedom of the noise", "1", least=0),
}

KEPT_GEOMETRY: Fields = {
    "names": text("part of the geometry", "kept", name="kept"),
    "values": number("value, as the calibration found it", "mm or rad", "kept"),
    "follow": number("derivatives with respect to the parameters", "quotients of units", "kept", "kept_parameter"),
    "covariance": number("covariance for given parameters", "products of units", "kept", "kept_2"),
}

JUDGED: Fields = {
    "limits": mapping("MPE of each metric: constant term (mm) and divisor of the length"),
    "u_test": number("standard uncertainty due to seat and fixture", "mm", least=0),
    "standards": text("standards whose tests are run", among=("", *STANDARDS)),
    "influences": mapping("uncertainty in mm, relative uncertainty, thermal expansion of artefact and arm"),
    "rule": text("decision rule"),
}

EVALUATION: Fields = {
    "used": text("sockets whose poses were used in the calibration"),
    "warnings": text("warnings about the results"),
    "calibration_warnings": text("warnings about the calibration"),
    "calibration_unusable": text("why the calibration is not to be used, if it is not"),
    "maxima": mapping("largest permitted value of each metric, mm"),
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
    "recorded_as": RECORDED_AS,
    "reference": LENGTHS,
    "sphere": SPHERES,
    "images": IMAGES,
    "parameters": CALIBRATION,
    "monte_carlo": SAMPLED,
    "noisy_encoders": NOISY_ENCODERS,
    "cross_validation": LEFT_OUT,
    "removed": REMOVED,
    "observed": OBSERVED,
    "geometry": GEOMETRY,
    "held_out_poses": HELD_OUT,
    "prior": PRIOR,
    "shared_errors": SHARED_ERRORS,
    "components": COMPONENTS,
    "uncertainty": UNCERTAINTY,
    "evaluation": EVALUATION,
    "points": JUDGED,
}
