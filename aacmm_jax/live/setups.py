"""What is measured live, from files: a kit, or the manifest and the table of a plan as ``aacmm plan`` writes them."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..core.errors import InputError, naming
from ..core.numpy_or_jax import to_numpy
from ..core.rotations import fitted_frame
from ..core.units import DEG
from ..data.observations.held import SimulatedArtefact, SimulatedSocket
from ..data.observations.measured import SimulatedDistances, SimulatedPoints
from ..data.observations.simulated import AbstractSimulated
from ..data.simulation import simulate
from ..files.arms import for_capture, load_noise, load_specification
from ..files.inputs import InputFile
from ..files.kits import kit_lengths, kit_targets, read_kit
from ..files.manifest_tables import PosesManifest
from ..files.text_table import TextTable
from ..files.toml import read_toml
from ..kinematics.arm import Arm, by_joint
from ..kinematics.parameters import ArmSpecification
from ..planning.kit_placement import KitItem
from .places import Setup, setup_of

_OTHERS = "give the kit itself with --kit"


def read_setup(
    arm: str | os.PathLike,
    *,
    plan: str | os.PathLike | None = None,
    kit: str | os.PathLike | None = None,
    base: str | None = None,
    tip: str | Sequence[str] | None = None,
) -> Setup:
    """The arm and the places of a live capture.

    Args:
        arm: As for `files.load_specification`, with ``base`` and ``tip``.
        plan: The manifest of a plan; the table of its poses is beside it, with the same name and the ending ``.csv``.
        kit: A kit (`files.read_kit`); where it says how many placements something has, these are found by touching.
        base: Of a URDF, the link that does not move.
        tip: Of a URDF, the link at the end.

    Raises:
        InputError: A file is missing or wrong, neither a plan nor a kit is given, or both are.

    Example:
        >>> from pathlib import Path
        >>> _ = Path("two.toml").write_text('socket = [{ name = "A", point = [400, 200, 300] }]')
        >>> print([place.name for place in aj.live.read_setup("cheng2018-simulation", kit="two.toml").places])
        ['A']
    """
    if (plan is None) == (kit is None):
        raise InputError(
            "give either a plan or a kit (--plan FILE.toml, or --kit FILE.toml), which says what to measure."
        )
    specification = load_specification(arm, base=base, tip=tip)
    noise = load_noise(arm, base=base, tip=tip)
    if kit is not None:
        things = read_kit(kit, lengths=True)
        specification = _for_kit(specification, things)
        return setup_of(specification, noise, things, kit_lengths(kit))._replace(targets=kit_targets(kit))
    path = Path(str(plan))
    model: Any = read_toml(path, PosesManifest)
    planned = _planned_poses(path.with_suffix(".csv"), specification.arm)
    with naming(path):
        things = [_thing(table, entry, planned) for table, entry in _tables(model)]
        lengths = [length.between(length.start, length.end) for length in model.length]
        setup = setup_of(specification, noise, things, lengths, [(place, q) for place, q, _ in planned])
        for place, *_ in planned:
            setup.place(place)
    return setup


def _for_kit(specification: ArmSpecification, kit: Sequence[KitItem]) -> ArmSpecification:
    """The arm with the parameters that a kit of targets alone determines, as a simulated capture of it shows."""
    things = [item.simulated for item in kit]
    if any(isinstance(thing, SimulatedSocket | SimulatedArtefact) for thing in things):
        return specification
    try:
        capture = simulate(to_numpy(specification.arm), sockets={}, observations=things, seed=0)
    except InputError:  # where they are not within reach, guidance says so
        return specification
    return for_capture(specification, True, capture)


def _tables(model: Any) -> list[tuple[str, Any]]:
    """The tables of a manifest that say where poses are taken."""
    tables = {"socket", "artefact", "points", "distances"}
    others = [name for name in ("pixels", "transforms", "touched_sphere", "planes") if getattr(model, name, None)]
    if others:
        raise InputError(f"a live capture takes no [[{others[0]}]] from a plan; {_OTHERS}.")
    return [(name, entry) for name in sorted(tables) for entry in getattr(model, name, ())]


def _planned_poses(path: Path, arm: Arm) -> list[tuple[str, np.ndarray, np.ndarray]]:
    """The place, readings and tip of each pose of a plan, in order."""
    if not path.is_file():
        raise InputError(f"{path} is missing: the table of the plan's poses; write it with aacmm plan -o {path.name}.")
    text = TextTable(InputFile(path))
    columns = [[f"q_{i}_{unit}" for i, unit in enumerate(by_joint(arm, a, "mm"), start=1)] for a in ("deg", "rad")]
    names = next((names for names in columns if text.has(names)), None)
    if names is None:
        raise InputError(
            f"{path} has no columns {columns[0][0]}, ...; give the table that aacmm plan wrote for this arm."
        )
    unit = DEG if names is columns[0] else 1.0
    q = text.numbers(text.pick(names)) * np.array(by_joint(arm, unit, 1.0))
    tips = text.numbers(text.pick(["x_mm", "y_mm", "z_mm"]))
    if text.has(["socket"]):
        places = text.texts("socket").tolist()
    else:
        pairs = zip(text.texts("observation"), text.texts("point"), strict=True)
        places = [f"{name}/{point}" if point else str(name) for name, point in pairs]
    taken = text.texts("move") == "pose" if text.has(["move"]) else np.ones(len(q), dtype=bool)
    return [(place, *row) for place, *row, at in zip(places, q, tips, taken, strict=True) if at]


def _thing(table: str, entry: Any, planned: list[tuple[str, np.ndarray, np.ndarray]]) -> AbstractSimulated:
    """What stands in a table of the manifest, where the plan has its poses."""
    if not entry.name:
        raise InputError(f"[[{table}]] has no name; name it as the plan does.")
    tips = [tip for place, _, tip in planned if place == entry.name]
    if table == "artefact":
        points = {name: np.asarray(point, dtype=float) for name, point in (entry.coordinates or {}).items()}
        held = [(points[name], tip) for place, _, tip in planned for name in points if place == f"{entry.name}/{name}"]
        if not held:
            raise InputError(f"the plan has no pose in '{entry.name}', or its coordinates are missing; {_OTHERS}.")
        frame = np.asarray(fitted_frame(*(np.array(rows).T for rows in zip(*held, strict=True))))
        names = {key: getattr(entry, key) for key in ("artefact", "placement", "index") if getattr(entry, key)}
        poses = max(len(held) // len(points), 1)
        return SimulatedArtefact(entry.name, points, poses, frame, u=entry.u or 0.0, **names)
    if not tips:
        raise InputError(f"the plan has no pose in '{entry.name}'; {_OTHERS}.")
    if table == "socket":
        return SimulatedSocket(entry.name, tips[0], len(tips))
    box = np.array([np.min(tips, axis=0), np.max(tips, axis=0) + 1e-3])
    if table == "points":
        return SimulatedPoints(entry.name, box, len(tips), u=float(entry.u or 0.0))
    return SimulatedDistances(entry.name, box, len(tips), box[0] - 100.0, u=float(entry.u or 0.0))
