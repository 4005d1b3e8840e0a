"""Studies as objects: equal where they give the same numbers, each with its own provenance, derived once a process."""

import copy
import pickle

import jax
import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.study import configuration_pool
from aacmm_jax.study.definition import Fixture, equal_study
from aacmm_jax.study.specification import Region

COPIES = {
    "deepcopy": copy.deepcopy,
    "copy": copy.copy,
    **{f"pickle {i}": lambda study, i=i: pickle.loads(pickle.dumps(study, protocol=i)) for i in (2, 5)},
}


@pytest.fixture(scope="module")
def studies(paper_arm, noisy_capture) -> list["aj.study.Study"]:
    """Two studies of the same numbers: the same recording and tables, from files of other names."""
    made = aj.study.make_study(arm=paper_arm, trials=4, capture=noisy_capture)
    return [
        aj.study.Study(
            made.specification.model_copy(update={"name": f"study {i}"}),
            made.nominal._replace(name=f"arm {i}"),
            made.recording._replace(sources=(f"{i}.h5",)),
        )
        for i in range(2)
    ]


@pytest.mark.parametrize("way", COPIES)
def test_a_copy_keeps_its_own_provenance(studies, way):
    assert studies[0] == studies[1]
    assert hash(studies[0]) == hash(studies[1])
    for i, study in enumerate(studies):
        found = COPIES[way](study)
        assert (found.specification.name, found.nominal.name) == (f"study {i}", f"arm {i}")
        assert found.recording.sources == (f"{i}.h5",)
        assert found == study
        assert found.digest == study.digest


def test_copies_derive_once(studies):
    """A worker receives the study with every block; what is derived from it is there already."""
    first, second = (equal_study(pickle.loads(pickle.dumps(study))) for study in studies)
    assert first is second
    other = equal_study(pickle.loads(pickle.dumps(aj.study.read_study("noise"))))
    assert other is not first
    assert other != first


@pytest.mark.parametrize(
    ("fixture", "data"),
    [
        (Fixture("S1", 0, ((400.0, 200.0, 300.0),)), (2026694556, 2978688159)),
        (Fixture("L1", 0, None, Region(distance_mm=(1.0, 2.5)), 300.0), (39574185, 1169052133)),
    ],
    ids=["socket", "reference length"],
)
def test_pools_have_the_keys_of_all_versions(fixture, data):
    """Published results were drawn from these keys."""
    key = configuration_pool.pool_key(7, fixture, ((1.0, 2.0),), (3, 4))
    np.testing.assert_array_equal(jax.random.key_data(key), np.array(data, dtype=np.uint32))
