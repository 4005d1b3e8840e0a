"""The measurement results of a certificate: the same readings by the nominal and by the calibrated parameters."""

import contextlib
import fnmatch
import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
from scipy.spatial.distance import pdist

from ..acceptance.record import EvaluationRecord
from ..calibration.evaluation import Evaluation
from ..calibration.pose_table import HELD_OUT
from ..calibration.record import CalibrationRecord, uncertainty_of
from ..core.errors import InputError
from ..core.text import shorten
from ..data.capture import ReferenceLength
from ..data.observations.observation import Quantity, certified_quantities
from ..data.observations.pixels import Pixels
from ..diagnostics.joint_travel import tried_poses
from ..diagnostics.pose_residuals import ObservationResiduals, distances_of, observation_residuals, rms
from ..files.administrative_data import NOT_STATED, AdministrativeData, Reference
from ..pipeline.hold_out import residuals_of
from ..summaries.calibration import metrics_by_socket_and_length, prior_rows, prior_sentence
from ..summaries.evaluation import evaluation_summary
from ..summaries.observations import distances_row, less_weight
from ..uncertainty.arm_uncertainty import Uncertainty
from ..uncertainty.coverage import LEVEL, LEVEL_IN_PERCENT
from ..uncertainty.volume import volumetric_uncertainty
from . import xml_elements as xml
from .parameter_results import covariance_result, in_d_si, is_known, parameters_result
from .xml_elements import MILLIMETRE, ONE, RADIAN, element, english, named, real, result, text

_METHODS = {
    "two-stage": "first from the repeatability in the sockets, and then the scale from the reference lengths",
    "joint": "from the repeatability in the sockets and the reference lengths together",
}
_METRICS = {
    "DE": ("de", "Mean distance of the tip from its mean position in the socket"),
    "Deltam": ("deltam", "Largest half range of a coordinate of the tip in a socket"),
    "RMS": ("rms", "Root mean square distance of the tip from its mean position in the socket"),
}
_FIXED_SCALE = (
    "This length fixed the scale, so the arm measures its calibrated value by construction; no error was measured."
)
_DECIMALS = {MILLIMETRE: 5, ONE: 3, RADIAN: 8}  # of what has no uncertainty
_STATISTICS = {"median": "median", "95": "95th percentile", "largest": "largest"}
_OVER_VOLUME = {"Tip position": "expanded_tip", "Measured length": "expanded_length_reading"}
_HELD_OUT = {
    "rms_mm": "RMS distance",
    "largest_mm": "largest distance",
    "from_mean_mm": "largest distance from the mean position",
    "rms_predicted_mm": "RMS distance, predicted",
}
# Lengths that no reference stands for, of the calibration and of the test, and how names of the latter begin.
LENGTHS_OF_NONE, OF_TEST = ("Reference lengths", "Lengths of the test"), "Test "
_MEASURED = {
    "mm": "standard uncertainty of a measured coordinate or distance",
    "rad": "standard uncertainty of a measured angle or orientation about each axis",
    "px": "standard uncertainty of a measured image coordinate, in pixels",
}


def results_of(
    record: CalibrationRecord, given: AdministrativeData, command: str, evaluation: EvaluationRecord | None = None
) -> Iterator[Element]:
    """The measurement results of a calibration: by the nominal parameters, by those as found, where they are known,
    and by the calibrated ones. An evaluation verifies a calibration that held no poses out."""
    residuals, temperature = observation_residuals(record), english("text", NOT_STATED)
    if given.certificate.temperature_celsius is not None:
        celsius = real(given.certificate.temperature_celsius, xml.CELSIUS, given.certificate.temperature_u_celsius)
        temperature = named("quantity", "Ambient temperature", celsius)
    stages = {
        "nominal": ("Nominal parameters", "The readings, evaluated with the nominal parameters."),
        "as_found": (
            "Parameters as found",
            "The same readings, evaluated with the parameters that were in the controller on arrival.",
        ),
        "calibrated": (
            "Calibrated parameters",
            "The same readings, evaluated with the calibrated parameters, which were identified from these readings.",
        ),
    }
    for stage, (title, says) in stages.items():
        if stage == "as_found" and record.recording.as_found is None:
            continue
        status, data = xml.adjustment_status(stage), element("data", temperature)
        yield named(
            "measurementResult",
            title,
            _methods(record, residuals),
            xml.software("usedSoftware", command),
            element("measuringEquipments", _equipment(record, given.reference, residuals, evaluation)),
            element("influenceConditions", named("influenceCondition", "Ambient temperature", status, data)),
            element("results", _results(record, stage, residuals, evaluation)),
            says=says,
        )


def uncertainty_statement(record: CalibrationRecord) -> str:
    """How the uncertainties were evaluated, and what they do not include."""
    noise = "as given" if record.noise_model == "given" else "as estimated from the residuals"
    sources = "uncertainty of the reference lengths"
    if record.recording.capture.observations:
        sources = "uncertainties of measured and certified values"
    if record.prior is not None:
        groups = ". ".join(map(prior_sentence, prior_rows(record.prior)))
        sources += (
            ", and from prior knowledge of the parameters, stated as normal distributions (standard deviation of each "
            f"group: {groups})"
        )
    model = "Denavit-Hartenberg model"
    if record.calibrated.arm.corrections is not None:
        model += " with the joint corrections below"
    unmodelled = "not included" if record.shared is None else "included as far as the residuals show them"
    return (
        "Each expanded uncertainty is the standard uncertainty times the coverage factor stated beside it. This "
        f"factor follows from Student's t distribution for a coverage probability of {LEVEL_IN_PERCENT} and the "
        "effective degrees of freedom of the quantity, which are computed from the contributions to its variance. "
        "The standard uncertainties follow, by the law of propagation of uncertainty, from the noise of the "
        f"readings, {noise}, and from the {sources}. Each uncertainty is for one parameter alone; the covariance "
        "matrix gives the correlations. Expanded uncertainties are rounded to two digits (of angles in rad, to four, "
        "since they are printed in degrees), and values to the same decimal place. Errors that the "
        f"{model} does not describe are {unmodelled}."
    )


def _methods(record: CalibrationRecord, residuals: tuple[ObservationResiduals, ...]) -> Element:
    capture = record.recording.capture
    poses = f"Sockets in which the tip was seated: {len(capture.sizes)}; poses in sockets: {sum(capture.sizes)}; "
    lengths = f"reference lengths between sockets: {len(capture.lengths)}"
    squares = "Parameters were identified by bounded least squares"
    words = (
        f"{poses}{lengths}. {squares}, {_METHODS[record.final_method]}. With these parameters, the positions of the "
        "tip in each socket agree best, and the distances between sockets agree best with the reference lengths."
    )
    if not record.sockets_alone:
        others = len(capture.observations)
        words = (
            f"{poses}{lengths}; other observations: {others}; poses in these observations: "
            f"{len(capture.readings) - sum(capture.sizes)}. {squares}, together with the unknown geometry of each "
            "observation. Weights follow from the uncertainties of the measured values and from the scatter of the tip."
        )
    if record.robust:
        words += (
            f" The robust loss '{record.robust}' reduced the weight of poses with large residuals; "
            f"{len(less_weight(residuals))} poses have half of the full weight or less."
        )
    if record.removed:
        groups = ", ".join(f"{removed.kind} {removed.group}" for removed in record.removed)
        words += (
            f" The following data were left out, because an F test shows that they contradict the rest: {groups}; see "
            "the statements on data left out."
        )
    statement = uncertainty_statement(record)
    return element(
        "usedMethods",
        xml.method("Identification of Denavit-Hartenberg parameters", words),
        xml.method("Evaluation of measurement uncertainty", statement, "JCGM 100:2008", of_uncertainty=True),
    )


def _equipment(
    record: CalibrationRecord,
    references: Sequence[Reference],
    residuals: tuple[ObservationResiduals, ...],
    evaluation: EvaluationRecord | None,
) -> Iterator[Element]:
    """The reference artefacts with their lengths, the lengths of none, and the artefacts and instruments behind
    observations, with certified values and uncertainties as they were given."""
    lengths, assigned = _certified_lengths(record, evaluation), set()
    for reference in references:
        serial = ("manufacturer", reference.serial_number, "Serial number")
        certificate = ("other", reference.certificate_number, "Number of its calibration certificate")
        artefact = xml.item("measuringEquipment", reference.name, reference, serial, certificate)
        if names := _lengths_of(reference, lengths):
            artefact.append(_quantities(lengths, names))
            assigned.update(names)
        yield artefact
    unknown = "" if references else f"Artefact: {NOT_STATED}"
    for of_test, name in enumerate(LENGTHS_OF_NONE):
        others = [key for key in lengths if key not in assigned and key.startswith(OF_TEST) == of_test]
        if others:
            yield named("measuringEquipment", name, _quantities(lengths, others), says=unknown)
    # Observations with the same certified values are of one artefact in several placements, which is named once.
    equipment: dict[tuple, tuple[list[str], str, list[Quantity]]] = {}
    for part in residuals:
        observation, certified = part.observation, list(certified_quantities(part.observation))
        # As they were given.
        measured = [Quantity(_MEASURED[unit], np.array([u]), unit) for unit, u in part.u.items() if u]
        key = tuple((quantity.says, *np.asarray(quantity.values).tolist(), quantity.u) for quantity in certified)
        if isinstance(observation, Pixels):
            equipment[observation.board,] = ([observation.board], observation.kind, [_size(observation)])
        if certified or measured:
            where = (observation.kind, *(key if certified and not measured else (observation.name,)))
            names, _, _ = equipment.setdefault(where, ([], observation.kind, [*certified, *measured]))
            names.append(observation.name)
    unknown = "" if references else f"; artefact or instrument: {NOT_STATED}"
    for names, kind, quantities in equipment.values():
        numbers = []
        for quantity in quantities:
            count = len(quantity.values)
            labels = [""] if count == 1 else [f", {axis}" for axis in ("xyz" if count == 3 else range(1, count + 1))]
            for label, value in zip(labels, quantity.values, strict=True):
                unit = in_d_si(quantity.unit)
                numbers.append(xml.equipment_quantity(quantity.says + label, float(value), unit, quantity.u))
        yield element(
            "measuringEquipment",
            text("name", ", ".join(names)),
            english("description", f"Kind of observation: {kind}{unknown}"),
            element("measuringEquipmentQuantities", numbers),
        )


def _certified_lengths(record: CalibrationRecord, evaluation: EvaluationRecord | None) -> dict[str, ReferenceLength]:
    """The lengths of the calibration, then those of the evaluation, by their names in the certificate."""
    lengths: list[tuple[str, Sequence[ReferenceLength]]] = [("", record.recording.capture.lengths)]
    if evaluation is not None:
        tested = evaluation.recording.capture.lengths
        lengths.append((OF_TEST, [tested[i] for i in evaluation.held_out_lengths()]))
    return {f"{of}{_length_name(i, x)}": x for of, rows in lengths for i, x in enumerate(rows, start=1)}


def _lengths_of(reference: Reference, lengths: dict[str, ReferenceLength]) -> list[str]:
    """The names of the lengths that a reference stands for; `InputError` if it names one that there is not."""
    names = {name: f"{length.start} - {length.end}" for name, length in lengths.items()}
    chosen = {}
    for pattern in reference.lengths:
        matches = [key for key, name in names.items() if name == pattern or fnmatch.fnmatchcase(name, pattern)]
        if not matches:
            there = (
                f"lengths are {shorten(list(dict.fromkeys(names.values())), 6)}" if names else "there are no lengths"
            )
            raise InputError(
                f"the reference '{reference.name}' has the length '{pattern}', which is not one of the calibration or "
                f"the evaluation ({there}); correct reference.lengths, or give the evaluation with --evaluation."
            )
        chosen |= dict.fromkeys(matches)
    return list(chosen)


def _quantities(lengths: dict[str, ReferenceLength], names: Sequence[str]) -> Element:
    values = ((name, float(lengths[name].value), float(lengths[name].u)) for name in names)
    return element(
        "measuringEquipmentQuantities", (xml.equipment_quantity(name, x, MILLIMETRE, u) for name, x, u in values)
    )


def _size(seen: Pixels) -> Quantity:
    """The largest distance between points of a target that a camera sees, and the u of its scale there."""
    size = pdist(np.unique(np.asarray(seen.points)[seen.seen], axis=0)).max(initial=0.0)
    says = "distance between the points farthest apart"
    return Quantity(says, np.array([float(f"{size:.7g}")]), "mm", float(f"{size * float(seen.u_scale):.2g}"))


def _results(
    record: CalibrationRecord,
    stage: str,
    residuals: tuple[ObservationResiduals, ...],
    held_out_by: EvaluationRecord | None,
) -> Iterator[Element | None]:
    evaluation, uncertainty, calibrated = record.evaluations()[stage], uncertainty_of(record), stage == "calibrated"
    values = {name: float(getattr(evaluation.repeatability, key)) for name, (key, _) in _METRICS.items()}
    if all(map(math.isfinite, values.values())):  # not where every socket has one pose
        quantities = (
            named("quantity", name, real(value, MILLIMETRE, decimals=_DECIMALS[MILLIMETRE]), says=_METRICS[name][1])
            for name, value in values.items()
        )
        yield result("Repeatability", "Computed over all sockets with more than one pose.", quantities)
    if calibrated:
        yield _held_out(record, held_out_by)
    if record.recording.capture.lengths:
        yield _lengths(record, evaluation, calibrated, uncertainty)
    if not record.sockets_alone:
        distances = distances_of(record.recording.capture, evaluation)
        rows = (
            _observation(number, part, of_arm, calibrated)
            for number, (part, of_arm) in enumerate(zip(residuals, distances, strict=True), start=1)
        )
        yield result("Observations", "Distances of the tip from the geometry of each observation.", rows)
    yield parameters_result(record, stage, uncertainty)
    if calibrated:
        yield _volume(record, uncertainty)
        yield covariance_result(record)
    if calibrated and not math.isnan(record.k):
        u = record.u_k if is_known(record.u_k) else None
        k = real(record.k, ONE, u, None if u is None else uncertainty.expanded_k(LEVEL) / u)
        yield result(
            "Scale",
            "Reference lengths as measured by the arm before its scale was set, divided by their calibrated values.",
            named("quantity", "k", k),
        )


def _held_out(record: CalibrationRecord, evaluation: EvaluationRecord | None) -> Element | None:
    """Distances of held-out poses; of those of an evaluation, as its summary has them, where the calibration has
    none."""
    says = "Distances of the tip from the geometry, in poses that the parameters were not identified from."
    row = None
    if record.held_out is not None:
        row = distances_row(residuals_of(record).used_as(HELD_OUT))
    elif evaluation is not None and evaluation.uncertainty is not None:
        says += " The positions of the sockets, and other geometry, were determined from these poses."
        row = _unseen_row(evaluation_summary(evaluation, {"calibrated": []})["held_out"])
    if row is None:
        return None
    values = [
        ("poses", row["poses"], ONE),
        *((name, row[key], MILLIMETRE) for key, name in _HELD_OUT.items() if key in row),
    ]
    quantities = (
        named("quantity", name, real(value, unit, decimals=0 if unit == ONE else 6))  # printed to three digits
        for name, value, unit in values
        if value is not None
    )
    return result("Held-out poses", says, quantities) if row["poses"] else None


def _unseen_row(held_out: dict[str, Any] | None) -> dict[str, Any] | None:
    """Distances of held-out poses as the summary of an evaluation has them. Where there are sockets alone, the largest
    is one from a mean position."""
    if held_out is None:
        return None
    by_arm = held_out["calibrated"]
    key = "largest_mm" if "observed_largest_mm" in by_arm else "from_mean_mm"
    largest = by_arm.get("observed_largest_mm", by_arm.get("distance_largest_mm"))
    return held_out["predicted"]["poses"] | {key: largest}


def _volume(record: CalibrationRecord, uncertainty: Uncertainty) -> Element | None:
    """Expanded uncertainties of tips and lengths, in both regions, where the data determine them."""
    everywhere, rows, poses = volumetric_uncertainty(uncertainty), [], np.asarray(record.recording.capture.readings)
    regions = {"over all joint limits": everywhere.summary}
    with contextlib.suppress(InputError):  # where no two poses are as far apart as the length
        near = volumetric_uncertainty(uncertainty, length=everywhere.length, near=poses).summary
        regions = {"where poses were taken": near} | regions
    for (region, volume), (name, key) in itertools.product(regions.items(), _OVER_VOLUME.items()):
        values = {says: volume[f"{key}_{statistic}_mm"] for statistic, says in _STATISTICS.items()}
        if all(map(is_known, values.values())):
            decimals = xml.decimals_of(min(values.values()))
            numbers = [named("quantity", says, real(u, MILLIMETRE, decimals=decimals)) for says, u in values.items()]
            length = named("quantity", "length", real(float(f"{everywhere.length:.6g}"), MILLIMETRE))
            rows.append(named("list", f"{name}, {region}", length, numbers))
    says = (
        "Expanded uncertainties by the calibration, in poses of the calibration and in random poses within the joint "
        "limits: of the tip, in its worst direction; and of a measured length, with the noise of both readings."
    )
    if rows and len(poses) > 1:
        covered = tried_poses(record.calibrated.arm, poses, everywhere.q).tried.mean()
        share = "Share of the random poses as near to a pose of the calibration as these are to one another"
        rows.append(named("quantity", "covered", real(covered, ONE, decimals=2), says=share))
    return result("Expanded uncertainty", says, *rows) if rows else None


def _length_name(number: int, length: ReferenceLength) -> str:
    """Numbered, since different pairs of sockets can read alike: their names may contain anything."""
    return f"{number}: {length.start} - {length.end}"


def _lengths(record: CalibrationRecord, evaluation: Evaluation, calibrated: bool, uncertainty: Uncertainty) -> Element:
    """Value, measured value and error of each length; of one that fixed the scale the value alone."""
    lengths, fixed_scale = record.recording.capture.lengths, calibrated and record.fixed_by_one_length
    of_lengths = metrics_by_socket_and_length(record.recording.capture, evaluation, uncertainty)["lengths"]
    rows = []
    for number, (length, row) in enumerate(zip(lengths, of_lengths, strict=True), start=1):
        u, factor, decimals = row["error_u_mm"] or None, None, _DECIMALS[MILLIMETRE]
        if u is not None:
            factor, decimals = row["expanded_mm"] / u, xml.decimals_of(row["expanded_mm"])
        # The reference has the uncertainty of its own certificate, not that of this calibration's coverage factor.
        exact, construction = "" if length.u else "Taken as exact", None
        reference = real(float(length.value), MILLIMETRE, float(length.u) or None)
        quantities = [named("quantity", "calibrated value", reference, says=exact, ref_type="basic_referenceValue")]
        if fixed_scale:
            construction = english("description", _FIXED_SCALE)
        else:
            by_arm = real(row["measured_mm"], MILLIMETRE, decimals=decimals)
            of_error = real(row["error_mm"], MILLIMETRE, u, factor, decimals)
            quantities += [
                named("quantity", "measured value", by_arm, ref_type="basic_measuredValue"),
                named("quantity", "error", of_error, ref_type="basic_measurementError"),
            ]
        rows.append(element("list", text("name", _length_name(number, length)), construction, quantities))
    return result(
        "Reference lengths",
        "An error is the measured value minus the calibrated one; the uncertainty of the error includes the "
        "uncertainty of the calibrated value and the scatter of the poses at both ends. Where thermal expansion is "
        "stated, the calibrated value is the length of the artefact at the temperature of the measurement.",
        *rows,
    )


def _observation(number: int, part: ObservationResiduals, distances: np.ndarray, calibrated: bool) -> Element:
    """Residuals of an observation: in mm, and of the calibrated arm in standard deviations too."""
    values = [("RMS residual", rms(part.distance if calibrated else distances), MILLIMETRE)]
    if calibrated:
        values.append(("RMS residual in standard deviations", rms(part.normalised), ONE))
        values += [(f"RMS residual in {unit}", rms(sizes), in_d_si(unit)) for unit, sizes in part.other.items()]
    target = f", tip: {part.observation.target}" if part.observation.target else ""
    return element(
        "list",
        text("name", f"{number}: {part.observation.name}"),  # numbered, since names may contain anything
        text("description", f"{part.observation.kind}{target}; {len(part.distance)} poses"),
        (
            named("quantity", name, real(value, unit, decimals=_DECIMALS[unit]))
            for name, value, unit in values
            if math.isfinite(value)
        ),
    )
