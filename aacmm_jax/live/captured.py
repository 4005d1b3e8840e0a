"""What has been captured: the poses and what was said of them, as the events of a journal make them."""

import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from ..core.errors import InputError
from ..kinematics.arm import Arm
from . import guidance as guiding
from .journal import Journal
from .places import Place, Setup, TakenPose, row_of_readings

_FORMAT = 1
_EXPECTED_WITHIN = 80.0  # mm: the first pose of a place is taken by itself within this distance of where it is expected
_FOUND_WITHIN = 15.0  # mm: and further ones of where the others are


class Captured:
    """Poses, sessions and temperatures; only events change them."""

    def __init__(self, setup: Setup):
        self.setup = setup
        self.poses: list[TakenPose] = []
        self.number = 0  # of the last pose, also where that was undone
        self.session, self.marks = 1, [""]  # number of the present session, and what was said of each
        self.temperature: float | None = None  # C, as it was typed in
        self.finished: dict[str, Any] = {}  # files that were written last, the poses in them, and what they say

    def apply(self, event: Mapping[str, Any]) -> None:
        """Let an event of the journal take effect."""
        kind, number = event["event"], event.get("number")
        if kind == "pose":
            arrays = {name: np.array(value) for name, value in event["measured"].items()}
            q, u = (np.array(event[name], dtype=float) for name in ("q", "u"))
            pose = TakenPose(event["number"], event["place"], event["time"], q, u, event["columns"], arrays)
            self.poses.append(pose._replace(session=self.session))
            self.number = max(self.number, pose.number)
        elif kind == "undo":
            self.poses = [pose for pose in self.poses if pose.number != number]
        elif kind == "exclude":
            excluded = bool(event["excluded"])
            self.poses = [pose._replace(excluded=excluded) if pose.number == number else pose for pose in self.poses]
        elif kind == "mark":
            self.session += 1
            self.marks.append(event["text"])
        elif kind == "temperature":
            self.temperature = event["celsius"]
        elif kind == "finished":
            self.finished = {name: list(event.get(name, ())) for name in ("paths", "poses", "says")}
            self.finished["until"] = event.get("until", 0)  # number of the last pose that there was

    def resume(self, journal: Journal) -> None:
        """Continue a journal of the same arm and places, or begin one. `InputError` where it is of another capture."""
        joints, names = self.setup.specification.arm.joints, [place.name for place in self.setup.places]
        if not journal.events:
            header = {"event": "begin", "format": _FORMAT, "arm": self.setup.specification.name}
            journal.append(header | {"joints": joints, "places": names, "time": time.time()})
            return
        first, other = journal.events[0], "choose another output path."
        if first.get("event") != "begin" or first.get("format") != _FORMAT:
            raise InputError(f"{journal.path} is not a journal that this version reads; {other}")
        try:
            missing = sorted(set(first["places"]) - set(names))
            if first["joints"] != joints or missing:
                what = f"has the place '{missing[0]}'" if missing else f"is of an arm with {first['joints']} joints"
                raise InputError(
                    f"{journal.path} {what}, which this capture does not have; give the same arm and kit to continue "
                    f"it, or {other}"
                )
            for event in journal.events[1:]:
                self.apply(event)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(f"{journal.path} has an event that is not complete ({error}); {other}") from error


class Whereabouts:
    """Where tips and places are, by the arm as it is known so far (`guidance.Guidance.arm`)."""

    def __init__(self, setup: Setup, nominal: Arm, poses: Sequence[TakenPose], guidance: guiding.Guidance | None):
        self.setup, self.nominal, self.guidance = setup, nominal, guidance
        self.arm = nominal if guidance is None else guidance.arm
        rows = [row_of_readings(self.arm, pose) for pose in poses]
        tips = np.asarray(self.arm.position(np.array(rows))) if rows else []
        found = {} if guidance is None else guidance.poses
        self.tips: dict[int, np.ndarray] = {}  # of each pose, mm
        self._in_place: dict[str, list[np.ndarray]] = {}
        for pose, tip in zip(poses, tips, strict=True):
            self.tips[pose.number] = np.asarray(found[pose.number].tip) if pose.number in found else tip
            if not pose.excluded:
                self._in_place.setdefault(pose.place, []).append(self.tips[pose.number])

    def counted(self, place: Place) -> int:
        """How many poses a place has."""
        return len(self._in_place.get(place.name, ()))

    def position(self, place: Place) -> Float[np.ndarray, " 3"] | None:
        """Where a place is: as found, else by its poses, else as expected; None where the tip may be anywhere."""
        if self.guidance is not None and place.name in self.guidance.positions:
            return np.asarray(self.guidance.positions[place.name])
        if place.is_free or not self.counted(place):
            return place.position
        return np.median(self._in_place[place.name], axis=0)

    def place_at(self, tip: Float[np.ndarray, " 3"], seen: bool, proposed: str | None) -> Place | None:
        """The place that the tip is in: the nearest within reach, else, where an instrument sees the tip, that one (the
        one that is ``proposed``, where there are several)."""
        nearest, least = None, 1.0
        for place in self.setup.places:
            position = None if place.is_free else self.position(place)
            if position is not None:
                within = _FOUND_WITHIN if self.counted(place) else _EXPECTED_WITHIN
                distance = float(np.linalg.norm(tip - position)) / within
                if distance < least:
                    nearest, least = place, distance
        free = [place for place in self.setup.places if place.is_free and seen]
        return nearest or next((place for place in free if place.name == proposed), free[0] if free else None)
