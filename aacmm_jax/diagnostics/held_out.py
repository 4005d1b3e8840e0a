"""Errors on data that a calibration has not seen, beside those that its uncertainty predicts."""

import math
from collections.abc import Callable

import numpy as np

from ..calibration.agreement import SIGNIFICANCE, Agreement, CrossValidation
from ..core.text import shorten
from .findings import Case, Finding

ORDER, NEEDS = 50, "scale"
IN_TURN = "is held out in turn"  # in every sentence on a cross-validation that disagrees
_AGREE = 1.1  # times what is predicted, up to which poses agree with their prediction


def test(case: Case) -> list[Finding]:
    """Of a cross-validation: groups whose errors exceed what their prediction allows."""
    validation = case.record.validation
    return [] if validation is None else contradicted_prediction(validation)


def contradicted_prediction(validation: CrossValidation) -> list[Finding]:
    """Groups whose errors exceed what their prediction allows, where there are any."""
    if not validation.surprising:
        return []
    count, texts = len(validation.disagreeing), []
    for i in validation.disagreeing:  # the most improbable ones first, by their poses, or else their lengths
        label, group = validation.labels[i], validation.groups[i]
        poses, lengths = validation.probabilities[i]
        if not lengths < poses:
            ratio = group.rms / group.rms_predicted
            texts.append(f"{label} ({group.rms:.3g} mm RMS, {ratio:.1f} times the predicted value)")
        else:
            error = float(np.sqrt(np.mean(np.square(group.length_error))))
            texts.append(f"{label} (length error {error:.3g} mm RMS, {group.length_ratio:.1f} times its u)")
    named, concerns = shorten(texts, 3), tuple(validation.labels[i] for i in validation.disagreeing)
    doubt = "errors of its own poses, held out in turn, are larger than predicted"
    if 0 < count < len(validation.groups) / 2:
        finding = Finding(
            "held-out-group",
            "When each group is held out in turn, some groups disagree with the others by more than predicted: "
            f"{named}; the remaining {len(validation.groups) - count} agree.",
            advice=(
                "Look for what differs in these groups (a socket or tool that moved, a wrong length, poses far "
                "from all others)."
            ),
        )
        doubt += f" in {count} of {len(validation.groups)} groups ({shorten(list(concerns), 3)})"
        return [finding._replace(severity="doubt", doubt=doubt, concerns=concerns)]
    # Whatever the model of the joints lacks moves the poses too.
    of_lengths = validation.rms_predicted > 0 and validation.rms < _AGREE * validation.rms_predicted
    ratios = []
    for name, error, predicted in (
        ("poses", validation.rms, validation.rms_predicted),
        ("reference lengths", validation.length_rms, validation.length_u),
    ):
        if predicted > 0 and math.isfinite(error):
            times = f"{error / predicted:.1f} times the predicted {predicted:.3g} mm"
            ratios.append(f"{name} {error:.3g} mm RMS, {times}")
    finding = Finding(
        "held-out-all",
        f"When each placement is held out in turn, the errors are larger than predicted: {'; '.join(ratios)}"
        + (f"; worst in {named}" if named else "")
        + (
            ". The poses agree with their prediction, so a reference length is wrong, or a socket at its ends moved."
            if of_lengths
            else ". Typical causes are effects outside the D-H model (compliant joints, eccentric encoders), whose "
            "errors are similar in neighbouring poses."
        ),
        "Lengths that are measured with the arm are wrong by as much."
        if of_lengths
        else "Every stated uncertainty is too small.",
        "Measure the reference lengths again." if of_lengths else "Use the cross-validated values.",
    )
    return [finding._replace(severity="doubt", doubt=doubt, concerns=concerns)]


def surprise(
    poses: Agreement, lengths: Agreement, parts: dict[str, Agreement], refitted: Callable[[], Agreement | None]
) -> list[Finding]:
    """Unseen data that scatter more than predicted, by more than chance does in one case of a hundred.

    ``parts`` are the sockets and observations, of which the most improbable are named; ``refitted`` says how all poses
    agree where the place of the probe is fitted to them: where that removes most of the excess, it is the cause.
    """
    probabilities = [p for p in (poses.probability, lengths.probability) if math.isfinite(p)]
    texts, worst, level = [], [], SIGNIFICANCE / max(len(probabilities), 1)
    if poses.probability < level:
        improbable = sorted(
            (p.probability, name) for name, p in parts.items() if p.probability < SIGNIFICANCE / len(parts)
        )
        worst = [name for _, name in improbable[:3]]
        most = [
            f"{name} ({parts[name].rms:.3g} mm RMS, {parts[name].rms / parts[name].predicted:.1f} times the predicted "
            "value)"
            for name in worst
        ]
        texts.append(
            f"poses are {poses.rms:.3g} mm RMS from their geometry, {poses.rms / poses.predicted:.1f} times the "
            f"predicted {poses.predicted:.3g} mm" + (f", most of all in {', '.join(most)}" if most else "")
        )
    if lengths.probability < level:
        texts.append(
            f"the errors of the reference lengths are {lengths.rms / lengths.predicted:.1f} times their standard "
            "uncertainty (RMS)"
        )
    if not texts:
        return []
    finding = Finding(
        "unseen-data",
        f"Data not used in the calibration disagree with it by more than chance explains: {'; '.join(texts)}.",
        "Either the arm or its probe has changed since the calibration (a remounted tip, for example), or these "
        "data contain errors that the data of the calibration did not contain, or the model lacks effects that the "
        "poses of the calibration did not show. The uncertainties of the calibration do not apply to these data.",
        severity="doubt",
        probability=min(probabilities),
        concerns=tuple(worst),
    )
    again = refitted() if poses.probability < SIGNIFICANCE else None
    # Most of the excess: more than half of it, in squares.
    if again is not None and poses.rms**2 - again.rms**2 > (poses.rms**2 - poses.predicted**2) / 2:
        says = (
            " If the position of the probe in the last frame is fitted to these data, the poses are only "
            f"{again.rms:.3g} mm RMS from their geometry: the tip was remounted or exchanged."
        )
        advice = "Calibrate these data as a separate session with its own probe (aacmm calibrate A.h5 B.h5)."
        return [finding._replace(code="unseen-probe", says=finding.says + says, costs="", advice=advice)]
    return [finding]


def no_better(nominal: float | None, calibrated: float | None) -> list[Finding]:
    """That the calibration has not improved the RMS distance of held-out poses, mm."""
    if nominal is None or calibrated is None or calibrated < nominal:
        return []
    says = (
        "On data not used in the calibration, the calibrated arm is no better than the nominal arm: "
        f"{calibrated:.3g} mm RMS instead of {nominal:.3g} mm."
    )
    return [Finding("no-better-than-nominal", says, severity="doubt")]
