"""A calibration with other names of its sockets."""

import dataclasses

import aacmm_jax as aj
from aacmm_jax.data.observations.held import position_of


def renamed_sockets(record: aj.calibration.CalibrationRecord, *names: str) -> aj.calibration.CalibrationRecord:
    """A record of sockets alone, with these names of them in the order of the capture."""
    capture, observed = record.recording.capture, record.observed
    new = dict(zip(capture.names, names, strict=True))
    lengths = [aj.ReferenceLength(new[one.start], new[one.end], one.value, one.u) for one in capture.lengths]
    renamed = aj.Capture({new[name]: q for name, q in capture.sockets.items()}, lengths)
    geometry, covariance = (
        {position_of(new[name]): parts[position_of(name)] for name in capture.names}
        for parts in (observed.geometry, observed.geometry_covariance)
    )
    observed = dataclasses.replace(observed, names=names, geometry=geometry, geometry_covariance=covariance)
    return record._replace(recording=record.recording._replace(capture=renamed), observed=observed)
