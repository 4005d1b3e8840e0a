"""What is said of an uncertainty, from a stored summary: no JAX is imported to show one."""

from collections.abc import Mapping, Sequence
from typing import Any

from ..core.units import DEG, people_read_change
from ..uncertainty.shared_kinds import PLACES, SUCCESSIVE, VISITS


def shared_sentence(rows: Sequence[Mapping[str, Any]]) -> str:
    """Errors that poses share in words."""
    words = {PLACES: "poses of a socket", VISITS: "poses of a visit"}

    def shown(row: Mapping[str, Any]) -> str:
        scale, unit = (1.0, "mm") if row["unit"] == "mm" else people_read_change(row["unit"])
        sd = float(f"{row['sd'] * scale:.3g}")
        return f"{words.get(row['kind'], row['kind'])} {sd:g} {unit}"

    tips = [shown(row) for row in rows if row["kind"] in (PLACES, VISITS, SUCCESSIVE)]
    functions = [shown(row) for row in rows if row["kind"] not in (PLACES, VISITS, SUCCESSIVE)]
    parts = [*tips, *(["functions that the model lacks: " + ", ".join(functions)] if functions else [])]
    return f"Errors that poses share, part of the uncertainty (standard deviations): {'; '.join(parts)}."


def tried_sentence(found: Mapping[str, Any]) -> str:
    """How much of the volume a calibration has tried, in words."""
    percentage = 100 * found["tried"] / found["poses"]
    return (
        f"Of {found['poses']} random poses within the joint limits, {percentage:.2g} % lie as near to a pose of the "
        f"calibration as its poses lie to one another ({found['spacing_rad'] / DEG:.2g} deg RMS over the joints). "
        "Elsewhere the calibration was never tried, and U rests on the model alone."
    )
