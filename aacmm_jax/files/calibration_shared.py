"""What files hold of errors that poses share."""

import numpy as np

from ..uncertainty.shared_errors import SharedErrors
from .hdf5 import Stored, Table, Variable, columns, numbering


def shared_tables(shared: SharedErrors | None) -> dict[str, Table]:
    """The table of the errors that poses share: by kind, and by coefficient of the functions that the model lacks."""
    if shared is None:
        return {}
    by_kind = columns(
        "shared_kind",
        shared_kind=(list(shared.kinds), "", "what poses share"),
        unit=(list(shared.units), "", "unit of its standard deviation"),
        sd=(np.asarray(shared.sd), "mm or rad, see unit", "standard deviation, learned from the residuals"),
    )
    follow, moments = np.asarray(shared.follow), np.asarray(shared.moments)
    names = list(shared.names)
    by_coefficient = numbering("shared_parameter", len(follow), "free parameter, by its number")
    if names:
        by_coefficient |= columns("coefficient", coefficient=(names, "", "coefficient of a function"))
        by_coefficient |= columns("coefficient_2", coefficient_2=(names, "", "coefficient, second axis"))
        by_coefficient["moments"] = Variable(
            ("coefficient", "coefficient_2"), moments, "products of units", "second moments of the coefficients about 0"
        )
        by_coefficient["follow"] = Variable(
            ("shared_parameter", "coefficient"), follow, "quotients of units", "derivatives of the parameters"
        )
    return {"shared_errors": Table(by_kind | by_coefficient, {"correlation_length": float(shared.correlation_length)})}


def shared_errors_of(stored: Stored) -> SharedErrors | None:
    """What `shared_tables` wrote; None where nothing was found, or in a file of an earlier version."""
    table = stored.tables.get("shared_errors")
    if table is None:
        return None
    parameters = len(table["shared_parameter"])
    return SharedErrors(
        kinds=tuple(map(str, table["shared_kind"])),
        units=tuple(map(str, table["unit"])),
        names=tuple(map(str, table.get("coefficient", ()))),
        sd=table["sd"],
        moments=table.get("moments", np.zeros((0, 0))),
        follow=table.get("follow", np.zeros((parameters, 0))),
        correlation_length=np.asarray(stored.table_attributes["shared_errors"]["correlation_length"]),
    )
