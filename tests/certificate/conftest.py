"""Calibrations and evaluations, and certificates of every kind made of them."""

import math

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.certificate import dcc_xml
from aacmm_jax.files.administrative_data import AdministrativeData, read_administrative_data
from tests.renamed_sockets import renamed_sockets

CREATED = "2026-03-05T10:11:12+00:00"
KINDS = ("nothing stated", "all stated", "hostile names", "on bounds", "joint", "observations")
# All that can be stated, as people write it.
FULL = """
[laboratory]
name = "Längenlabor <b>&amp; Söhne</b>"
code = "D-K-00000-01-00"
street = "Maßstraße 1"
postal_code = "01234"
city = "Ort"
country = "DE"
email = "a@b.example"
phone = "+49 1"

[customer]
name = "]]> & Co."
country = "FR"

[item]
name = "arm \\"7\\""
manufacturer = "maker"
model = "X'1"
serial_number = "0007"
customer_number = "c <7>"
condition = "worn & dry"

[[person]]
name = "Ada"
role = "head"
main_signer = true

[[person]]
name = "Βύρων"

[certificate]
number = "2026-1"
replaces = "2025-9"
country = "CH"
received = 2026-02-01
begin = 2026-02-02
end = 2026-02-03
issued = 2026-02-04
place = "laboratory"
remarks = "first line\\nsecond line"
temperature_celsius = 20.25
temperature_u_celsius = 0.1

[[reference]]
name = "ball bar"
manufacturer = "maker of bars"
model = "B"
serial_number = "5"
certificate_number = "K 17"

[conformity]
verdict = "conditionalPass"
specification = "house rule 1"
decision_rule = "passes where |E| + U is below 0.05 mm"
"""

HOSTILE = ("<script>alert('1')</script>", 'a]]><b>"&amp;&lt;', "tab\té Ж 測 𝄞", " blank ")


@pytest.fixture(scope="package")
def record(paper_arm) -> aj.calibration.CalibrationRecord:
    """A calibration of an arm that is off, so that nominal and calibrated differ. One of its two lengths is exact."""
    nominal = aj.kinematics.ArmSpecification(paper_arm, "small & fine")
    bounds = nominal.bounds()
    true = bounds.space.arm(np.asarray(bounds.space.vector()) + np.where(bounds.space.lengths, 0.4, 0.001))
    sockets = {"A": (400.0, 200.0, 300.0), "B": (600.0, 200.0, 300.0), "C": (500.0, 400.0, 300.0)}
    lengths = [("A", "B", 0.01), ("B", "C", 0.0)]
    poses = {"A": 40, "B": 3, "C": 1}
    capture = aj.simulate(true, sockets, poses=poses, lengths=lengths, encoder_arcsec=2.0, seating=0.005, seed=1)
    return aj.calibration.record_of(aj.calibrate(paper_arm, capture, bounds), aj.Recording(capture, nominal))


@pytest.fixture(scope="package")
def full(tmp_path_factory) -> AdministrativeData:
    path = tmp_path_factory.mktemp("about") / "about.toml"
    path.write_text(FULL, encoding="utf-8")
    return read_administrative_data(path)


@pytest.fixture(scope="package")
def evaluation(record) -> aj.acceptance.EvaluationRecord:
    """Acceptance tests of new data, with limits that are kept, one that is not decided, and others without."""
    sockets = {"D": (420.0, 220.0, 310.0), "E": (620.0, 180.0, 300.0)}
    true = record.calibrated.arm
    capture = aj.simulate(
        true, sockets, poses={"D": 12, "E": 3}, lengths=[("D", "E", 0.001)], encoder_arcsec=2.0, seed=5
    )
    touched = aj.simulate(true, {"S": (500.0, 300.0, 300.0)}, poses=25, seed=6).sockets["S"]
    sphere = aj.data.ProbedSphere("s & S", "effective-diameter", (touched + np.linspace(0, 0.03, 25)[:, None],), 25.0)
    recording = aj.Recording(capture, record.recording.nominal, spheres=(sphere,))
    warm = aj.acceptance.Influences(u_relative=1e-6, artefact=aj.acceptance.Expansion(11.5e-6, 1e-6, 21.0, 0.2))
    return aj.evaluate_capture(
        record,
        recording,
        limits={"Deltam": 5.0, "E_Uni": 0.05},
        u_test=0.001,
        standards=["jjf", "asme"],
        influences=warm,
    )


@pytest.fixture(scope="package")
def certificates(record, observed_record, full, evaluation) -> dict[str, str]:
    """Certificates of every kind, to be checked against the published rules."""
    uncertain = record.determined.copy()
    uncertain[0] = False
    active = record.active.copy()
    active[1:3] = (-1, 1)
    return {
        "nothing stated": dcc_xml(record, AdministrativeData(), created=CREATED),
        "all stated": dcc_xml(
            record,
            full,
            created=CREATED,
            sources=("a.h5", "<b>.toml"),
            command="aacmm calibrate a.h5",
            evaluation=evaluation,
        ),
        "hostile names": dcc_xml(
            renamed_sockets(record, *HOSTILE[:3]), full.model_copy(update={"conformity": None}), created=CREATED
        ),
        "on bounds": dcc_xml(
            record._replace(determined=uncertain, active=active), AdministrativeData(), created=CREATED
        ),
        "joint": dcc_xml(
            record._replace(method="joint", degrees_of_freedom=math.inf, noise_model="given"),
            AdministrativeData(),
            created=CREATED,
        ),
        "observations": dcc_xml(observed_record, AdministrativeData(), created=CREATED),
    }
