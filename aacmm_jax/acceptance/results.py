"""What acceptance tests take (`Measured`) and return: metrics, and the values that each metric rests on."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..data.capture import ReferenceLength
from ..data.recording import ProbedSphere
from ..kinematics.workspace import Reach
from ..uncertainty.coverage import COVERAGE_FACTOR
from .judgement import DECISIONS, Decision, Rule, worst
from .standards import EDITIONS, SYMBOLS

# Metrics by name: what each of them is.
#
# >>> print(aj.acceptance.METRICS["SPAT"])
# largest distance from the mean point
METRICS = {
    "Deltam": "largest half range of a coordinate in a socket",
    "Length": "largest deviation of a length",
    "Length_Range": "largest minus smallest deviation of lengths",
    "Length_2RMS": "twice the RMS deviation of lengths",
    "D_Eff": "largest error of the effective diameter",
    "SPAT": "largest distance from the mean point",
    "SPAT_2s": "twice the standard deviation about the mean point",
    "Volumetric": "largest deviation of a bar",
    "Volumetric_Range": "largest minus smallest deviation of bars",
    "Volumetric_2RMS": "twice the RMS deviation of bars",
    "P_Size": "size error of a sphere touched at 25 points",
    "P_Form": "form error of a sphere touched at 25 points",
    "L_Dia": "diameter of the smallest sphere around five centres, one per orientation",
    "E_Uni": "length error of single readings, unidirectional",
}


class MetricValue(NamedTuple):
    """One value that a metric rests on, of a socket, a length or a sphere; mm."""

    where: str
    value: float
    expanded: float  # expanded uncertainty U of the value, with `COVERAGE_FACTOR`
    length: float | None = None  # the calibrated length that was measured, if any: a limit may grow with it
    limit: float | None = None  # MPE
    decision: Decision | None = None  # None without a limit


def metric_value(where: str, value: float, *u: float) -> MetricValue:
    """A value whose standard uncertainty combines the independent contributions ``u``, mm."""
    return MetricValue(where, value, COVERAGE_FACTOR * math.sqrt(sum(part**2 for part in u)))


class Metric(NamedTuple):
    """One metric of a test; its name is a key of `METRICS`.

    Example:
        >>> measured = aj.acceptance.Measured({"cone": result.arm.position(capture.sockets["A"])})
        >>> metric = aj.acceptance.run(measured)[0].metrics[0]
        >>> print(metric.name, f"{metric.value:.4f} mm", metric.decision)
        Deltam 0.0153 mm None
    """

    name: str
    values: tuple[MetricValue, ...]

    @property
    def worst(self) -> MetricValue:
        """The value with the worst decision and, of several, farthest beyond its limit; the largest without limits."""

        def badness(value: MetricValue) -> tuple[int, float]:
            if value.limit is None or value.decision is None:
                return 0, abs(value.value)
            return -DECISIONS.index(value.decision), abs(value.value) - value.limit

        return max(self.values, key=badness)

    @property
    def value(self) -> float:
        """The worst value, mm."""
        return self.worst.value

    @property
    def decision(self) -> Decision | None:
        """The worst decision of all values; None without limits."""
        return worst([value.decision for value in self.values if value.decision is not None])


class AcceptanceTest(NamedTuple):
    """What one test found, and what its full procedure would also have needed (nothing if it is complete).

    Example:
        >>> tests = aj.acceptance.run(aj.acceptance.measured_by(result.arm, aj.Recording(two_bars, nominal)))
        >>> print([test.called for test in tests[:2]])
        ['based on JJF 1408-2013', 'based on ASME B89.4.22-2004']
    """

    standard: str  # a key of `acceptance.judgement.EDITIONS`
    title: str
    metrics: tuple[Metric, ...]
    missing: tuple[str, ...]  # sentences
    rule: Rule = "iso-2017"  # by which limits are decided

    @property
    def decision(self) -> Decision | None:
        """The worst decision of all metrics; None without limits."""
        return worst([metric.decision for metric in self.metrics if metric.decision is not None])

    @property
    def called(self) -> str:
        """The standard's edition; "based on" it if something that the standard requires is missing."""
        return EDITIONS[self.standard] if not self.missing else f"based on {EDITIONS[self.standard]}"

    def symbol(self, metric: Metric) -> str:
        """The standard's symbol of a metric; its plain name if there is none, or the test is not complete."""
        return metric.name if self.missing else SYMBOLS.get(metric.name, metric.name)


class Postures(NamedTuple):
    """How the arm was held at each pose, which points do not tell."""

    elbows: Mapping[str, Float[np.ndarray, " m"]]  # by socket: angle of the elbow to the left of the vertical, rad
    # By sphere and test: directions of the probe at each group's touches.
    probes: Mapping[tuple[str, str], tuple[Float[np.ndarray, "m 3"], ...]]


class Measured(NamedTuple):
    """What acceptance tests are run on: points in mm, as an arm measures them or as they were recorded.

    Example:
        >>> measured = aj.acceptance.Measured({"cone": result.arm.position(capture.sockets["A"])})
        >>> print([test.title for test in aj.acceptance.run(measured)])
        ['single point and length, as in Cheng et al. 2018', 'single-point articulation']
    """

    sockets: Mapping[str, Float[np.ndarray, "m 3"]]
    lengths: tuple[ReferenceLength, ...] = ()
    spheres: tuple[ProbedSphere, ...] = ()  # with groups of points
    reach: Reach | None = None
    identified_from: frozenset[str] = frozenset()  # sockets: their repeatability is not a test
    none_held_out: bool = False  # whether the arm was identified from all of this, so that nothing is a test
    sources: tuple[str, ...] = ()  # files that points were read from
    measured: str = ""  # day on which the points were recorded
    measuring_range: float | None = None  # diameter of the measuring volume as the maker states it, mm
    postures: Postures | None = None  # None of points, which do not tell how the arm was held

    @property
    def size(self) -> float | None:
        """The maker's measuring range (a diameter), mm; twice the reach by the model where it is not stated."""
        if self.measuring_range is not None:
            return self.measuring_range
        return None if self.reach is None else 2 * self.reach.radius

    @property
    def tested(self) -> dict[str, Float[np.ndarray, "m 3"]]:
        """The sockets whose repeatability counts."""
        return {name: points for name, points in self.sockets.items() if name not in self.identified_from}


def percent(span: tuple[float, float]) -> str:
    """A range of fractions of the reach in words."""
    return f"{100 * span[0]:.0f} to {100 * span[1]:.0f} %"
