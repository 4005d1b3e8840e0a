"""Parameters that ended on a bound, because the bound is too narrow or because the data hardly determine them."""

from ..core.text import shorten
from .determined import determined
from .findings import Case, Finding
from .usability import is_anchored, many_on_bounds, on_bounds

ORDER, NEEDS = 85, "fit"


def test(case: Case) -> list[Finding]:
    """Those that the data hardly determine apart from the others, since wider bounds do not help them."""
    record = case.record
    # Without an anchor all lengths slide to bounds in stage 1, which the scale fix undoes.
    sides = on_bounds(record, final=True) | (on_bounds(record) if is_anchored(record) else {})
    if not sides or many_on_bounds(record):
        return []
    traded = {name for trade_off in case.once(determined).trade_offs for name in trade_off.names}
    findings = []
    for code, weak in (("weak-on-bounds", True), ("on-bounds", False)):
        names = [name for name in sides if (name in traded) == weak]
        if not names:
            continue
        texts = shorten([f"{name} ({sides[name]})" for name in names])
        finding = (
            Finding(
                code,
                f"On a bound because the data hardly determine them: {texts}.",
                "The width of the bounds is part of their uncertainties.",
                "Fix one parameter of each combination named below (--held), and do not widen the bounds.",
            )
            if weak
            else Finding(
                code,
                f"On a bound: {texts}.",
                "Every uncertainty, that of k too, takes these values as exact.",
                "Widen the bounds unless they are known limits.",
            )
        )
        doubt = f"on a bound: {shorten(sorted(names), 3)}"
        findings.append(finding._replace(severity="doubt", doubt=doubt, concerns=tuple(names)))
    return findings
