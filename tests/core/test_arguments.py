"""What annotations state of arguments: what passes, what a function gets, and the sentences of refusals."""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, NamedTuple

import equinox as eqx
import jax
import numpy as np
import pytest
from jaxtyping import Array, Float

import aacmm_jax as aj
from aacmm_jax.core.arguments import (
    ANY_NUMBER,
    NOT_EMPTY,
    Count,
    Name,
    OneOf,
    Positive,
    Range,
    checked,
    checked_arguments,
    checked_fields,
)
from aacmm_jax.core.numpy_or_jax import AnyArray

from ..refusals import assert_refused


def sphere(
    name: Name,
    q: Annotated[Float[AnyArray, "poses joints"], NOT_EMPTY],
    u: Annotated[Float[AnyArray, ""] | Float[AnyArray, " poses"], Range(least=0)] = 0.0,
    *,
    diameter: Annotated[float, Range(above=0, unit="mm")] = 2.0,
    method: Literal["joint", "two-stage"] | None = None,
    lengths: Sequence[aj.ReferenceLength] = (),
    trials: Count = 100,
    points: Mapping[str, Float[np.ndarray, "3"]] | None = None,
    arm: aj.Arm | aj.Capture | None = None,
    scale: Annotated[float, Range(above=0, most=2)] = 1.0,
    instrument: Annotated[str, OneOf({"tracker": 1})] = "tracker",
    sds: Annotated[Float[AnyArray, "*batch joints"], ANY_NUMBER] | None = None,
    anything: Any = None,
) -> Any:
    return locals()


# The hook of the tests would look at these annotations first, and at the class below: here they are looked at by us.
checked_sphere = checked_arguments(where="sphere '{name}'")(sphere)


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({"name": "S\nT"}, r"name of sphere 'S T' is 'S\nT'; give text of one line."),
        ({"q": [1, 2]}, "q of sphere 'S' has shape (2,); give (poses, joints)."),
        ({"q": np.zeros((0, 2))}, "give at least one."),
        ({"q": [[0.1, 0.2], [0.3, np.nan]]}, "q of sphere 'S' pose 2 joint 2 is nan; give finite numbers."),
        ({"q": [["a", "b"]]}, "q of sphere 'S' must contain real numbers, but contains text."),
        ({"u": [1, 2, 3]}, "u of sphere 'S' has shape (3,); give one number, or (poses,) with 2 poses."),
        ({"u": [1, -1]}, "u[1] of sphere 'S' is -1; it must be zero or positive."),
        ({"u": np.inf}, "u of sphere 'S' is inf; give finite numbers."),
        ({"diameter": -1}, "diameter of sphere 'S' is -1 mm; it must be positive."),
        ({"diameter": np.inf}, "diameter of sphere 'S' is inf mm; it must be positive."),
        ({"diameter": "2"}, "diameter of sphere 'S' is '2'; give a number."),
        ({"method": "jiont"}, "method of sphere 'S' is 'jiont'; did you mean 'joint'?"),
        ({"method": np.zeros(2)}, "method of sphere 'S' is array([0., 0.]); choose one of"),
        ({"lengths": 3}, "lengths of sphere 'S' is 3; give a list."),
        ({"lengths": "AB"}, "lengths of sphere 'S' is 'AB'; give a list."),
        ({"lengths": [3]}, "lengths[0] of sphere 'S' is 3; give a ReferenceLength."),
        ({"trials": 0}, "trials of sphere 'S' is 0; it must be at least 1."),
        ({"trials": True}, "trials of sphere 'S' is True; give a whole number."),
        ({"points": [1]}, "points of sphere 'S' is a list; give a dictionary."),
        ({"points": {"A": [1, 2]}}, "points['A'] of sphere 'S' has shape (2,); give (3,)."),
        ({"arm": 3}, "arm of sphere 'S' is 3; give an Arm or a Capture."),
        ({"scale": 3}, "scale of sphere 'S' is 3; it must be positive and at most 2."),
        ({"instrument": "treker"}, "instrument of sphere 'S' is 'treker'; did you mean 'tracker'?"),
        ({"sds": [[1.0]]}, "sds of sphere 'S' has shape (1, 1); give (*batch, joints) with 2 joints."),
    ],
)
def test_sentences(given, sentence):
    assert_refused(lambda: checked_sphere(**{"name": "S", "q": [[0.1, 0.2], [0.3, 0.4]]} | given), sentence)


def test_what_a_function_gets(paper_arm):
    q = np.ones((2, 6))
    got = checked_sphere("S", q, [1, 2], points={"A": (1, 2, 3)}, arm=paper_arm, sds=np.full((4, 1, 6), np.inf))
    assert got["q"] is not None
    assert isinstance(got["q"], np.ndarray)
    assert isinstance(got["points"]["A"], np.ndarray)
    assert got["u"].dtype == np.float64
    assert got["sds"].shape == (4, 1, 6)
    assert isinstance(checked_sphere("S", q, lengths=iter(()))["lengths"], tuple)
    # Inside jit shapes are checked, and values are not.
    assert np.isnan(jax.jit(lambda q, u: checked_sphere("S", q, u)["q"])(q * np.nan, -1.0)).all()
    assert_refused(lambda: jax.jit(lambda q: checked_sphere("S", q)["q"])(q[0]), "has shape (6,)")


def test_one_value_and_the_sizes_that_it_names():
    sizes: dict[str, int] = {}
    kind = Float[AnyArray, "points 3"]
    assert checked([[1, 2, 3]], kind, "points", sizes).shape == (1, 3)
    assert sizes == {"points": 1}
    assert_refused(
        lambda: checked(np.zeros((2, 3)), kind, "targets", sizes),
        "targets has shape (2, 3); give (points, 3) with 1 point.",
    )


def test_fields():
    class Options(NamedTuple):
        weights: Float[AnyArray, " joints"]
        level: Positive = 0.95

    class Sheet(eqx.Module):
        width: Positive
        corners: Any

        def __check_init__(self) -> None:
            checked_fields(self, "the sheet")

    Sheet.__annotations__["corners"] = Sheet.__dataclass_fields__["corners"].type = Float[Array, "corners 3"] | None
    assert checked_fields(Options([1, 2])).weights.shape == (2,)
    assert_refused(lambda: checked_fields(Options([1], level=0)), "level is 0; it must be positive.")
    assert_refused(lambda: Sheet(0.0, None), "width of the sheet is 0; it must be positive.")
    assert Sheet(1.0, [[1, 2, 3]]).corners.shape == (1, 3)
