"""A recording simulated as ``aacmm simulate`` does it: one call, whose options state their defaults once."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..acceptance.procedure import plan_procedure, simulate_procedure
from ..acceptance.standards import Standard
from ..core.arguments import NotNegative, checked_arguments, with_options
from ..core.arrays import Numbers
from ..core.errors import InputError
from ..data.capture_data import ReferenceLength
from ..data.noise import Noise
from ..data.observations.simulated import AbstractSimulated
from ..data.recording import Recording
from ..data.simulation import simulate
from ..kinematics.parameters import ArmSpecification, perturbed_arm

_U_ARTEFACT = 0.001  # mm


class SimulationOptions(NamedTuple):
    """How `simulate_capture` simulates: its keyword arguments, described there, and their defaults.

    Example:
        >>> options = aj.pipeline.SimulationOptions(poses=5, deviate_length=1.0, seed=3)
        >>> print(aj.simulate_capture(nominal, {"A": (400, 200, 300)}, **options._asdict()).seed)
        3
    """

    true: ArmSpecification | None = None
    deviate_length: NotNegative = 0.0
    deviate_angle: NotNegative = 0.0
    poses: int | Mapping[str, int] = 70
    lengths: Sequence[ReferenceLength | tuple] = ()
    noise: Noise | None = None
    resolution_arcsec: float | Sequence[float] = 0.0
    temperature: Numbers | None = None
    acceptance: Standard | None = None
    observations: Sequence[AbstractSimulated] = ()
    seed: int = 0


@checked_arguments
@with_options(SimulationOptions)
def simulate_capture(
    nominal: ArmSpecification, sockets: Mapping[str, Numbers] | None = None, **options: Any
) -> Recording:
    """Simulate a recording of an arm: what ``aacmm simulate`` does, with the same defaults.

    Args:
        nominal: the arm that the recording states.
        sockets: socket name -> position ``(3,)`` in the base frame, mm; None with ``acceptance``.
        true: the arm that takes the poses; by default the nominal one.
        deviate_length: largest random error of each of its lengths, as of manufacture, mm.
        deviate_angle: largest random error of each of its angles, rad.
        poses: number of poses in each socket, or socket name -> number.
        lengths: reference lengths, as for `simulate`.
        noise: standard deviations of readings and seat; by default none.
        resolution_arcsec: readings are rounded to multiples of it, as for `simulate`.
        temperature: of an arm with a thermometer, C, as for `simulate`.
        acceptance: instead of sockets, the acceptance test of "jjf", "asme" or "iso", as
            `acceptance.plan_procedure` plans it for the nominal arm; artefacts have u = 0.001 mm.
        observations: what else is recorded, as for `simulate`.
        seed: of the arm's errors, the poses and the noise.

    Returns:
        The recording, with the true arm.

    Raises:
        InputError: arms with different numbers of joints, a target out of reach, no socket, or options that do not go
            together.

    Example:
        >>> recorded = aj.simulate_capture(nominal, {"A": (400, 200, 300)}, poses=5, deviate_length=1.0)
        >>> print(recorded.true.name, len(recorded.capture.q))
        Cheng 2018, simulated arm, deviated 5
    """
    chosen = SimulationOptions(**options)
    true = _true_arm(nominal, chosen)
    if chosen.acceptance is not None:
        of_sockets = (
            bool(chosen.observations),
            chosen.poses != SimulationOptions().poses,
            chosen.lengths,
            chosen.temperature is not None,
        )
        if sockets or any(of_sockets) or np.any(chosen.resolution_arcsec):
            raise InputError(
                "--acceptance determines the sockets, poses, lengths and temperature (20 C) itself; leave out "
                "--socket, --poses, --length, --resolution-arcsec, --linear-resolution-mm, --temperature-c and --kit."
            )
        procedure = plan_procedure(nominal.arm, chosen.acceptance)
        u = {"u_length": _U_ARTEFACT, "u_diameter": _U_ARTEFACT}
        return simulate_procedure(procedure, nominal, true, noise=chosen.noise, **u, seed=chosen.seed)
    if not sockets and not chosen.observations:
        raise InputError("no socket is given; give --socket NAME=X,Y,Z (sockets), --kit FILE, or --acceptance.")
    capture = simulate(
        true.arm,
        sockets or {},
        poses=chosen.poses,
        lengths=chosen.lengths,
        noise=chosen.noise,
        resolution_arcsec=chosen.resolution_arcsec,
        temperature=chosen.temperature,
        observations=chosen.observations,
        seed=chosen.seed,
    )
    return Recording(capture, nominal, true, chosen.seed)


def _true_arm(nominal: ArmSpecification, chosen: SimulationOptions) -> ArmSpecification:
    """The arm that takes the poses, with its errors of manufacture."""
    true = nominal if chosen.true is None else chosen.true
    if true.arm.joints != nominal.arm.joints:
        raise InputError(
            f"the true arm '{true.name}' has {true.arm.joints} joints, but '{nominal.name}' has {nominal.arm.joints} "
            "joints; choose a true arm with the same number of joints."
        )
    if not (chosen.deviate_length or chosen.deviate_angle):
        return true
    deviation = {"length": chosen.deviate_length, "angle": chosen.deviate_angle}
    drawn = perturbed_arm(true.space(), **deviation, seed=chosen.seed)
    return true._replace(arm=drawn, name=f"{true.name}, deviated")
