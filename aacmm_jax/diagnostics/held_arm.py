"""Errors of an arm whose parameters are all held: what residuals show of them is added to the geometry's uncertainty.

With the arm as it is (`--arm-fixed`), a calibration finds the geometry alone: the mount of a camera, the place of a
target. Errors of the arm's own parameters move whole poses, so that all corners of an image err alike, and repeat from
pose to pose as the readings do. They are random effects (`random_effects`): zeros of joints, angles between axes and
lengths, each with a variance that the residuals show, and all of them independent beforehand. The geometry has followed
these errors, those too which no residual shows, such as a turn of the last joint's zero, and its covariance grows by
their second moments. It does not contain errors that no parameter describes: gears, bending, backlash.
"""

from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..calibration.reprojection import reprojection
from ..calibration.results import Calibration
from ..core.text import listed
from ..core.units import DEG
from ..data.observations.pixels import Pixels
from ..kinematics.arm import is_length, natural_steps
from .equations import PROBE, linearisation_of
from .findings import Case, Finding, by_equations, chance_text, rounded
from .random_effects import Effects, group_deviations, second_moments
from .residual_tests import score_tests

ORDER, NEEDS = 24, "scale"
_GATE = 0.1  # probability of the test below which the arm's errors are looked for, as of other shared errors


class HeldErrors(NamedTuple):
    """Errors of the parameters of an arm, by group."""

    names: tuple[str, ...]
    probability: float  # that residuals follow these parameters so much by chance
    sd: dict[str, float]  # of each group, rad and mm
    moments: Float[np.ndarray, "k k"]  # second moments of the parameters' errors, natural steps


@by_equations
def errors_of_held(case: Case) -> HeldErrors | None:
    """Of an arm all of whose parameters are held; None where the residuals show no such errors."""
    record = case.record
    if record.names or not case.scatters:
        return None
    rows, _ = case.chunks
    names = tuple(name for name in case.equations.extra if name not in PROBE)
    chosen = [case.equations.extra.index(name) for name in names]
    columns = np.concatenate([part.extra[..., chosen].reshape(part.residual.size, -1) for part in rows])
    left = case.left
    columns = left.unexplained(np.pad(columns, ((0, len(left.values) - len(columns)), (0, 0))))
    probability = score_tests(left, [columns])[0].probability
    if probability >= _GATE:
        return None
    of_group = {name: _group(name) for name in names}
    groups = tuple(dict.fromkeys(of_group.values()))
    members = np.array([[float(of_group[name] == group) for name in names] for group in groups])
    effects = Effects.none(left, record.given_noise is not None)
    sd, _ = group_deviations(effects, columns, members)
    variance = effects.joined(columns, sd**2 @ members).variance
    moments, _ = second_moments(effects._replace(variance=variance), columns, sd, members)
    steps = natural_steps(names)
    in_units = {group: float(s * steps[np.argmax(row)]) for group, s, row in zip(groups, sd, members, strict=True)}
    return HeldErrors(names, probability, in_units, moments)


def _group(name: str) -> str:
    return "lengths" if is_length(name) else "zeros of the joints" if name.startswith("theta") else "angles of the axes"


def amend(result: Calibration, case: Case) -> Calibration:
    """The calibration with what the errors of the held arm make uncertain of its geometry."""
    with np.errstate(all="ignore"):
        errors = case.once(errors_of_held)
    if errors is None:
        return result
    linear, k = linearisation_of(case.record, errors.names, noise=case.record.given_noise), len(errors.names)
    influence = linear.influence(np.arange(len(linear.z)) < k)
    steps = np.asarray(linear.steps)
    columns: list[Any] = [
        np.zeros((k, *block.white.shape)) if block.by_head is None else block.by_head[:k] * steps[:k, None, None]
        for block in linear.blocks
    ]
    head, components = influence.response(columns)
    moved = steps[:, None] * np.concatenate([head, *(part.reshape(-1, k) for part in components)])
    moved, positions = moved[k:], linear.observed.positions
    covariances = {
        part: np.asarray(covariance) + moved[positions[part]] @ errors.moments @ moved[positions[part]].T
        for part, covariance in result.observed.geometry_covariance.items()
    }
    return eqx.tree_at(lambda r: r.observed.geometry_covariance, result, covariances)


def test(case: Case) -> list[Finding]:
    """That the arm, which is held, errs."""
    errors = case.once(errors_of_held)
    if errors is None:
        return []
    sizes = [
        f"{group} {rounded(sd)} mm" if group == "lengths" else f"{group} {rounded(sd / DEG)} deg"
        for group, sd in errors.sd.items()
    ]
    record = case.record
    seen = [
        f"the corners of '{part.name}' are {rounded(found.rms)} {part.camera_model.unit} RMS off, each image as a "
        f"whole, and scatter by {rounded(_scatter(part))} {part.camera_model.unit} within it"
        for part in record.recording.capture.observations
        if isinstance(part, Pixels)
        for found in [reprojection(record.calibrated.arm, part, record.observed.geometry)]
    ]
    return [
        Finding(
            "held-arm",
            f"The arm, which was held, errs ({chance_text(errors.probability)})"
            + (f": {listed(seen)}." if seen else "."),
            f"The U of mounts and places contains errors of its parameters as large as the residuals show them "
            f"(standard deviations: {', '.join(sizes)}), but not errors that no parameter describes, such as bending "
            "and backlash.",
            "Calibrate the arm too, without --arm-fixed.",
            severity="doubt",
            doubt="the arm, which was held, errs",
            probability=errors.probability,
        )
    ]


def _scatter(part: Pixels) -> float:
    """Root mean square of a corner's distance by its own standard deviation."""
    u = np.asarray(part.u)[part.seen]
    return float(np.sqrt(np.mean(np.sum(u**2, axis=-1))))
