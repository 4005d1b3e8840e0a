"""Where studies come from: tables from Python (`make_study`), TOML files, and those that ship with the package."""

import os
from collections.abc import Mapping
from contextlib import nullcontext
from importlib import resources
from typing import Any

from ..core.errors import InputError, naming, nearest
from ..data.capture import Capture
from ..data.noise import Noise
from ..data.recording import Recording
from ..data.simulation import simulate
from ..files.arms import arm_beside, load_specification
from ..files.captures import load_capture
from ..files.kits import read_kit
from ..files.outputs import as_path, storable
from ..files.toml import read_toml
from ..kinematics.arm import Arm
from ..kinematics.parameters import ArmSpecification
from .definition import Study
from .specification import Specification, checked

_SHIPPED = resources.files("aacmm_jax.study") / "shipped_studies"


def make_study(
    *,
    arm: Arm | ArmSpecification | str | os.PathLike,
    trials: int,
    capture: Capture | Mapping[str, Any],
    seed: int = 0,
    name: str = "",
    **tables: Mapping[str, Any],
) -> Study:
    """Make a study from Python; any value of a table may be a list, and the study is the grid of all lists.

    Args:
        arm: The nominal arm, a shipped name or a file.
        trials: Trials in each cell of the grid.
        capture: A table (``positions_mm``, ``sockets`` with a ``region``, ``file`` or ``kit``), or a `Capture` whose
            configurations are used.
        seed: Seed of all random numbers.
        name: Title in tables and reports.
        **tables: ``deviation``, ``noise``, ``bounds``, ``reference`` and ``identification``, as in TOML; the unit of
            every number is in its name.

    Returns:
        The study, checked but not run.

    Raises:
        InputError: For an unknown table, key or value, naming it.

    Example:
        >>> made = aj.study.make_study(
        ...     arm=arm,
        ...     trials=1000,
        ...     capture={"positions_mm": [[400, 200, 300]], "poses": [20, 70]},
        ...     noise={"encoder_arcsec": [1, 2, 5]},
        ...     identification={"method": "stage1"},
        ... )
        >>> print(len(made.cells), made.factors)
        6 {'capture.poses': [20.0, 70.0], 'noise.encoder_arcsec': [1.0, 2.0, 5.0]}
    """
    if isinstance(capture, Capture):
        nominal = _nominal(arm, capture)
        recording, capture = Recording(capture, nominal), {"file": "(in memory)"}
    elif isinstance(capture, Mapping):
        nominal, recording = _contents(arm, capture.get("file"), capture.get("kit"), seed)
    else:
        raise InputError(
            f"capture is a {type(capture).__name__}; give a table (positions_mm, sockets, file or kit), or a Capture."
        )
    specification = checked(name=storable(name), arm=nominal.name, trials=trials, seed=seed, capture=capture, **tables)
    return Study(specification, nominal, recording)


def shipped_studies() -> tuple[str, ...]:
    """List the studies that ship with the package.

    Returns:
        Their names, in alphabetical order, for `read_study`.

    Example:
        >>> print(aj.study.shipped_studies())
        ('bound-sensitivity', 'joint-models', 'noise', 'pose-count', 'reference-length')
    """
    return tuple(sorted(item.name.removesuffix(".toml") for item in _SHIPPED.iterdir() if item.name.endswith(".toml")))


def read_study(source: str | os.PathLike) -> Study:
    """Read a study.

    Args:
        source: A shipped name (``"bound-sensitivity"``), or a TOML file; the arm and the capture that it names are
            files in the same folder, or ship with the package.

    Returns:
        The study, checked but not run.

    Raises:
        InputError: Naming the file, the key in it, and what to do.

    Example:
        >>> shipped = aj.study.read_study("bound-sensitivity")
        >>> print(len(shipped.cells), shipped.trials)
        20 1000
    """
    shipped = isinstance(source, str) and source in shipped_studies()
    path = as_path(source)
    if not shipped and not os.path.exists(path) and path.suffix != ".toml":
        hint = nearest(str(source), shipped_studies())
        raise InputError(f"'{source}' is neither a file nor a study that ships with the package{hint}")
    with resources.as_file(_SHIPPED / f"{source}.toml") if shipped else nullcontext(path) as path:
        specification = read_toml(path, Specification)
        capture = specification.capture
        if not specification.arm and capture.file is None:
            raise InputError(f"{path}: 'arm' is missing; add it.")
        with naming(path):
            arm = arm_beside(path.parent, specification.arm) if specification.arm else None
            file, kit = (None if name is None else path.parent / name for name in (capture.file, capture.kit))
            return Study(specification, *_contents(arm, file, kit, specification.seed))


def _nominal(arm: Any, capture: Capture | None) -> ArmSpecification:
    if isinstance(arm, Arm):
        return ArmSpecification(arm)
    return arm if isinstance(arm, ArmSpecification) else load_specification(arm, capture=capture)


def _contents(arm: Any, file: Any, kit: Any, seed: int) -> tuple[ArmSpecification, Recording | None]:
    """The nominal arm, by default that of the capture's file; and the capture in the file, or with the kit.

    A kit is simulated with the nominal arm and without noise, which the trials draw.
    """
    recording = None if file is None else load_capture(file)
    if recording is not None and arm is None:
        return recording.nominal, recording
    nominal = _nominal(arm, None if recording is None else recording.capture)
    if recording is None and kit is not None:
        things = [item.simulated for item in read_kit(kit)]
        recording = Recording(simulate(nominal.arm, {}, observations=things, noise=Noise(), seed=seed), nominal)
    return nominal, recording
