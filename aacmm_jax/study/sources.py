"""Where studies come from: tables from Python (`make_study`), TOML files, and those that ship with the package."""

import os
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

from ..core.errors import InputError, nearest
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

_TABLES = ("deviation", "noise", "bounds", "reference", "identification")


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
    for key in tables:
        if key not in _TABLES:
            raise InputError(f"a study has no table '{key}'{nearest(key, _TABLES)}")
    if not isinstance(capture, Capture | Mapping):
        raise InputError(
            f"capture is a {type(capture).__name__}; give a table (positions_mm, sockets, file or kit), or a Capture."
        )
    recording, observed = None, capture if isinstance(capture, Capture) else None
    if isinstance(capture, Mapping) and capture.get("file") is not None:
        recording = load_capture(capture["file"])
        observed = recording.capture
    if isinstance(arm, Arm):
        nominal = ArmSpecification(arm)
    else:
        nominal = arm if isinstance(arm, ArmSpecification) else load_specification(arm, capture=observed)
    if isinstance(capture, Capture):
        recording, capture = Recording(capture, nominal), {"file": "(in memory)"}
    elif capture.get("kit") is not None:
        recording = _simulated(capture["kit"], nominal, seed)
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
    return tuple(
        sorted(item.name.removesuffix(".toml") for item in _shipped().iterdir() if item.name.endswith(".toml"))
    )


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
    if isinstance(source, str) and source in shipped_studies():
        with resources.as_file(_shipped() / f"{source}.toml") as path:
            return _study_of_file(path)
    path = as_path(source)
    if not os.path.exists(path) and path.suffix != ".toml":
        known = nearest(str(source), shipped_studies())
        raise InputError(f"'{source}' is neither a file nor a study that ships with the package{known}")
    return _study_of_file(path)


def _shipped() -> Any:
    return resources.files("aacmm_jax.study") / "shipped_studies"


def _study_of_file(path: Path) -> Study:
    specification = read_toml(path, Specification)
    if not specification.arm and specification.capture.file is None:
        raise InputError(f"{path}: 'arm' is missing; add it.")
    try:
        recording = None
        if specification.capture.file is not None:
            recording = load_capture(path.parent / specification.capture.file)
        if recording is not None and not specification.arm:
            return Study(specification, recording.nominal, recording)
        observed = None if recording is None else recording.capture
        nominal = load_specification(arm_beside(path.parent, specification.arm), capture=observed)
        if specification.capture.kit is not None:
            recording = _simulated(path.parent / specification.capture.kit, nominal, specification.seed)
        return Study(specification, nominal, recording)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _simulated(kit: str | os.PathLike, nominal: ArmSpecification, seed: int) -> Recording:
    """A capture of the nominal arm with a kit, without noise, which the trials draw."""
    things = [item.simulated for item in read_kit(kit)]
    return Recording(simulate(nominal.arm, {}, observations=things, noise=Noise(), seed=seed), nominal)
