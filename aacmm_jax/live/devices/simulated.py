"""A simulated arm with an operator: its own true errors, noise, play, seat offsets, a trembling hand, and mistakes.

``simulated:?seed=1&speed=10``: the operator takes the tip to the pose that is asked for, holds it still, and goes on;
with ``habit=1`` near the present pose instead, as people do. Where that pose cannot be reached, it asks for another
one. Time runs ``speed`` times as fast, in `Sample.time` too.
"""

import time
from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from ...core.errors import InputError
from ...core.numpy_or_jax import to_numpy
from ...core.rotations import rotation_matrix
from ...core.units import ARCSEC
from ...data.observations.pixels import Pixels
from ...kinematics.arm import Arm, joint_limits
from ...kinematics.inverse_kinematics import project_to_targets
from ...kinematics.parameters import perturbed_arm
from ..places import COLUMNS, Place, Setup, by_thing
from ..samples import Sample
from .device import AbstractDevice, numbers_of

RATE = 100.0  # samples a second
_OPTIONS = {
    "seed": 0.0,
    "speed": 1.0,  # of time
    "length": 0.3,  # mm: largest errors of the true arm
    "angle": 1e-3,  # rad
    "encoder_arcsec": -1.0,  # by default what is usual for the arm
    "seating": -1.0,  # mm
    "play_arcsec": 0.0,
    "tremor": 5.0,  # of the hand, in standard deviations of the encoders
    "creep": 0.0,  # of a held pose, rad/s
    "bad": 0.02,  # share of poses with the tip off its seat
    "off": 0.5,  # mm by which it is
    "hold": 1.5,  # s in a pose
    "habit": 0.0,  # 1: the operator takes neighbouring poses
    "temperature": 20.0,
    "place": 30.0,  # mm: largest error of where sockets and artefacts are expected
}
_FASTEST = 1.2  # rad/s, or m/s of prismatic joints
_AHEAD = 0.5  # s that are computed at once
_IDLE = 0.1  # s that an operator without a goal waits for one
_SWEEPS = 100  # over the certified lengths, to satisfy all of them
_LIFT = 0.05  # rad or mm: how far joints move to lift the probe out of its seat
_TRIES = 12


def open_device(where: str, options: Mapping[str, str], setup: Setup) -> "Simulated":
    """The simulated arm of a setup."""
    if where:
        raise InputError(f"device 'simulated:{where}' names an arm, but it is that of the capture; leave it out.")
    return Simulated(setup, **numbers_of("simulated:", options, _OPTIONS))


class Simulated(AbstractDevice):
    """See the module. ``true`` is the true arm, ``positions`` the true positions of the places."""

    def __init__(self, setup: Setup, **options: float):
        given = _OPTIONS | options
        super().__init__(f"simulated:?seed={given['seed']:g}&speed={given['speed']:g}")
        if not 0 < given["speed"] <= 1000:
            raise InputError("speed of a simulated device must be above 0 and at most 1000.")
        self.options, self.setup, self.random = given, setup, np.random.default_rng(int(given["seed"]))
        nominal = setup.specification
        self.joints, self.connected = nominal.arm.joints, True
        self.true = to_numpy(
            perturbed_arm(nominal.space(), length=given["length"], angle=given["angle"], seed=int(given["seed"]))
        )
        usual = np.broadcast_to(np.asarray(setup.noise.noise.of_readings(self.true.geometry.kinds)), (self.joints,))
        own = given["encoder_arcsec"]
        self.encoder = usual if own < 0 else np.full(self.joints, own * ARCSEC)
        self.seating = float(setup.noise.noise.seating) if given["seating"] < 0 else given["seating"]
        self.limits = np.asarray(joint_limits(self.true, None))
        self._readings = [f"q_{i + 1}" for i in range(self.joints)]
        self.positions = self._true_positions()
        rest = np.clip(np.zeros(self.joints), self.limits[:, 0], self.limits[:, 1])
        self._q, self._play_side, self._tremor = rest, np.ones(self.joints), np.zeros(self.joints)
        self._place: Place | None = None
        self._seated = False
        self._ready: list[Sample] = []
        self._clock = self._now = 0.0  # simulated time up to which samples were computed, and were given
        self._read_at = time.monotonic()
        self._kept = np.eye(self.joints)  # motions that the seat allows
        # Set by another thread.
        self._goals: deque[tuple[Place | None, np.ndarray, np.ndarray | None]] = deque(maxlen=1)

    def truth(self) -> Arm:
        return self.true

    def _true_positions(self) -> dict[str, Float[np.ndarray, " 3"]]:
        """Things stand a little elsewhere than expected, each as a whole, and sockets as far apart as is certified."""
        found = {}
        for places in by_thing(self.setup).values():
            shift = self.options["place"] * self.random.uniform(-1, 1, 3) / np.sqrt(3)
            turn = np.asarray(rotation_matrix(0.02 * self.random.uniform(-1, 1, 3)))
            known = {place.name: place.position for place in places if place.position is not None}
            if known:
                middle = np.mean(list(known.values()), axis=0)
                found |= {name: middle + turn @ (tip - middle) + shift for name, tip in known.items()}
        for length in [length for length in self.setup.lengths if {length.start, length.end} <= set(found)] * _SWEEPS:
            apart = found[length.end] - found[length.start]
            step = 0.5 * (float(length.value) / np.linalg.norm(apart) - 1) * apart
            found |= {length.start: found[length.start] - step, length.end: found[length.end] + step}
        return found

    def asked(
        self, place: Place | None, q: Float[np.ndarray, " n"] | None, start: Float[np.ndarray, " n"] | None = None
    ) -> None:
        if q is not None:
            self._goals.append((place, np.asarray(q, dtype=float), start))

    def read(self) -> list[Sample]:
        elapsed = time.monotonic() - self._read_at
        if elapsed * self.options["speed"] < 1 / RATE:
            time.sleep(0.002)
            return []
        self._read_at += elapsed
        # Time runs slower where the computer cannot keep up, and stands still while it sleeps.
        now = self._now = self._now + min(elapsed * self.options["speed"], _AHEAD)
        while self._clock < now:
            self._compute()
        count = next((i for i, sample in enumerate(self._ready) if sample.time > now), len(self._ready))
        due, self._ready = self._ready[:count], self._ready[count:]
        self.lines += count
        return due

    def _compute(self) -> None:
        """The next stretch: a motion to the goal and the hold there, or rest where the tip is."""
        try:
            self._place, q, start = self._goals.pop()
        except IndexError:
            self._hold(_IDLE)
            return
        wanted, self._seated = self._there(q)
        if start is not None:
            self._move(start)
        elif np.max(np.abs(wanted - self._q)) < _LIFT:  # a pose that is taken again is seated anew
            self._move(np.clip(self._q + _LIFT, self.limits[:, 0], self.limits[:, 1]))
        self._move(wanted)
        self._kept = np.eye(self.joints)
        if self._seated:  # the seat holds the tip: what would move it is left out
            jacobian = np.asarray(self.true.jacobian(self._columns(wanted), self._readings))
            self._kept -= np.linalg.pinv(jacobian) @ jacobian
        self._hold(self.options["hold"])

    def _there(self, q: np.ndarray) -> tuple[np.ndarray, bool]:
        """True configuration for a pose that is asked for, in its seat, and whether there is one."""
        q, place = np.clip(q, self.limits[:, 0], self.limits[:, 1]), self._place
        if place is None or place.name not in self.positions:
            return q, False
        if self.options["habit"]:
            q = self._q + 0.15 * self.random.normal(size=self.joints)
        shift = self.seating * self.random.normal(size=3)
        if self.random.uniform() < self.options["bad"]:
            direction = self.random.normal(size=3)
            shift = shift + self.options["off"] * direction / np.linalg.norm(direction)
        target = (self.positions[place.name] + shift)[None]
        starts = self._columns(
            q
            + np.outer(np.linspace(0, 0.5, _TRIES), np.ones(self.joints))
            * self.random.normal(size=(_TRIES, self.joints))
        )
        found, arrived = project_to_targets(self.true, starts, np.tile(target, (_TRIES, 1)), self.limits)
        first = int(np.argmax(arrived))  # the nearest to what was asked for that is possible
        return (found[first, : self.joints], True) if arrived[first] else (q, False)

    def _columns(self, q: np.ndarray) -> np.ndarray:
        """Readings with what the arm takes beside them."""
        row = np.zeros((*q.shape[:-1], self.true.columns))
        row[..., : self.joints] = q
        slices = self.true.beside.slices(self.true.columns)
        row[..., slices["thermometer"]] = self.options["temperature"]
        return row

    def _move(self, goal: np.ndarray) -> None:
        """A smooth motion, at most as fast as people move an arm."""
        units = np.ones(self.joints) if self.true.geometry.kinds is None else self.true.geometry.kinds.units
        duration = max(0.4, 1.9 * float(np.max(np.abs(goal - self._q) / units)) / _FASTEST)
        count = max(int(duration * RATE), 2)
        s = np.linspace(0, 1, count)[:, None]
        path = self._q + (10 * s**3 - 15 * s**4 + 6 * s**5) * (goal - self._q)
        moved = goal - self._q
        self._play_side = np.where(np.abs(moved) > 1e-9, np.sign(moved), self._play_side)
        self._q = goal
        self._emit(path, {})

    def _hold(self, duration: float) -> None:
        count = max(int(duration * RATE), 1)
        tremor = np.empty((count, self.joints))
        for i in range(count):  # a hand wanders slowly
            self._tremor = 0.9 * self._tremor + 0.44 * self.random.normal(size=self.joints)
            tremor[i] = self._tremor
        moves = self.options["tremor"] * self.encoder * tremor
        moves += np.outer(np.arange(count) / RATE, np.full(self.joints, self.options["creep"]))
        moves = moves @ self._kept
        measured = {} if self._place is None or self._place.position is not None else self._measured(self._place)
        missed = self._place is not None and not self._seated and not measured
        self._emit(self._q + moves * bool(not measured), measured, missed)

    def _emit(self, path: np.ndarray, measured: Mapping[str, Any], missed: bool = False) -> None:
        """Samples of a stretch of true configurations."""
        play = 0.5 * self.options["play_arcsec"] * ARCSEC * self._play_side
        shown = path + play + self.encoder * self.random.normal(size=path.shape)
        columns = {COLUMNS["thermometer"]: self.options["temperature"], "skip": float(missed)}
        times = self._clock + np.arange(1, len(path) + 1) / RATE
        self._ready += [Sample(float(t), q, columns, measured) for t, q in zip(times, shown, strict=True)]
        self._clock += len(path) / RATE

    def _measured(self, place: Place) -> dict[str, Any]:
        """What an instrument sees of the tip, by the thing's own simulation; nothing where it sees nothing."""
        thing = place.thing.changed(poses=1)
        holding = self.true if thing.offset is None else to_numpy(self.true.replace(probe=thing.offset))
        q = self._columns(self._q)[None]
        try:
            seen = thing.recorded(q, np.asarray(holding.pose(q)), self.random)
        except InputError:
            return {}
        entries = (e.name for e in seen.entries if e.of_poses and e.required and e.name != "q")
        names = ("corners", "ids") if isinstance(seen, Pixels) else entries
        return {name: np.asarray(getattr(seen, name))[0] for name in names}
