"""Standard uncertainties that were stated too large: values that agree far better than they would with errors of that
size.

One that is stated too small is seen only where something else sets the level of the noise: by reference lengths and
certified values, which then disagree (`scale`), and by orientations beside positions (`culprits`). Elsewhere the
estimated noise makes up for it.
"""

import numpy as np

from ..core.text import shorten
from ..data.observations.observation import stated_u
from .findings import Case, Finding
from .residual_tests import SURE, form_test
from .scale import lengths_of

ORDER, NEEDS = 61, "fit"
_CLEAR = 2.0  # times as large as residuals show: less is no mistake


def test(case: Case) -> list[Finding]:
    """Of what instruments measured, and of reference lengths and certified values together."""
    too_large = [*_of_instruments(case), *_of_certified(case)]
    if not too_large:
        return []
    names, ratios = zip(*too_large, strict=True)
    texts = [f"{name} ({1 / ratio:.2g} times)" for name, ratio in too_large]
    return [
        Finding(
            "u-too-large",
            f"The stated u is too large: {shorten(texts)}.",
            "U is larger than necessary, and these values have too little weight.",
            "State a standard uncertainty, not a maximum error or the resolution.",
            concerns=tuple(names),
            explains=1 - max(ratios) ** 2,  # of what is missing to the expected sum of squares
        )
    ]


def _of_instruments(case: Case) -> list[tuple[str, float]]:
    """Observations of which residuals are smaller than the u of what was measured, and by which factor."""
    record = case.record
    measured = [o.name for o in record.recording.capture.observations if len(stated_u(o))]
    if not case.shows_noise or record.given_noise is not None or not measured:
        return []
    rows, found = case.chunks[0], []
    for name in measured:
        sizes = [part.residual.shape if part.name == name else None for part in rows]
        of_name = [part for part in rows if part.name == name]
        # By the stated u alone, since an observation beside it may have raised the noise of the arm.
        if _CLEAR**2 * sum(np.sum(part.residual**2) for part in of_name) > sum(np.sum(x.measured**2) for x in of_name):
            continue
        kernels = [None if size is None else np.broadcast_to(np.eye(size[1]), (*size, size[1])) for size in sizes]
        form = form_test(case.left, kernels, relative=False)
        if (1 - form.probability) * len(measured) < SURE and form.ratio * _CLEAR**2 < 1:
            found.append((name, float(np.sqrt(max(form.ratio, 1e-12)))))
    return found


def _of_certified(case: Case) -> list[tuple[str, float]]:
    """The same of reference lengths and certified values, which the poses compare with each other."""
    lengths = case.once(lengths_of) if case.scatters else None
    if lengths is None or lengths.smaller >= SURE or lengths.by_u * _CLEAR > 1:
        return []
    capture = case.record.recording.capture
    names = ["reference lengths"] if capture.lengths else []
    names += [o.name for o in capture.observations if o.certified]
    return [(shorten(list(dict.fromkeys(names)), 3), max(lengths.by_u, 1e-6))]
