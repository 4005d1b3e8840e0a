"""What a certificate does not state although it could."""

import pytest

from aacmm_jax.certificate import dcc_xml
from aacmm_jax.certificate.unstated import unstated
from aacmm_jax.files.administrative_data import AdministrativeData, Reference
from tests.certificate.conftest import CREATED


@pytest.mark.slow
def test_what_a_certificate_could_state_is_listed(record, full, evaluation):
    def sentences(about, tested):
        return unstated(dcc_xml(record, about, created=CREATED, evaluation=tested), about)

    none, (conformity, keys) = AdministrativeData(), sentences(AdministrativeData(), evaluation)
    assert conformity.startswith("No statement of conformity: ")
    assert keys.startswith("Not stated: laboratory.name, ")
    for key in ("item.manufacturer", "item.condition", "certificate.number", "certificate.issued", "certificate.place"):
        assert f"{key}, " in keys
    assert sentences(none, None) == sentences(none, evaluation._replace(limits={})) == [keys]
    simulated = evaluation._replace(recording=evaluation.recording._replace(true=record.calibrated))
    assert sentences(none, simulated) == [keys]  # which cannot conform
    customer = full.customer.model_copy(update={"city": "Ville"})
    reference = [Reference(name="bar", lengths=["*"])]
    whole = full.model_copy(update={"customer": customer, "reference": reference})
    assert sentences(whole, evaluation) == []
    part = whole.model_copy(update={"reference": [Reference(name="plate", lengths=["A - B"])]})
    assert sentences(part, evaluation) == ["Not stated: reference.lengths (--about)."]
