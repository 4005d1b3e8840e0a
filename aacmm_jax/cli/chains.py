"""The chain of a robot that an option names."""

from typing import Any

import numpy as np

from ..core.errors import InputError


def named_chain(robot: Any, name: str | None) -> Any:
    """The chain of a robot with this name, without joint corrections; None of an arm."""
    from ..kinematics.arm import one_chain, without_corrections
    from ..kinematics.robots import chain_of

    if name is None:
        one_chain(robot, "this")
        return None
    if not robot.chains:
        raise InputError("--chain is given, but the arm has no chains; leave it out.")
    return chain_of(without_corrections(robot), name)


def one_chain_of(record: Any, chain: str) -> Any:
    """A calibration as if one chain had been calibrated alone, for what writes its arm."""
    from ..data.capture import Capture
    from ..kinematics.robots import chain_of

    recording, own = record.recording, named_chain(record.recording.nominal.arm, chain)

    def part(specification: Any) -> Any:
        urdf = specification.urdf and specification.urdf._replace(tips=(chain,))
        return specification._replace(arm=chain_of(specification.arm, chain).arm, urdf=urdf)

    whole = recording.capture
    readings = np.asarray(whole.readings)
    capture = Capture({"poses": own.of_robot(readings[readings[:, own.robot_joints] == own.number])})
    true = recording.true and part(recording.true)
    recording = recording._replace(capture=capture, nominal=part(recording.nominal), true=true)
    names = tuple(name for name, of_robot in own.names.items() if of_robot in record.names)
    return record._replace(recording=recording, calibrated=part(record.calibrated), names=names)
