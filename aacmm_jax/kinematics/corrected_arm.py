"""An arm with joint corrections: coefficients of known functions of the readings, 0 until they are calibrated."""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from ..core.arguments import checked
from ..core.arrays import Numbers
from ..core.errors import InputError
from ..core.linear_algebra import independent_columns
from ..core.numpy_or_jax import namespace, to_numpy
from .arm import DOWN, Arm, correction_names, is_single, joint_limits, without_corrections
from .beside import ALL
from .chain import Corrections, Geometry, KnownFunctions, forward_pass, joint_motion, joints_first, of_joints
from .correction_kinds import KILO, Loads, Term
from .corrections import REGISTER, term_of, terms_of
from .recorded_kinds import Torque

_CONFIGURATIONS = 300
_INDEPENDENT = 1e-6  # of a function's size: what must be left of it beside the constant and those before it


def with_corrections(
    arm: Arm,
    model: str | Iterable[str],
    *,
    mass: Numbers | None = None,
    centre: Numbers | None = None,
    gravity: Numbers = DOWN,
) -> Arm:
    """The same arm with corrections, whose coefficients are 0: it moves as before, and has more parameters.

    The functions are evaluated on the frames of this arm, also when its parameters change later. A model leaves out
    functions that are constant, or combinations of others of the same joint, within the limits of the joints (gravity
    about a vertical axis, for instance), and those of fixed joints. `InputError` where something in the model is
    unknown, or numbers do not fit the arm.

    Args:
        arm: The nominal arm; corrections that it has are replaced.
        model: What the joints do: "gravity,harmonics=1" (kinds of corrections, see `kinematics.corrections`), or names
            of coefficients, such as ``["cos1_2", "sin1_2", "compliance3_2"]``, all of which are taken.
        mass: Mass of each link ``(n,)``, kg, for ``gravity=masses`` and ``compliance_2`` alone; by default unknown.
        centre: Centre of mass of each link in its D-H frame ``(n, 3)``, mm.
        gravity: Direction of gravity in the base frame ``(3,)``.

    Example:
        >>> eccentric = aj.kinematics.with_corrections(arm, "harmonics=1")
        >>> print(len(eccentric.coefficients), aj.kinematics.parameter_names(eccentric)[-2:])
        12 ('cos1_6', 'sin1_6')
    """
    if not is_single(arm):
        raise InputError("corrections need a single arm, but this is a batch; select one arm of the batch.")
    plain: Arm = to_numpy(without_corrections(arm))
    down = checked(gravity, Float[np.ndarray, "3"], "gravity")
    if not np.any(down):
        raise InputError("gravity has the length 0; give its direction in the base frame.")
    down, loads, sizes = down / np.linalg.norm(down), None, {"links": plain.joints}
    if (mass is None) != (centre is None):
        raise InputError("mass and centre (the centres of mass) are only possible together; give both or neither.")
    if mass is not None:
        masses = checked(mass, Float[np.ndarray, " links"], "mass", sizes)
        centres = checked(centre, Float[np.ndarray, "links 3"], "centre", sizes)
        loads = Loads(tuple(masses.tolist()), tuple(map(tuple, centres.tolist())))
    if isinstance(model, str):
        moving = [term for term in terms_of(model, plain.joints, loads) if term.joint not in plain.fixed]
        terms = _determined(plain, moving, down)
    else:
        by_name = {name: term_of(name, plain.joints, loads) for name in checked(model, Iterable[str], "model")}
        for name, term in by_name.items():
            if term is None:
                raise InputError(
                    f"'{name}' is not the name of a coefficient; give a name such as cos1_2, or a model; or {REGISTER}."
                )
            if term.takes_masses and term.kind.rows == 3 and loads is None:
                raise InputError(
                    f"'{name}' needs the masses of the links; give mass and centre, or name one of a link."
                )
        terms = tuple(dict.fromkeys(term for term in by_name.values() if term is not None))
    if not terms:
        return plain
    return plain.replace(corrections=Corrections(KnownFunctions(terms), plain.geometry), gravity=down)


def _determined(arm: Arm, terms: Sequence[Term], gravity: Float[np.ndarray, " 3"]) -> tuple[Term, ...]:
    """The terms whose functions are no combination of a constant and of those before them, joint by joint."""
    if not terms:
        return ()
    beside, random = replace(arm.beside, recorded=ALL, possible=ALL), np.random.default_rng(0)
    low, high = joint_limits(arm, None).T
    q = random.uniform(low, high, (_CONFIGURATIONS, arm.joints))
    q = np.hstack([q, beside.drawn(_CONFIGURATIONS, random)])
    values, chosen = _values(arm.geometry._replace(beside=beside), terms, q, gravity), []
    constant = np.full((_CONFIGURATIONS, 1), _CONFIGURATIONS**-0.5)
    for joint in range(arm.joints + 1):  # 0: functions that scale all lengths
        numbers = np.array([number for number, term in enumerate(terms) if term.joint == joint], dtype=int)
        least = _INDEPENDENT * np.maximum(np.linalg.norm(values[numbers], axis=1), 1e-6)
        chosen += numbers[independent_columns(values[numbers].T, least, constant)].tolist()
    return tuple(terms[number] for number in sorted(chosen))


def function_values(arm: Arm, terms: Sequence[Term], q: Float[np.ndarray, "N columns"]) -> Float[np.ndarray, "k N"]:
    """The function of each term at N configurations, in units of its coefficient's effect (rad, or mm): on the frames
    of the nominal arm of its corrections, or of the arm itself where it has none."""
    nominal = arm.geometry if arm.corrections is None else arm.corrections.nominal
    gravity = np.asarray(DOWN if arm.gravity is None else arm.gravity)
    return _values(nominal._replace(beside=arm.beside), terms, q, gravity)


def _values(
    nominal: Geometry, terms: Sequence[Term], q: Float[np.ndarray, "N columns"], gravity: Float[np.ndarray, " 3"]
) -> Float[np.ndarray, "k N"]:
    assert nominal.beside is not None
    functions, readings = KnownFunctions(tuple(terms)), nominal.beside.split(joints_first(q, 1))
    readings = readings._replace(joints=of_joints(nominal, joints_first(q, 1)))
    rows = functions.values(readings, forward_pass(nominal, joint_motion(nominal, q)))[:, 0]
    weight = np.concatenate([gravity if by_gravity else [1.0] for by_gravity in functions.by_gravity])
    return np.add.reduceat(weight[:, None] * rows, functions.first_row)


def corrected_like(corrected: Arm, arm: Arm) -> Arm:
    """An arm of other parameters with the corrections of a corrected one, and their functions on its nominal arm."""
    return arm.replace(**{kind: getattr(corrected, kind) for kind in ("corrections", "coefficients", "gravity")})


def with_further_corrections(arm: Arm, names: Sequence[str]) -> Arm:
    """The same arm with more corrections than it has, by the names of their coefficients, which are 0."""
    added = tuple(term for term in (term_of(name, arm.joints) for name in names) if term is not None)
    if not added:
        return arm
    if arm.corrections is None:
        return arm.replace(corrections=Corrections(KnownFunctions(added), arm.geometry), gravity=np.array(DOWN))
    assert arm.coefficients is not None
    functions = KnownFunctions((*arm.corrections.functions.terms, *added))
    coefficients = namespace(arm.coefficients).concatenate([arm.coefficients, np.zeros(len(added))])
    return arm.replace(corrections=arm.corrections._replace(functions=functions), coefficients=coefficients)


def with_couplings_of(coupled: Arm, arm: Arm) -> Arm:
    """An arm with the full couplings of another one of its joints (`chain.full_couplings`), with their coefficients."""
    if coupled.corrections is None:
        return arm
    assert coupled.coefficients is not None
    functions = coupled.corrections.functions
    numbers = [number for number, _, _ in functions.couplings]
    values = {functions.names[i]: coupled.coefficients[i] for i in numbers if np.round(coupled.coefficients[i])}
    missing = [name for name in values if name not in correction_names(arm)]
    return with_further_corrections(arm, missing).replace(**values) if values else arm


def holding_torques(arm: Arm, q: Float[np.ndarray, "N n"]) -> Float[np.ndarray, "N n"]:
    """Torques of the drives that hold an arm of known masses at readings ``(N, n)``, N m.

    `InputError` where the masses are unknown.
    """
    loads = None if arm.corrections is None else loads_of(arm)
    if arm.corrections is None or loads is None:
        raise InputError(
            "the torques of poses that were not recorded follow from masses, but the masses are unknown; create the "
            "arm by with_corrections(arm, 'torque', mass=..., centre=...), or without torques."
        )
    upright = arm.replace(gravity=DOWN)
    return function_values(upright, Torque().terms(arm.joints, "", loads), q[:, : arm.joints]).T / KILO


def loads_of(arm: Arm) -> Loads | None:
    """Masses and centres of the links, where functions of an arm's corrections know them."""
    assert arm.corrections is not None
    return next((term.loads for term in arm.corrections.functions.terms if term.loads is not None), None)
