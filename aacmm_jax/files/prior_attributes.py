"""What HDF5 keeps of the prior that an arm's file states."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..kinematics.priors import Prior
from .hdf5 import names_in


def attributes_of_prior(prior: Prior | None) -> dict[str, Any]:
    """What an arm's table keeps of its prior."""
    if prior is None:
        return {}
    # A group that is neither learned nor has a standard deviation is one of which nothing is known.
    sd = [float(prior.sd[group]) if group in prior.sd else np.inf for group in prior.groups]
    return {
        "prior_groups": list(prior.groups),
        "prior_sd": sd,
        "prior_learned": [group for group, learned in zip(prior.groups, prior.learned, strict=True) if learned] or None,
        "prior_mean_of": list(prior.mean) or None,
        "prior_mean": [float(value) for value in prior.mean.values()] or None,
    }


def prior_of_attributes(attributes: Mapping[str, Any]) -> Prior | None:
    """The prior that an arm's table keeps."""
    groups = names_in(attributes.get("prior_groups"))
    if not groups:
        return None
    sd = dict(zip(groups, np.atleast_1d(attributes["prior_sd"]).tolist(), strict=True))
    means = names_in(attributes.get("prior_mean_of"))
    mean = dict(zip(means, np.atleast_1d(attributes.get("prior_mean") or []).tolist(), strict=True))
    return Prior(sd, mean=mean, learn=names_in(attributes.get("prior_learned")))
