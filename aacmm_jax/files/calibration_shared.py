"""What files hold of errors that poses share, and of the parts of a covariance."""

from collections.abc import Mapping

import numpy as np

from ..uncertainty.degrees_of_freedom import Components, Law
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
    by_kind |= _law_variables("shared_kind", shared.law)
    follow, moments, added = np.asarray(shared.follow), np.asarray(shared.moments), np.asarray(shared.added)
    names = list(shared.names)
    by_coefficient = numbering("shared_parameter", len(follow), "free parameter, by its number")
    if len(added):
        by_coefficient |= numbering("tip_kind", len(added), "kind that moves the tips of poses, by its number")
        by_coefficient |= numbering("shared_parameter_2", len(follow), "free parameter, second axis")
        by_coefficient["added"] = Variable(
            ("tip_kind", "shared_parameter", "shared_parameter_2"), added, "products of units", "part of the covariance"
        )
    if names:
        by_group = np.asarray(shared.by_group)
        by_coefficient |= columns("coefficient", coefficient=(names, "", "coefficient of a function"))
        by_coefficient |= columns("coefficient_2", coefficient_2=(names, "", "coefficient, second axis"))
        by_coefficient |= numbering("function_kind", len(by_group), "kind of functions, by its number")
        by_coefficient["moments"] = Variable(
            ("coefficient", "coefficient_2"), moments, "products of units", "second moments of the coefficients about 0"
        )
        by_coefficient["by_group"] = Variable(
            ("function_kind", "coefficient", "coefficient_2"), by_group, "products of units",
            "derivatives of the moments by the logarithm of each kind's variance",
        )  # fmt: skip
        by_coefficient["follow"] = Variable(
            ("shared_parameter", "coefficient"), follow, "quotients of units", "derivatives of the parameters"
        )
    return {"shared_errors": Table(by_kind | by_coefficient, {"correlation_length": float(shared.correlation_length)})}


def shared_errors_of(stored: Stored) -> SharedErrors | None:
    """What `shared_tables` wrote; None where nothing was found. A file of an earlier version does not say how well the
    variances are known, which then count as exact."""
    table = stored.tables.get("shared_errors")
    if table is None:
        return None
    parameters, kinds = len(table["shared_parameter"]), tuple(map(str, table["shared_kind"]))
    coefficients = len(table.get("coefficient", ()))
    none = np.zeros(
        (sum(unit == "mm" for unit in map(str, table["unit"])) if "ratio" not in table else 0, *(parameters,) * 2)
    )
    added = table.get("added", none)
    return SharedErrors(
        kinds=kinds,
        units=tuple(map(str, table["unit"])),
        names=tuple(map(str, table.get("coefficient", ()))),
        sd=table["sd"],
        moments=table.get("moments", np.zeros((0, 0))),
        follow=table.get("follow", np.zeros((parameters, 0))),
        correlation_length=np.asarray(stored.table_attributes["shared_errors"]["correlation_length"]),
        added=added,
        by_group=table.get("by_group", np.zeros((len(kinds) - len(added), *(coefficients,) * 2))),
        law=_law_of(table, len(kinds)),
    )


def component_tables(components: Components | None) -> dict[str, Table]:
    """The table of the parts of the covariance that do not rest on the scatter of single poses."""
    if components is None:
        return {}
    matrices = np.asarray(components.matrices)
    variables = columns("component", component=(list(components.names), "", "what a part of the covariance rests on"))
    variables |= _law_variables("component", components.law)
    for number in ("", "_2"):
        name = f"component_parameter{number}"
        variables |= numbering(name, matrices.shape[1], "free parameter, by its number")
    dimensions = ("component", "component_parameter", "component_parameter_2")
    variables["part"] = Variable(dimensions, matrices, "products of units", "part of the covariance")
    return {"components": Table(variables, {})}


def components_of(stored: Stored) -> Components | None:
    """What `component_tables` wrote; None without, as in files of earlier versions."""
    table = stored.tables.get("components")
    if table is None:
        return None
    names = tuple(map(str, table["component"]))
    return Components(names, table["part"], _law_of(table, len(names)))


def _law_variables(dimension: str, law: Law) -> dict[str, Variable]:
    possible = f"{dimension}_variance"
    ratios, weights = np.asarray(law.ratios), np.asarray(law.weights)
    found = columns(dimension, degrees_of_freedom=(np.asarray(law.degrees_of_freedom), "1", "of the variance"))
    found |= numbering(possible, ratios.shape[1], "a possible variance, by its number")
    found["ratio"] = Variable((dimension, possible), ratios, "1", "possible variances over the stated one")
    found["weight"] = Variable((dimension, possible), weights, "1", "their probabilities")
    return found


def _law_of(table: Mapping[str, np.ndarray], size: int) -> Law:
    one = np.ones((size, 1))
    exact = np.full(size, np.inf)
    return Law(table.get("degrees_of_freedom", exact), table.get("ratio", one), table.get("weight", one))
