"""What a calibration file holds of its prior, by group and by parameter."""

import numpy as np

from ..calibration.record import CalibrationRecord
from ..calibration.results import PriorMetrics
from .hdf5 import Stored, Table, columns


def prior_tables(record: CalibrationRecord) -> dict[str, Table]:
    """The table of a calibration's prior, by group and by parameter."""
    prior = record.prior
    if prior is None:
        return {}
    by_group = columns(
        "prior_group",
        prior_group=(list(prior.groups), "", "group of parameters with one prior"),
        learned=(np.array(prior.learned, dtype=np.int8), "1", "1: its standard deviation was learned from the data"),
        unit=(list(prior.units), "", "unit of its standard deviation"),
        parameters=(list(prior.parameters), "1", "how many free parameters it has"),
        sd=(np.asarray(prior.sd), "mm or rad, see unit", "standard deviation, given or learned"),
        effective=(np.asarray(prior.effective), "1", "how many of its parameters the data determine"),
        supported=(np.asarray(prior.supported, dtype=np.int8), "1", "0: the data support no deviation from the mean"),
    )
    by_parameter = columns(
        "prior_parameter",
        prior_parameter=(list(prior.names), "", "free parameter"),
        mean=(np.asarray(prior.mean), "mm or rad", "mean"),
        weight=(np.asarray(prior.weight), "1/mm or 1/rad", "one over the standard deviation; 0 without a prior"),
    )
    return {"prior": Table(by_group | by_parameter)}


def prior_metrics_of(stored: Stored) -> PriorMetrics | None:
    """The prior of a calibration, from its table."""
    table = stored.tables.get("prior")
    if table is None:
        return None
    return PriorMetrics(
        groups=tuple(map(str, table["prior_group"])),
        learned=tuple(map(bool, table["learned"])),
        units=tuple(map(str, table["unit"])),
        parameters=tuple(map(int, table["parameters"])),
        sd=table["sd"],
        effective=table["effective"],
        supported=table["supported"].astype(bool),
        names=tuple(map(str, table["prior_parameter"])),
        mean=table["mean"],
        weight=table["weight"],
    )
