"""Sockets and placements that contradict the others of a capture."""

from typing import NamedTuple

import numpy as np

from ..calibration.record import CalibrationRecord
from ..core.numpy_or_jax import to_numpy
from ..data.capture import Capture
from ..kinematics.arm import is_length, value_of
from ..kinematics.parameters import Parameters
from ..model.measurement import Measurement
from ..uncertainty.group_test import GroupTest, contradicting_groups

# Mean square that a group adds over that of the others: errors outside the D-H model make it 7 on real arms, and it
# is 1 where there are none.
_LEAST_RATIO = 9.0
_EXACT = 1e-6  # mm: smaller contradictions are rounding errors of a simulation without noise


class _Equations(NamedTuple):
    """The tips of a calibration, pose by pose, and their derivatives in natural steps."""

    capture: Capture
    tips: np.ndarray  # from their socket's centroid, mm
    slopes: np.ndarray  # of these
    root: np.ndarray  # inverse roots of the tips' covariances, 1/mm

    @classmethod
    def of(cls, record: CalibrationRecord) -> "_Equations":
        capture = record.recording.capture
        arm, measurement, noise = to_numpy((record.calibrated.arm, Measurement.of(capture), record.noise))
        names = tuple(name for name in record.names if name != _scale_anchor(record))
        slopes = np.asarray(arm.jacobian(measurement.q, names)) * np.asarray(Parameters(arm, names).scale)
        centred = np.stack([measurement.centred(slopes[:, :, i]) for i in range(len(names))], axis=-1)
        weights = measurement.weighted(arm.geometry, noise).weights
        assert weights is not None
        tips = measurement.centred(np.asarray(arm.position(measurement.q)))
        return cls(capture, np.asarray(tips), centred, np.moveaxis(np.asarray(weights.root), -1, 0))

    def contradicting(self, labels: list[str]) -> list[list[GroupTest]]:
        """Groups of sockets by their labels; a socket with one pose belongs to none."""
        chosen = np.asarray(self.capture.sizes)[self.capture.owner] > 1
        root, owner = self.root[chosen], self.capture.owner[chosen]
        residual = np.einsum("nab,nb->na", root, self.tips[chosen])
        groups = [labels[i] for i in owner]
        tests = (residual, root @ self.slopes[chosen], root, owner.tolist(), groups)
        found = contradicting_groups(*tests, least_ratio=_LEAST_RATIO)
        return [] if found and self.rms(labels, found[0][0])[1] < _EXACT else found

    def rms(self, labels: list[str], test: GroupTest) -> tuple[float, float, float, float]:
        """RMS distance of tips from their centroid, mm: of a group and of the others, each in the identification from
        all and in that from the others."""
        owner = self.capture.owner
        own = np.array([label == test.group for label in labels])[owner]
        scattering = np.asarray(self.capture.sizes)[owner] > 1
        moved = self.tips + self.slopes @ test.step
        own, others = own & scattering, ~own & scattering
        with_all, without = (np.sum(tips**2, axis=1) for tips in (self.tips, moved))
        means = (with_all[own], without[own], with_all[others], without[others])
        return tuple(float(np.sqrt(squares.mean())) for squares in means)  # pyright: ignore[reportReturnType]


def _scale_anchor(record: CalibrationRecord) -> str | None:
    """The length that is kept, because residuals vanish where the whole arm shrinks."""
    lengths = [name for name in record.names if is_length(name)]
    if record.hold is not None or record.scale_set_by or not lengths:
        return record.hold
    return max(lengths, key=lambda name: abs(value_of(record.calibrated.arm, name)))


def contradictions(record: CalibrationRecord) -> list[str]:
    """Which sockets, or placements (what is before the last "/" of a name), contradict the others; nearly always none.

    Every group is tested by the poses of the others (`uncertainty.group_test`), which takes milliseconds.
    """
    names = record.recording.capture.names
    by_kind = {"socket": list(names), "placement": [name.rpartition("/")[0] or name for name in names]}
    if by_kind["placement"] == by_kind["socket"]:
        del by_kind["placement"]
    equations = _Equations.of(record)
    with np.errstate(all="ignore"):
        found = {kind: equations.contradicting(labels) for kind, labels in by_kind.items()}
    # An error of a whole placement shows less in one of its sockets, and that of one socket less in its placement.
    kind = max(found, key=lambda kind: found[kind][0][0].ratio if found[kind] else 0.0)
    return [_sentence(equations, kind, by_kind[kind], tests) for tests in found[kind]]


def _sentence(equations: _Equations, kind: str, labels: list[str], tests: list[GroupTest]) -> str:
    changes, options = [], []
    for test in tests:
        own, own_without, others, others_without = equations.rms(labels, test)
        changes.append(
            f"without {test.group}, the others scatter by {others_without:.2g} mm RMS instead of {others:.2g} mm, and "
            f"it by {own_without:.2g} mm instead of {own:.2g} mm"
        )
        options.append(f"--without '{test.group}{'' if kind == 'socket' else '/*'}'")
    if len(tests) == 1:
        return (
            f"{kind.capitalize()} {tests[0].group} contradicts the other {kind}s: {changes[0]}. Check its readings, "
            f"and calibrate without it ({options[0]})."
        )
    return (
        f"Some {kind}s contradict each other, and the data do not show which of these is wrong: {'; '.join(changes)}. "
        f"Check their readings, and calibrate without the wrong one ({' or '.join(options)})."
    )
