"""One capture: recorded by a simulated arm, changed by a mistake, and written as a manifest with its tables.

`Trial` is what is true, then what is recorded. A physical mistake changes it before `record`, a mistake of recording
after; both are functions of `kinds`. Errors of joints are functions of the readings and of the time, which goes from 0
in the first pose to 1 in the last.
"""

import csv
import math
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit
from scipy.spatial.transform import Rotation

import aacmm_jax as aj
from aacmm_jax.core.numpy_or_jax import to_numpy
from aacmm_jax.core.random_keys import random_key
from aacmm_jax.kinematics.arm import joint_limits
from aacmm_jax.kinematics.inverse_kinematics import random_configurations

from .cases import CASES, STYLUS, arm_table, layout

COUNTS = 4096  # per turn
OFFSET_OF_TARGET = np.array([30.0, -20.0, 80.0])  # of a reflector in the last frame, mm
POSE_SETS = 6  # of a case: seeds share them, because finding poses takes most of the time of a simulation
JointError = Callable[[np.ndarray, np.ndarray], np.ndarray]  # readings, time -> what the joint turns beyond, rad


@cache
def exact_poses(name: str, number: int) -> tuple[aj.Arm, np.ndarray, np.ndarray, np.ndarray]:
    """A true arm, and exact poses of it: groups, tips and joint angles."""
    case, table = CASES[name], arm_table(name)
    length, angle = case.deviation
    space = specification_of(table).space()
    space = aj.Parameters(space.base, tuple(name for name in space.names if name not in case.gauge))
    true = aj.perturbed_arm(space, length=length, angle=np.deg2rad(angle), seed=number)
    labels, tips = layout(case, np.random.default_rng(number))
    limits = np.asarray(joint_limits(true, None))
    # Some degrees within the limits, and within one turn, as with stops and cables.
    limits = np.clip(limits, -np.pi, np.pi) + np.radians([3.0, -3.0])
    held = true.replace(probe=OFFSET_OF_TARGET) if case.target else true
    q = np.asarray(random_configurations(to_numpy(held), tips, random_key(number), limits, labels=list(labels)))
    return to_numpy(held), labels, tips, q


def specification_of(table: dict[str, Any]) -> aj.kinematics.ArmSpecification:
    """An arm file as the toolkit reads it."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "arm.toml"
        path.write_text(tomlkit.dumps(table))
        return aj.files.load_specification(str(path))


class Trial:
    """A capture of one case, while it is made."""

    def __init__(self, name: str, seed: int, noise: bool = True):
        self.name, self.case, self.random = name, CASES[name], np.random.default_rng([seed, 1])
        self.true, label, self.tips, self.exact = exact_poses(name, seed % POSE_SETS)
        self.label = label.copy()
        self.noise = float(noise)
        count, self.joints = self.exact.shape
        self.time = np.arange(count) / (count - 1)
        # What physical mistakes change. Distances and the tip are mm.
        self.joint_errors: list[JointError] = []
        self.base, self.seat, self.tool = (np.zeros((count, 3)) for _ in range(3))
        self.growth = np.zeros(count)  # of all lengths of the arm
        self.encoder_factor, self.scatter_factor = np.ones(self.joints), np.ones(count)
        # What is certified: by name, and true until a mistake changes it.
        self.arm = tomlkit.parse(tomlkit.dumps(arm_table(name))).unwrap()
        self.certified = self._certificates()
        self.u_factor = 1.0
        # What conventions of the recording do to readings, here and whenever the arm is used.
        self.misread: list[Callable[[np.ndarray], np.ndarray]] = []
        self.angles: dict[str, Any] = {"unit": self.case.unit}
        if self.case.unit == "counts":
            self.angles |= {"counts_per_turn": COUNTS, "offset": COUNTS // 2}
        self.culprit: dict[str, str] = {}  # names of what is wrong, for the patterns of `kinds`
        self.readings = self.measured = np.zeros(0)
        # What the encoders showed, where the tables hold commands too and the manifest picks these.
        self.encoders: np.ndarray | None = None
        self.commands = False

    def _certificates(self) -> dict[str, np.ndarray]:
        case = self.case
        places = {name: np.array(place, dtype=float) for name, place in case.groups.items()}
        if case.kind == "socket":
            true = {f"{a} - {b}": np.linalg.norm(places[a] - places[b], keepdims=True) for a, b in case.lengths}
        elif case.kind == "touched_sphere":
            true = {name: np.array([case.diameter]) for name in case.groups}
        else:
            true = places if case.kind == "artefact" else {}
        spread = self.noise * case.u_certified
        return {name: value + spread * self.random.normal(size=value.shape) for name, value in true.items()}

    def record(self) -> None:
        """Reach every pose, and read encoders and instrument."""
        case = self.case
        scatter = self.noise * case.u * self.scatter_factor[:, None] * self.random.normal(size=self.tips.shape)
        q, arm = self.exact.copy(), self.true
        if not case.instrument:
            target = self.tips + self.seat + self._seated(scatter) - self.base
            for _ in range(6):  # Newton's method, also where the arm is nearly stretched
                tip, rotation = _tips(arm, q)
                missed = target - (1 + self.growth[:, None]) * tip - np.einsum("nij,nj->ni", rotation, self.tool)
                slopes = np.asarray(arm.jacobian(q, tuple(f"q_{i + 1}" for i in range(self.joints))))
                q = q + np.einsum("nab,nb->na", np.linalg.pinv(slopes), missed)
        else:
            self.measured = self._seen(q, scatter)
        noise = self.encoder_factor * math.radians(case.encoder_arcsec / 3600)
        noise = self.noise * noise * self.random.normal(size=q.shape)
        self.readings = self.read(q, self.time) + noise
        self.encoders = q + noise if self.commands else None

    def _seated(self, scatter: np.ndarray) -> np.ndarray:
        """What the seat does to the tip; a touched sphere moves it along the normal only."""
        if self.case.kind != "touched_sphere":
            return scatter
        normals = self.tips - np.array([self.case.groups[label] for label in self.label])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return normals * scatter[:, :1]

    def _seen(self, q: np.ndarray, scatter: np.ndarray) -> np.ndarray:
        """What the instrument measures: distances, or points and rotation vectors in its own frame."""
        case, (tip, rotation) = self.case, _tips(self.true, q)
        tip = (1 + self.growth[:, None]) * tip + np.einsum("nij,nj->ni", rotation, self.tool) + self.base + self.seat
        places = np.array([case.groups[label] for label in self.label])
        if case.kind == "distances":
            return np.linalg.norm(tip - places, axis=1)[:, None] + scatter[:, :1]
        station = Rotation.from_euler("z", np.arctan2(-places[:, 1], -places[:, 0])[:, None])
        points = station.inv().apply(tip - places) + scatter
        if case.kind == "points":
            return points
        turned = Rotation.from_rotvec(self.noise * case.u_angle * self.random.normal(size=points.shape))
        return np.concatenate([points, (station.inv() * turned * Rotation.from_matrix(rotation)).as_rotvec()], axis=1)

    def read(self, q: np.ndarray, time: np.ndarray) -> np.ndarray:
        """The readings, without noise, of joints at these angles."""
        readings = q.copy()
        for _ in range(30 if self.joint_errors else 0):
            readings = q - sum(error(readings, time) for error in self.joint_errors)
        return readings

    def in_use(self, q: np.ndarray) -> np.ndarray:
        """What the controller shows when the arm is used after the capture, by the same conventions; rad."""
        readings = self.read(q, np.ones(len(q)))
        for misread in self.misread:
            readings = misread(readings)
        return readings

    def write(self, folder: Path) -> Path:
        """Write the arm, the tables and the manifest, and return the manifest."""
        case, manifest = self.case, {"arm": "arm.toml", "angles": self.angles}
        (folder / "arm.toml").write_text(tomlkit.dumps(self.arm))
        names, written = [f"q_{i + 1}" for i in range(self.joints)], self._in_unit(self.readings)
        if self.encoders is not None:
            commands = [f"q_cmd_{i + 1}" for i in range(self.joints)]
            manifest["angles"] = self.angles | {"columns": commands}
            names, written = [*commands, *names], np.concatenate([written, self._in_unit(self.encoders)], axis=1)
        tables: dict[str, list[int]] = {}
        for row, label in enumerate(self.label):
            tables.setdefault("poses" if case.kind == "socket" else label.partition("/")[0], []).append(row)
        manifest[case.kind] = []
        for file, rows in tables.items():
            entry, columns, values = self._entry(file, rows)
            with (folder / f"{file}.csv").open("w", newline="") as stream:
                writer = csv.writer(stream)
                writer.writerow([*names, *columns])
                writer.writerows(
                    [*map(repr, written[row].tolist()), *value] for row, value in zip(rows, values, strict=True)
                )
            manifest[case.kind].append({"name": file, "file": f"{file}.csv"} | entry)
        if case.kind == "socket":
            del manifest["socket"][0]["name"]
            u = case.u_certified * self.u_factor
            manifest["length"] = [
                {"from": a, "to": b, "value": float(self.certified[f"{a} - {b}"][0]), "u": u} for a, b in case.lengths
            ]
        (folder / "capture.toml").write_text(tomlkit.dumps(manifest))
        return folder / "capture.toml"

    def _in_unit(self, readings: np.ndarray) -> np.ndarray:
        """Readings as tables have them."""
        for misread in self.misread:
            readings = misread(readings)
        if self.case.unit == "counts":
            counts = readings / (2 * np.pi) * COUNTS + COUNTS // 2
            return np.round(counts) if self.noise else counts
        return np.degrees(readings) if self.case.unit == "deg" else readings

    def _entry(self, file: str, rows: list[int]) -> tuple[dict[str, Any], list[str], list[list[str]]]:
        """The table of the manifest for one file, the columns beside the readings, and their cells."""
        case, u = self.case, self.case.u_certified * self.u_factor
        if case.kind == "socket":
            return {"group": "socket"}, ["socket"], [[self.label[row]] for row in rows]
        if case.kind == "artefact":
            points = {name: value.tolist() for name, value in self.certified.items()}
            entry = {"artefact": "plate", "columns": {"point": ["hole"]}, "coordinates": points, "u": u}
            return entry, ["hole"], [[self.label[row].partition("/")[2]] for row in rows]
        if case.kind == "touched_sphere":
            return {"diameter": float(self.certified[file][0]), "u": u, "stylus": STYLUS}, [], [[] for _ in rows]
        cells = [list(map(repr, self.measured[row].tolist())) for row in rows]
        entry: dict[str, Any] = {"u": case.u * self.u_factor}
        if case.kind == "distances":
            return entry | {"columns": {"values": ["distance"]}}, ["distance"], cells
        columns = {"points": ["x", "y", "z"]}
        entry |= {"target": case.target} if case.target else {}
        if case.kind == "transforms":
            columns["rotations"] = ["rx", "ry", "rz"]
            entry |= {"rotation": "vector", "units": {"rotations": "rad"}, "u_angle": case.u_angle * self.u_factor}
        return entry | {"columns": columns}, [name for part in columns.values() for name in part], cells


def _tips(arm: aj.Arm, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tips ``(N, 3)`` and orientations ``(N, 3, 3)`` of the last frame."""
    poses = np.asarray(arm.pose(q))
    return poses[:, :3, 3], poses[:, :3, :3]
