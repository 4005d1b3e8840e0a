"""Acceptance tests of arms by JJF 1408-2013 (as Cheng et al. 2018 use it), ASME B89.4.22-2004 and ISO 10360-12:2016.

The texts of the standards were not available: formulas and procedures follow secondary sources of the editions named.
Every metric is of single readings, never of means, because a test states by how much one measurement can be wrong.
Uncertainties are the tester's (artefacts, seat, fixture, temperature): the arm's own scatter is what is tested (ISO
14253-5, ISO/TS 23165).
"""

import math
from collections.abc import Mapping
from typing import Annotated

import numpy as np

from ..core.arguments import Range, checked, checked_arguments
from ..core.errors import InputError, nearest
from ..data.recording import Recording, checked_sphere
from ..kinematics.arm import Arm
from ..kinematics.workspace import arm_reach
from .geometry import points_of, postures_of
from .judgement import MOST, Influences, Limit, Rule, checked_influences, checked_limit, decide, without_test
from .requirements import TESTS
from .results import METRICS, AcceptanceTest, Measured, Metric
from .standards import DEFAULT_RULES

NO_INFLUENCES = Influences()
_Millimetres = Annotated[float, Range(least=0, most=MOST, unit="mm")]
_FARTHEST = 1e6  # mm: no arm reaches a kilometre


def measured_by(arm: Arm, recording: Recording) -> Measured:
    """Compute what an arm measures where the poses of a recording were taken, mm.

    Args:
        arm: The arm, for example a calibrated one.
        recording: Joint readings in sockets and on spheres, with the reference lengths.

    Example:
        >>> measured = aj.acceptance.measured_by(result.arm, recording)
        >>> print(measured.sockets["A"].shape, f"{measured.reach.radius:.0f} mm")
        (40, 3) 1360 mm
    """
    capture, touched = recording.capture, [group for sphere in recording.spheres for group in sphere.groups]
    readings = [np.asarray(q) for q in (*capture.sockets.values(), *touched)]
    ends = np.cumsum([len(q) for q in readings])
    none = np.zeros((0, capture.columns))
    points = iter(np.split(np.asarray(arm.position(np.concatenate([*readings, none]))), ends[:-1]))
    sockets = {name: next(points) for name in capture.sockets}
    # Sockets that held another target than the arm's own probe are not part of any procedure.
    lengths = tuple(length for length in capture.lengths if length.start in sockets and length.end in sockets)
    spheres = tuple(sphere._replace(groups=tuple(next(points) for _ in sphere.groups)) for sphere in recording.spheres)
    reach = arm_reach(arm)
    postures = postures_of(arm, recording, reach)
    return Measured(sockets, lengths, spheres, reach, measuring_range=recording.measuring_range, postures=postures)


@checked_arguments
def run(
    measured: Measured,
    limits: Mapping[str, Limit | float] | None = None,
    u_test: _Millimetres = 0.0,
    *,
    influences: Influences = NO_INFLUENCES,
    rule: Rule | None = None,
) -> list[AcceptanceTest]:
    """Run every test that the measured points allow and that has at least one metric.

    Source: JJF 1408-2013 as used by Cheng et al. 2018, ASME B89.4.22-2004, ISO 10360-12:2016; formulas stated from
    secondary sources (`requirements_table` says which, and how certain they are). Decisions: see `decide`. A test says
    what its full procedure would also need, and bears the standard's name (`AcceptanceTest.called`) only where nothing
    that can be checked is missing. `InputError` for points that are not in mm, and for a limit of a metric that these
    points do not give, or that grows with a length although the metric is not of one.

    Args:
        measured: Points of sockets and spheres, and reference lengths, mm.
        limits: MPE by the name of a metric (a key of `METRICS`): a `Limit`, or a number of mm.
        u_test: Standard uncertainty that seat and fixture add to every test value, mm.
        influences: What else adds to it: in proportion to a length, and thermal expansion of artefact and arm.
        rule: Decision rule (a key of `RULES`); by default ISO 14253-1:2017, and simple acceptance for ASME.

    Example:
        >>> measured = aj.acceptance.measured_by(result.arm, aj.Recording(two_bars, nominal))
        >>> for test in aj.acceptance.run(measured, limits={"SPAT": 0.1}):
        ...     print(test.called, [(metric.name, metric.decision) for metric in test.metrics])
        based on JJF 1408-2013 [('Deltam', None), ('Length', None), ('Length_Range', None), ('Length_2RMS', None)]
        based on ASME B89.4.22-2004 [('SPAT', 'conforms'), ('SPAT_2s', None)]
        based on ASME B89.4.22-2004 [('Volumetric', None), ('Volumetric_Range', None), ('Volumetric_2RMS', None)]
        based on ISO 10360-12:2016 [('E_Uni', None)]
    """
    measured, influences, given = _checked(measured), checked_influences(influences), checked_limits(limits or {})
    influences = influences._replace(u=math.hypot(influences.u, u_test))
    tests = [result for test in TESTS if (result := test.run(measured, influences)) is not None]
    tests = [test._replace(rule=rule or DEFAULT_RULES[test.standard]) for test in tests]
    if measured.none_held_out:
        held_out = "Everything was used to identify the arm; measure sockets and lengths that were not."
        tests = [test._replace(missing=(held_out, *test.missing)) for test in tests]
    present = {metric.name for test in tests for metric in test.metrics}
    for name in given:
        if name not in present:
            held_out = " that the calibration was not identified from" if measured.identified_from else ""
            raise InputError(
                f"a limit is given for {name} ({METRICS[name]}), but the capture has nothing{held_out} to measure it on"
                "; leave the limit out."
            )
    return [
        test._replace(metrics=tuple(_decided(metric, given, test.rule) for metric in test.metrics)) for test in tests
    ]


def checked_limits(limits: Mapping[str, Limit | float]) -> dict[str, Limit]:
    """Limits by the name of a metric, numbers made into `Limit`; `InputError` for an unknown metric or a bad limit."""
    by_name = {}
    for name, limit in limits.items():
        if name not in METRICS:
            raise InputError(f"there is no metric '{name}'{without_test(name, list(METRICS))}")
        fixed, divisor = limit if isinstance(limit, Limit) else (limit, math.inf)
        what = f"the limit of {name}"
        by_name[name] = checked_limit(Limit(float(checked(fixed, _Millimetres, what)), divisor), what)
    return by_name


def _checked(measured: Measured) -> Measured:
    sockets = {name: points_of(points, f"the points of socket '{name}'") for name, points in measured.sockets.items()}
    for length in measured.lengths:
        for end in (length.start, length.end):
            if end not in sockets:
                raise InputError(
                    f"length '{length.start}' to '{length.end}' names the unknown socket '{end}'{nearest(end, sockets)}"
                )
    spheres = tuple(checked_sphere(sphere, 3) for sphere in measured.spheres)
    for name, points in (*sockets.items(), *((sphere.name, group) for sphere in spheres for group in sphere.groups)):
        if np.abs(points).max() > _FARTHEST:
            raise InputError(f"'{name}' has a coordinate beyond {_FARTHEST:g} mm; give points in mm.")
    size = measured.measuring_range
    if size is not None and not 0 < size <= 2 * _FARTHEST:
        raise InputError(f"measuring_range is {size:g} mm; give the diameter of the maker's measuring volume in mm.")
    return measured._replace(sockets=sockets, spheres=spheres)


def _decided(metric: Metric, limits: Mapping[str, Limit], rule: Rule) -> Metric:
    if metric.name not in limits:
        return metric
    values = []
    for value in metric.values:
        if value.length is None and math.isfinite(limits[metric.name].divisor):
            raise InputError(
                f"the limit of {metric.name} grows with a length, but the metric is not of one; give only a number."
            )
        limit = limits[metric.name].at(value.length or 0.0)
        values.append(value._replace(limit=limit, decision=decide(value.value, limit, value.expanded, rule)))
    return metric._replace(values=tuple(values))
