"""What a calibration says of a capture with one mistake: what is first, whether that is right, and what it costs.

The detection limit of a mistake is the size at which a chi-squared test of the residuals, with the noise as it is,
finds it in half of the cases. Residuals of exact data that contain nothing but the mistake have a sum of squares, in
standard deviations, which is the non-centrality of that test's chi-square distribution in noisy data; it grows with the
square of the size, so one exact calibration is enough. The test has the level 1 %. A mistake that the free parameters
and the unknown geometry take up entirely has no limit: no residual shows it.
"""

import math
import re
import tempfile
import time
import warnings
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import brentq
from scipy.stats import chi2, ncx2

import aacmm_jax as aj
from aacmm_jax.calibration.record import CalibrationRecord, Removed, record_of
from aacmm_jax.diagnostics.findings import Finding, case_of, findings_of

from .cases import CASES
from .kinds import KINDS, Kind
from .trial import Trial, exact_poses

SOUND = "sound"  # in place of a mistake
Job = tuple[str, str, float, int]  # mistake, case, multiple of the detection limit, seed
LEVEL = 0.01  # of the chi-squared test
PROBE = 20.0  # standard deviations: size of the mistake in the exact calibration
LEAST = 1e-3  # share of a mistake, in its own squares, below which residuals do not show it
MOST = 3000.0  # standard deviations: a larger limit is none
# Lengths are rows like all others, and nothing is amended by what the residuals show.
EXACT: dict[str, Any] = {"method": "joint", "undetermined": "ignore", "replace_noise": False, "shared_errors": False}
LENGTHS = 200  # pairs of poses at which errors of lengths are compared with U


def applies(kind: str, case: str) -> bool:
    """Whether a mistake can be made with these data."""
    return KINDS[kind].applies(CASES[case])


def unit_of(kind: Kind, case: str) -> float:
    """What moves the tip by about as much as its noise: an angle (rad), a length (mm), a share of a length; or 1."""
    _, _, tips, _ = exact_poses(case, 0)
    reach = float(np.median(np.linalg.norm(tips, axis=1)))
    of_tip = math.hypot(CASES[case].u, math.radians(CASES[case].encoder_arcsec / 3600) * reach)
    return {"angle": of_tip / reach, "length": of_tip, "share": of_tip / reach}.get(kind.unit, 1.0)


def made(kind: str | None, case: str, size: float, seed: int, noise: bool, folder: Path) -> tuple[Trial, Path]:
    """A capture with a mistake, or without, as files."""
    trial, mistake = Trial(case, seed, noise), None if kind is None else KINDS[kind]
    if mistake is not None and mistake.physical:
        mistake.make(trial, size)
    trial.record()
    if mistake is not None and not mistake.physical:
        mistake.make(trial, size)
    return trial, trial.write(folder)


def shown(kind: str | None, case: str, size: float) -> tuple[float, int]:
    """What a mistake does to the residuals of an exact capture: their sum of squares, in standard deviations of the
    noise that the case has otherwise, and their degrees of freedom."""
    with tempfile.TemporaryDirectory() as folder:
        _, manifest = made(kind, case, size, 0, False, Path(folder))
        recording = aj.files.read_manifest(manifest)
    stated = CASES[case]
    noise = aj.Noise(encoder_arcsec=stated.encoder_arcsec, seating=0.0 if stated.instrument else stated.u)
    bounds = recording.nominal.bounds()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        result = aj.calibrate(bounds.space.base, recording.capture, bounds, noise=noise, **EXACT)
        calibrated = case_of(record_of(result, recording))
        rows, relations = calibrated.chunks
    # As they are, not less what the parameters explain: one that is on a bound explains nothing.
    blocks = [*(part.block("") for part in rows), *relations]
    squares = sum(float(np.sum(block.residual**2)) for block in blocks)
    return squares, calibrated.left.degrees_of_freedom


def detection_limit(kind: str, case: str) -> float | None:
    """Size of a mistake that the residuals show in half of the cases; None where they never do; NaN of a mistake that
    has no size."""
    if not KINDS[kind].unit:
        return math.nan
    unit = unit_of(KINDS[kind], case)
    squares, degrees_of_freedom = shown(kind, case, PROBE * unit)
    limit = PROBE * math.sqrt(_noncentrality(degrees_of_freedom) / squares) if squares > LEAST * PROBE**2 else math.inf
    return limit * unit if limit < MOST else None


def _noncentrality(degrees_of_freedom: int) -> float:
    """Of the chi-square distribution whose median is the threshold of the test."""
    threshold = chi2.ppf(1 - LEVEL, degrees_of_freedom)
    return float(brentq(lambda x: ncx2.cdf(threshold, degrees_of_freedom, x) - 0.5, 1e-3, 10 * threshold))


def measured(job: Job) -> dict[str, Any]:
    """One line of the results; a mistake has noise of its own with each case, so that what chance does is spread."""
    kind, case, times, seed = job
    row: dict[str, Any] = {"kind": kind, "case": case, "times": times, "seed": seed}
    if kind == SOUND:
        return row | run(None, case, 0.0, seed)
    limit = detection_limit(kind, case)
    if limit is None:
        return row | {"limit": None}
    size = 0.0 if math.isnan(limit) else times * limit
    return row | {"limit": limit if size else "none needed"} | run(kind, case, size, 1000 * seed + _number(kind, case))


def _number(kind: str, case: str) -> int:
    return zlib.crc32(f"{kind}, {case}".encode()) % 1000


def run(kind: str | None, case: str, size: float, seed: int = 1) -> dict[str, Any]:
    """Calibrate one capture as ``aacmm calibrate`` does; the size is that of the mistake, rad or mm."""
    started = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        trial, manifest = made(kind, case, size, seed, True, Path(folder))
        try:
            recording = aj.files.read_manifest(manifest)
            record = aj.calibrate_capture(recording)
            findings = findings_of(record)
        except Exception as error:  # a refusal is an answer; anything else is an error of the program, to be seen
            code = "refused" if isinstance(error, aj.InputError) else "crashed"
            findings, record = [Finding(code, str(error).replace(folder, ""), severity="unusable")], None
    texts = [f"{finding.code}: {finding.sentence} [{'; '.join(finding.concerns)}]" for finding in findings]
    decisions = [] if record is None else [*record.decisions, *map(_left_out, record.removed)]
    over = math.nan if record is None else beyond_u(trial, record)
    return {
        "severity": next((s for s in ("unusable", "doubt", "note") if s in {f.severity for f in findings}), ""),
        "over_u": round(over, 3) if math.isfinite(over) else None,
        "findings": texts,
        "decisions": decisions,
        "culprit": trial.culprit,
        "cpu": round(time.process_time() - started, 2),
    }


def rank_of(row: dict[str, Any]) -> int | None:
    """At which place the findings of a line name what is wrong; None where none of them does. A decision of the default
    that names it stands before all of them."""
    if row["kind"] == SOUND:
        return None
    names = {name: re.escape(value) for name, value in row["culprit"].items()}
    patterns = [pattern.format(**names) for pattern in KINDS[row["kind"]].right]

    def names_it(text: str) -> bool:
        return any(re.search(pattern, text) for pattern in patterns)

    if any(map(names_it, row.get("decisions", ()))):
        return 1
    return next((n for n, text in enumerate(row["findings"], start=1) if names_it(text)), None)


def _left_out(removed: Removed) -> str:
    return f"left-out: {removed.kind} {removed.group} [{'; '.join(removed.members)}]"


def _as_corrected(readings: np.ndarray, trial: Trial, record: CalibrationRecord) -> np.ndarray:
    """Readings with the order, signs and unit to which the calibration corrected those of the capture: an arm that is
    used as its calibration says is read so too."""
    before, after = trial.readings, np.asarray(record.recording.capture.readings)[:, : trial.joints]
    for misread in trial.misread:
        before = misread(before)
    if not any("readings were corrected" in says for says in record.decisions) or before.shape != after.shape:
        return readings
    return readings @ np.linalg.lstsq(before, after, rcond=None)[0]


def beyond_u(trial: Trial, record: CalibrationRecord) -> float:
    """Root mean square error of lengths measured between poses like those of the capture, over that of their U.

    The arm is used as it was recorded: with the same conventions, with noise of its encoders, which U contains, and
    with its joints as they are after the last pose. Above 1, errors are twice what is predicted. 0 where U is infinite.
    """
    q = trial.exact
    start, end = trial.random.integers(0, len(q), (2, LENGTHS))
    # The true arm is that whose tip is held; where a target was seen, its place is not the arm's own.
    true = trial.true.replace(probe=np.asarray(record.recording.nominal.arm.probe)) if trial.case.target else trial.true
    tips = (1 + trial.growth[-1]) * np.asarray(true.position(q))
    true_length = np.linalg.norm(tips[start] - tips[end], axis=1)
    far = true_length > 0.05 * true_length.max()
    start, end, true_length = start[far], end[far], true_length[far]
    noise = trial.encoder_factor * math.radians(trial.case.encoder_arcsec / 3600) * trial.random.normal(size=q.shape)
    readings, uncertainty = _as_corrected(trial.in_use(q) + noise, trial, record), aj.uncertainty_of(record)
    shown = np.asarray(record.calibrated.arm.position(readings))
    errors = np.linalg.norm(shown[start] - shown[end], axis=1) - true_length
    with np.errstate(all="ignore"):
        expanded = uncertainty.expanded_by_parts(uncertainty.length_parts(readings[start], readings[end], reading=True))
    if not np.all(np.isfinite(expanded)):
        return 0.0
    return float(np.sqrt(np.mean(errors**2) / np.mean(expanded**2)))
