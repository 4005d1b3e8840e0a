"""The kinds of observations that files may hold, by their names."""

from .. import data
from ..data.observations.observation import AbstractObservation


def kinds() -> dict[str, type[AbstractObservation]]:
    """Every kind of observations by its name."""
    found = (getattr(data.observations, name) for name in dir(data.observations))
    return {one.kind: one for one in found if isinstance(one, type) and issubclass(one, AbstractObservation)}
