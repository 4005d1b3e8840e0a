"""A new kind of joint correction is one class: this one goes the whole way, and the package has never heard of it."""

import re
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import TypeCheckError

import aacmm_jax as aj
from aacmm_jax.certificate.parameter_results import in_d_si
from aacmm_jax.cli import views
from aacmm_jax.cli.display import display
from aacmm_jax.diagnostics.model_errors import model_tests
from aacmm_jax.diagnostics.shared_errors import missing_functions
from aacmm_jax.files.arm_tables import prior_of_text, with_model
from aacmm_jax.kinematics import AbstractCorrection, Sought, default_prior, register_correction, with_corrections
from aacmm_jax.kinematics import corrections as kinds
from aacmm_jax.kinematics.arm import correction_names
from aacmm_jax.report import write_report
from aacmm_jax.summaries.calibration import arm_summary

from ..own_kinds import forgotten_kinds

BOW = 2e-4  # 1/rad


class Bow(AbstractCorrection):
    """A scale whose error grows with the square of the reading."""

    model: ClassVar[str] = "bow"
    words: ClassVar[tuple[str, ...]] = ("bow",)
    description: ClassVar[str] = "bows of scales"
    unit: ClassVar[str] = "1/rad"
    usual_size: ClassVar[float] = 1e-4
    of_own_reading: ClassVar[bool] = True
    sought: ClassVar[tuple[Sought, ...]] = (Sought("bow", "", "the square of q_{i}", "a bent scale"),)
    shared: ClassVar[str | None] = ""

    def values(self, terms, q, forward):
        return q.joints[np.array([term.joint - 1 for term in terms])] ** 2


@pytest.fixture(scope="module", autouse=True)
def bow():
    with forgotten_kinds():
        register_correction(Bow)
        yield


@pytest.fixture(scope="module")
def captured(paper_arm):
    """Sockets of an arm whose second joint has a bow."""
    places = {"A": (400, 200, 300), "B": (600, 200, 300), "C": (300, -300, 300)}
    capture = aj.simulate(
        with_corrections(paper_arm, ["bow_2"]).replace(bow_2=BOW),
        *(places,),
        poses=25,
        lengths=[("A", "B", 0.002), ("A", "C", 0.002)],
        encoder_arcsec=2.0,
        seating=0.005,
        seed=1,
    )
    return capture


@pytest.fixture(scope="module")
def nominal(paper_arm):
    return aj.kinematics.ArmSpecification(with_corrections(paper_arm, ["bow_2"]), "bent")


@pytest.fixture(scope="module")
def record(captured, nominal):
    result = aj.calibrate(nominal.arm, captured, nominal.bounds(), method="joint", undetermined="ignore")
    return aj.calibration.record_of(result, aj.Recording(captured, nominal))


def test_a_calibration_finds_it(record):
    at = record.names.index("bow_2")
    value, u = record.vectors()["calibrated"][at], np.sqrt(record.covariance[at, at])
    assert abs(value - BOW) < 4 * u < BOW


@pytest.mark.slow
def test_residuals_without_it_name_it(paper_arm, captured):
    space = aj.Parameters.free_of(paper_arm)
    bounds = aj.Bounds.around(paper_arm, space, length=5.0, angle=0.01)
    result = aj.calibrate(paper_arm, captured, bounds, method="joint", undetermined="ignore")
    assert ("bow", 2) in {(term.kind, term.joint) for term in model_tests(result, captured).terms}
    (sentence,) = (text for text in aj.warnings_of(result, captured) if text.startswith("Residuals follow"))
    assert "a bent scale" in sentence
    assert "try --model dh,bow" in sentence
    assert result.shared is not None
    assert "bow" in result.shared.kinds


def test_it_is_among_what_poses_may_share(paper_arm):
    assert "bow_3" in missing_functions(paper_arm)
    assert "bow" in default_prior(with_corrections(paper_arm, "bow")).groups


@pytest.mark.slow
def test_it_is_stored_and_reported(record, tmp_path):
    aj.files.save_calibration(tmp_path / "bent.h5", record)
    with forgotten_kinds():
        del kinds.KINDS["bow"]
        kinds.coefficient_of.cache_clear()
        with pytest.raises(aj.InputError, match=r"'bow_2' is not .*; or register a kind of your own first"):
            aj.files.load_calibration(tmp_path / "bent.h5")
    again = aj.files.load_calibration(tmp_path / "bent.h5")
    assert again.names == record.names
    assert correction_names(again.calibrated.arm) == ("bow_2",)
    write_report(tmp_path / "bent.h5", tmp_path / "bent.html")
    page = (tmp_path / "bent.html").read_text()
    assert ">bow_2<" in page
    assert "bows of scales" in page


def test_its_prior_is_stated_in_words(nominal):
    prior = prior_of_text("bow=0.0003/rad", nominal.arm)
    assert prior is not None
    assert float(prior.sd["bow"]) == 3e-4


def test_certificates_have_its_unit():
    assert in_d_si("1/rad") == r"\radian\tothe{-1}"


@pytest.mark.slow
def test_models_with_it_are_compared(paper_arm, captured):
    compared = aj.compare_models(paper_arm, captured, models=["dh", "bow"])
    assert compared.recommended.model == "bow"


def test_the_arm_is_shown_with_it(capsys):
    specification = with_model(aj.files.load_specification("cheng2018-simulation"), "dh,bow")
    display(views.arm(arm_summary(specification)))
    assert "6 coefficients, bows of scales (bow_1, bow_2" in " ".join(capsys.readouterr().out.split())


@pytest.mark.exhaustive
def test_the_command_line_takes_it(aacmm):
    assert "bows of scales" in " ".join(aacmm("arm", "cheng2018-simulation", "--model", "dh,bow").stdout.split())


def test_a_class_of_the_same_model_takes_its_place(paper_arm):
    """As where a cell of a notebook is run again; derivatives are those of the new functions."""
    bent = with_corrections(paper_arm, ["bow_2"]).replace(bow_2=BOW)
    q, tip = jnp.full(6, 0.5), jax.jit(lambda arm, q: arm.position(q))
    before = tip(bent, q)

    class Cubic(Bow):
        def values(self, terms, q, forward):
            return q.joints[np.array([term.joint - 1 for term in terms])] ** 3

    with forgotten_kinds():
        register_correction(Cubic)
        again = with_corrections(paper_arm, ["bow_2"]).replace(bow_2=2 * BOW)
        np.testing.assert_allclose(tip(bent, q), before, atol=1e-12)
        np.testing.assert_allclose(tip(again, q), before, atol=1e-12)  # 0.5^2 BOW = 0.5^3 2 BOW
        assert not np.allclose(tip(again, 2 * q), tip(bent, 2 * q), atol=1e-6)


WRONG = {
    "lacks usual_size, values": {"usual_size": None, "values": None},
    "the package has a correction 'gear'": {"model": "gear"},
    "uses the name 'cos'": {"words": ("cos",)},
    "uses the name 'theta'": {"words": ("theta",)},
    "uses the name 'all'": {"model": "all"},
    "has the name 'my_bow'": {"model": "my_bow"},
    "give a tuple such as ('arch',)": {"words": "arch"},
    "the unit of the correction Own is 'mrad'": {"unit": "mrad"},
    "usual_size of the correction Own is 0": {"usual_size": 0},
}


@pytest.mark.parametrize("says", WRONG)
def test_what_a_class_lacks_is_said(says):
    stated = {"model": "arch", "words": ("arch",), "description": "arches", "unit": "rad", "usual_size": 1e-4}
    stated |= {"values": Bow.values} | WRONG[says]
    kind = type("Own", (AbstractCorrection,), {name: value for name, value in stated.items() if value is not None})
    with pytest.raises(aj.InputError, match=re.escape(says)):
        register_correction(kind)
    assert "arch" not in kinds.KINDS


def test_what_is_registered_is_a_class():
    with pytest.raises((aj.InputError, TypeCheckError), match=r"Bow\(\)"):  # the latter where types are checked
        register_correction(Bow())  # pyright: ignore[reportArgumentType]


def test_certificates_know_every_unit():
    assert all(in_d_si(unit) for unit in kinds.UNITS)


@pytest.mark.parametrize(
    "model", ["dh", "dh,gravity", "dh,gear,harmonics=1-3+8", "dh,harmonics", "dh,coupled=2-3", "dh,expansion,bow"]
)
def test_the_model_of_terms(model):
    assert kinds.model_of(kinds.terms_of(model, 6)) == model
