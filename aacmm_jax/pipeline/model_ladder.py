"""Which model of its joints an arm needs: models from simple to rich, judged by regions that they have not seen.

Errors of poses like those that a model was fitted to hardly tell models apart, and a random part of the poses is such.
Regions exclude each model whose mean square error exceeds that of the best by more than chance explains, region by
region: what two models have in common (a region that is hard for both) cancels in the difference (Breiman et al. 1984,
section 3.4.3, with paired differences). A model that is richer than the best has nothing to show for it. Of those left,
which predict equally well as far as the regions can tell, the simplest is chosen that makes the measurement nearly as
probable as the most probable one (`log_evidence`).

The evidence of a model is the probability of what was measured, after every parameter and scale has been integrated
out. The equations are linear at the solution, and what is known of a learned scale is that its log variance is expected
with the variance 9 (`uncertainty.evidence`), so that all integrals are Gaussian (Laplace's method; MacKay 1992; Kass
and Raftery 1995, Journal of the American Statistical Association 90, section 4.1).
"""

import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..calibration.record import record_of
from ..calibration.results import Calibration, PriorMetrics
from ..core.arguments import checked_arguments, items_of
from ..core.arrays import Numbers
from ..core.blas_threads import one_blas_thread
from ..core.distributions import student_quantile
from ..core.errors import InputError
from ..core.numpy_or_jax import to_numpy
from ..core.text import listed
from ..data.capture import Capture
from ..data.noise import Noise
from ..data.recording import Recording
from ..diagnostics.equations import PRIOR, Equations, equations_of
from ..kinematics.arm import DOWN, Arm, without_corrections
from ..kinematics.corrected_arm import with_corrections, with_couplings_of
from ..kinematics.parameters import ArmSpecification, Bounds
from ..kinematics.priors import default_prior
from .cross_validation import UnseenRegion, regions_of, unseen_regions
from .single import calibrate, default_bounds, with_coefficients

_LEVEL = 0.05  # of the test by regions
_EXPECTED_VARIANCE = 9.0  # of a log variance that is expected
_SMALL = 1e-9  # singular value, relative to the largest
_EVIDENCE = 3.0  # of a log evidence: 20 times as probable, from which evidence is "strong" (Kass and Raftery)
DEFAULT_MODELS = ("dh", "gravity", "harmonics=1", "gravity,harmonics=1", "functions", "gravity,functions")
_BY_COLUMN = {"directions": "backlash", "load": "load", "thermometer": "expansion"}


class ComparedModel(NamedTuple):
    """One model: errors inside and outside what it was fitted to, mm."""

    model: str
    parameters: int  # free ones of the arm
    effective_parameters: float  # how many of them the data determine
    rms_inside: float  # root mean square distance from the geometry, of all poses, calibrated with all
    regions: tuple[UnseenRegion, ...]
    cpu_seconds: float
    result: Calibration  # with all poses
    log_evidence: float = 0.0  # but for what all models of the capture have in common

    @property
    def mean_squares(self) -> Float[np.ndarray, " f"]:
        """Mean square error of each region, of a calibration without it, mm^2."""
        return np.array([region.mean_square for region in self.regions])

    @property
    def rms_outside(self) -> float:
        """Root of their mean, mm."""
        return float(np.sqrt(np.mean(self.mean_squares)))

    @property
    def u_outside(self) -> float:
        """Standard error of `rms_outside` by the scatter of the regions, mm."""
        squares = self.mean_squares
        return float(np.std(squares, ddof=1) / np.sqrt(len(squares)) / max(2 * self.rms_outside, 1e-300))

    @property
    def ratio(self) -> float:
        """Mean of (error / predicted standard deviation)^2 outside; about 1 where noise and prior are right.

        Shared errors are not in this prediction, which is to show what a model lacks; they are in the
        uncertainty of ``result``.
        """
        return float(np.mean([region.ratio for region in self.regions]))


def paired_difference(model: ComparedModel, other: ComparedModel) -> tuple[float, float]:
    """Mean over the regions of the differences of two models' mean square errors, and its standard error, mm^2."""
    paired = model.mean_squares - other.mean_squares
    return float(np.mean(paired)), float(np.std(paired, ddof=1) / np.sqrt(len(paired)))


def rms_difference(difference: float, u: float, rms: float, other: float) -> tuple[float, float]:
    """Difference of two RMS errors and its standard error, mm, by those of their squares, mm^2.

    A difference of squares is that of the roots times their sum, which is taken as known.
    """
    total = max(rms + other, 1e-300)
    return difference / total, u / total


class ComparedModels(NamedTuple):
    """Models from simple to rich, and which of them to use.

    Example:
        >>> compared = aj.compare_models(arm, two_bars, bounds, models=["dh", "harmonics=1"])
        >>> print(compared.best, compared.recommended.model)
        0 dh
        >>> difference, u = compared.excess("harmonics=1", over="dh")
        >>> print(f"{difference:.4f} mm, standard error {u:.4f} mm")
        0.0003 mm, standard error 0.0003 mm
    """

    models: tuple[ComparedModel, ...]
    skipped: tuple[str, ...] = ()  # models that the data cannot carry: with more unknowns than equations, for example

    @property
    def best(self) -> int:
        """Number of the model with the smallest error outside."""
        return int(np.argmin([np.mean(model.mean_squares) for model in self.models]))

    @property
    def differences(self) -> list[tuple[float, float]]:
        """Of each model from the best: mean difference of the mean square errors, and its standard error, mm^2."""
        return [paired_difference(model, self.models[self.best]) for model in self.models]

    def excess(self, model: str, over: str | None = None) -> tuple[float, float]:
        """How much larger the RMS error of one model outside is than that of another, and the standard error, mm.

        The differences are paired: those of the mean square errors, region by region, as in the rule.

        Args:
            model: One of the compared models, by its name.
            over: The model from which it differs; by default the best one.

        Returns:
            The difference, negative where the errors of ``model`` are smaller, and its standard error. The rule
            excludes models that exceed the best by more than `significant` times the standard error.

        Raises:
            InputError: Such a model was not compared.
        """
        first = self._named(model)
        second = self.models[self.best] if over is None else self._named(over)
        return rms_difference(*paired_difference(first, second), first.rms_outside, second.rms_outside)

    def _named(self, name: str) -> ComparedModel:
        found = [model for model in self.models if model.model == name]
        if not found:
            names = listed([model.model for model in self.models])
            raise InputError(f"'{name}' is not one of the compared models; name one of {names}.")
        return found[0]

    @property
    def significant(self) -> float:
        """Number of standard errors by which a model must exceed the best to be excluded (Student's t).

        At 5 % for all models together (Bonferroni): the best is what chance favoured most.
        """
        level = _LEVEL / max(len(self.models) - 1, 1)
        return float(student_quantile(1 - level / 2, len(self.models[0].regions) - 1))

    @property
    def as_good(self) -> tuple[ComparedModel, ...]:
        """The best outside, and simpler ones that the regions cannot tell from it."""
        simpler = slice(self.best + 1)
        differences = zip(self.models[simpler], self.differences[simpler], strict=True)
        return tuple(model for model, (mean, u) in differences if mean <= self.significant * u)

    @property
    def recommended(self) -> ComparedModel:
        """The simplest of these whose log evidence is within 3 of the largest among them."""
        least = max(model.log_evidence for model in self.as_good) - _EVIDENCE
        return next(model for model in self.as_good if model.log_evidence >= least)


def default_models(arm: Arm, capture: Capture) -> tuple[str, ...]:
    """`DEFAULT_MODELS`; where the capture has torques, those of gravity also with torques in its place, and where it
    has directions of approach, loads or temperatures, each of them also with what these may show."""
    recorded = arm.beside.names(capture.columns)
    models: list[str] = []
    for model in DEFAULT_MODELS:
        if "torques" in recorded and "gravity" in model:
            models.append(model.replace("gravity", "torque"))
        models.append(model)
    for column, kind in _BY_COLUMN.items():
        if column in recorded:
            models = [each for model in models for each in (model, kind if model == "dh" else f"{model},{kind}")]
    return tuple(models)


@checked_arguments
@one_blas_thread
def compare_models(
    arm: Arm | ArmSpecification,
    capture: Capture,
    bounds: Bounds | None = None,
    *,
    models: Iterable[str] | None = None,
    regions: Iterable[str] | None = None,
    noise: Noise | None = None,
    mass: Numbers | None = None,
    centre: Numbers | None = None,
    gravity: Numbers = DOWN,
    progress: Callable[[ComparedModel], object] | None = None,
) -> ComparedModels:
    """Fit models of the joints, each with its prior's scales learned, and predict regions that they have not seen.

    Recommended is, of the models that the regions cannot tell from the best, the simplest whose log evidence is within
    3 of the largest. A region is a placement, a station or another group that shares an unknown geometry, where there
    are at least three; otherwise either half of each joint's travel. Errors are distances of the poses from their
    geometry; reference lengths take part in the fits only.

    Args:
        arm: The nominal arm, or what its file states (``recording.nominal``), with the bounds that it proposes;
            corrections that it has are replaced by those of each model, except full couplings.
        capture: Sockets, reference lengths and other observations.
        bounds: Box of the free Denavit-Hartenberg parameters, mm and rad; by default that of the arm's file, else 10
            mm and 1 deg around those that such data determine. Coefficients of corrections are free in each model that
            has them.
        models: Models from simple to rich, as for `kinematics.with_corrections`; "dh" is the arm alone. The default
            (`default_models`) takes some ten seconds for 500 poses, most of them for "functions" (harmonics=1-31, 62
            coefficients a joint).
        regions: What to leave out instead, each as a name or a shell pattern: ``["monday/*", "tuesday/*"]``.
        noise: Standard deviations of readings and seat, as for `calibrate`.
        mass: Mass of each link ``(n,)``, kg, as for `kinematics.with_corrections`.
        centre: Centre of mass of each link ``(n, 3)``, mm.
        gravity: Direction of gravity in the base frame ``(3,)``.
        progress: Called with each model as soon as its errors are known.

    Returns:
        The errors of each model that the data can carry, and the recommended one with its calibration.

    Raises:
        InputError: A model is unknown, fewer than two regions can be left out, or, where the data can carry none of the
            models, as `calibrate` does.

    Example:
        >>> compared = aj.compare_models(arm, two_bars, bounds, models=["dh", "harmonics=1"])
        >>> for model in compared.models:
        ...     print(f"{model.model}: {model.rms_inside:.4f} mm inside, {model.rms_outside:.4f} mm outside")
        dh: 0.0125 mm inside, 0.0307 mm outside
        harmonics=1: 0.0124 mm inside, 0.0310 mm outside
        >>> print("recommended:", compared.recommended.model)
        recommended: dh
    """
    if isinstance(arm, ArmSpecification):
        arm, bounds = arm.arm, arm.bounds() if bounds is None else bounds
    named = default_models(arm, capture) if models is None else items_of(models, "models")
    if not named or not all(isinstance(model, str) and model.strip() for model in named):
        raise InputError(
            "models is empty; give models from the simplest to the richest, such as 'dh' and 'dh,gravity'."
        )
    if len(set(named)) < len(named):
        raise InputError(f"models names '{max(named, key=named.count)}' twice; name each model once.")
    plain = without_corrections(arm)
    bounds = default_bounds(plain, capture) if bounds is None else bounds
    left_out = regions_of(to_numpy(capture), regions, arm.joints)
    loads: dict[str, Any] = {"mass": mass, "centre": centre, "gravity": gravity}

    def compared(model: str, modelled: Arm) -> ComparedModel:
        begun = time.process_time()
        widened = with_coefficients(bounds, modelled)
        corrected, prior = widened.space.base, default_prior(widened.space.base)
        result = calibrate(
            *(corrected, capture, widened),
            method="joint",
            noise=noise,
            prior=prior,
            replace_noise=False,  # so that all models are compared with the same
            undetermined="ignore",
        )
        record = record_of(result, Recording(capture, ArmSpecification(corrected)))
        assert record.prior is not None
        equations = equations_of(record)
        return ComparedModel(
            model=model,
            parameters=len(record.names),
            effective_parameters=float(np.sum(record.prior.effective)),
            rms_inside=record.observed.rms,
            regions=unseen_regions(record, left_out, equations),
            cpu_seconds=time.process_time() - begun,
            result=result,
            log_evidence=log_evidence(equations, record.prior, {group: float(sd) for group, sd in prior.sd.items()}),
        )

    modelled = [with_couplings_of(arm, with_corrections(plain, model, **loads)) for model in named]
    found, skipped = [], {}
    for model, of_model in zip(named, modelled, strict=True):
        try:
            found.append(compared(model, of_model))
        except InputError as error:
            skipped[model] = str(error)
        else:
            if progress is not None:
                progress(found[-1])
    if not found:
        raise InputError(skipped[named[0]])
    return ComparedModels(tuple(found), tuple(skipped))


def log_evidence(equations: Equations, prior: PriorMetrics, expected: Mapping[str, float]) -> float:
    """Logarithm of the evidence of one of several models of the same capture, to be compared with that of others.

    ``expected`` is the standard deviation that is expected of each learned group, in its unit. Constants that all
    models of a capture have in common are left out: of the geometry, which has no prior, and of reference lengths and
    certified values.
    """
    logarithm, information, squares, eliminated = 0.0, 0.0, 0.0, 0.0
    # What learned scales cost: being away from what is expected, and having been chosen by the data, of which each
    # parameter that they determine adds 1/2 to the curvature by the log variance.
    for group, sd, effective, learned in zip(prior.groups, prior.sd, prior.effective, prior.learned, strict=True):
        if learned:
            away = 2 * float(np.log(sd / expected[group]))
            logarithm -= 0.5 * (away**2 / _EXPECTED_VARIANCE + np.log1p(0.5 * float(effective) * _EXPECTED_VARIANCE))
    for rows in equations.rows:
        # The geometry of this observation is eliminated.
        shared, private = (part.reshape(rows.residual.size, part.shape[2]) for part in (rows.shared, rows.private))
        basis, sizes, _ = np.linalg.svd(private, full_matrices=False)
        determined = sizes > _SMALL * sizes.max(initial=1e-300)
        shared = shared - basis[:, determined] @ (basis[:, determined].T @ shared)
        information = information + shared.T @ shared
        eliminated += float(2 * np.sum(np.log(sizes[determined])))
        squares += float(np.sum(rows.residual**2))
        # The product of the standard deviations of the rows, by what one of them is in mm.
        sizes = np.linalg.svd(rows.in_mm, compute_uv=False)
        logarithm -= float(np.sum(np.log(sizes[sizes > _SMALL * sizes.max(initial=1e-300)])))
    for block in equations.relations:
        information = information + block.shared.T @ block.shared
        squares += float(np.sum(block.residual**2))
        if block.fixture == PRIOR:
            logarithm += float(np.sum(np.log(np.linalg.norm(block.shared, axis=1))))
    return logarithm - 0.5 * (squares + eliminated + float(np.linalg.slogdet(information)[1]))
