"""What people see of a live capture, as JSON may hold it: the same for the page, the terminal and Python."""

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from ..core.numpy_or_jax import to_numpy
from ..core.text import pluralise, printable
from ..kinematics.arm import Arm, by_joint, joint_limits
from ..kinematics.chain import forward_pass, joint_motion
from . import guidance as guiding
from .captured import Captured, Whereabouts
from .places import Setup

_DEGREES = 180 / np.pi
_LONGEST = 300  # characters of a text that a device sent


def links_of(arm: Arm, q: Float[np.ndarray, " n"]) -> list[list[float]]:
    """Points along an arm from the base to the tip, mm: along each joint's axis, then along its link."""
    row = np.concatenate([q, np.zeros(arm.columns - len(q))])[None]
    geometry = to_numpy(arm.geometry)
    forward = forward_pass(geometry, joint_motion(geometry, row))
    before, after, axes = (np.asarray(x)[..., 0] for x in (forward.origin_before, forward.origin, forward.z_before))
    points = [np.zeros(3)]
    for start, end, axis in zip(before, after, axes, strict=True):
        points += [start + axis * np.dot(end - start, axis), end]
    points.append(np.asarray(forward.tip)[..., 0])
    apart = [b for a, b in itertools.pairwise(points) if np.linalg.norm(b - a) > 1e-6]
    return [point.tolist() for point in (points[0], *apart)]


def not_answering(devices: Sequence[dict[str, Any]], told: set[str]) -> list[str]:
    """A sentence for each device that does not answer, once until it has answered; ``told`` has their names."""
    told -= {device["name"] for device in devices if device["connected"]}
    silent = [d for d in devices if not d["connected"] and d["message"] and d["name"] not in told]
    told |= {device["name"] for device in silent}
    return [
        printable(
            f"{device['name']} does not answer: {device['message']}. Check its cable and supply, that no other program "
            "uses it, and --device; the capture begins as soon as it answers (Ctrl-C ends)."
        )
        for device in silent
    ]


def shown_readings(arm: Arm, q: Float[np.ndarray, " n"]) -> list[float]:
    """Readings in degrees, or mm of prismatic joints."""
    return (q * np.array(by_joint(arm, _DEGREES, 1.0))).tolist()


def shown_text(text: str) -> str:
    """What a device sent, without what a terminal would obey, and not too long."""
    return printable(text[:_LONGEST])


def state_of(
    setup: Setup, captured: Captured, where: Whereabouts, proposed: guiding.NextPose | None, target: float | None
) -> dict[str, Any]:
    """Arm, places, poses, the next pose and the progress."""
    guidance, nominal = where.guidance, setup.specification.arm
    limits = np.asarray(joint_limits(nominal, None)) * np.array(by_joint(nominal, _DEGREES, 1.0))[:, None]
    kinds, units = by_joint(nominal, "revolute", "prismatic"), by_joint(nominal, "deg", "mm")
    joints = [
        {"name": f"joint {i}", "kind": kind, "unit": unit, "limits": ends}
        for i, (kind, unit, ends) in enumerate(zip(kinds, units, limits.tolist(), strict=True), start=1)
    ]
    places = [
        {
            "name": place.name,
            "kind": place.kind,
            "position": None if (position := where.position(place)) is None else position.tolist(),
            "poses": where.counted(place),
            "wanted": place.wanted,
        }
        for place in setup.places
    ]
    following = None
    if proposed is not None:
        following = {
            "place": proposed.place,
            "q": shown_readings(nominal, proposed.q),
            "from": None if proposed.approach is None else shown_readings(nominal, proposed.approach),
            "links": links_of(where.arm, proposed.q),
            "why": proposed.why,
            "distance": float(proposed.distance),
        }
    return {
        "arm": {"name": setup.specification.name, "joints": joints},
        "places": places,
        "poses": poses_of(captured, where),
        "next": following,
        "progress": {
            "u_length_mm": guidance and guidance.u_length,
            "u_target_mm": target,
            "u_after_ten_mm": guidance and guidance.u_after_ten,
            "limits": guidance.limits if guidance else "",
        },
        "sentences": list(guidance.sentences) if guidance else [],
        "stop": bool(guidance and guidance.stop),
        "paths": captured.finished.get("paths", []),
        "says": captured.finished.get("says", []),
        "written": captured.finished.get("poses", []),
        "written_until": captured.finished.get("until", 0),
        "session": captured.session,
        "temperature": captured.temperature,
    }


def poses_of(captured: Captured, where: Whereabouts) -> list[dict[str, Any]]:
    """Each pose that was taken, with its residual where there is a calibration yet."""
    rows = []
    for pose in captured.poses:
        found = where.guidance.poses.get(pose.number) if where.guidance else None
        rows.append(
            {
                "number": pose.number,
                "place": pose.place,
                "time": pose.time,
                "session": pose.session,
                "excluded": pose.excluded,
                "tip": where.tips[pose.number].tolist(),
                "residual": None if found is None else np.asarray(found.residual).tolist(),
                "residual_mm": None if found is None else float(np.linalg.norm(found.residual)),
                "expected_mm": None if found is None else float(found.expected),
                "outlier": bool(found and found.outlier),
            }
        )
    return rows


def headline(busy: str | None, unread: Sequence[str], state: dict[str, Any]) -> str:
    """What to do now, in one short sentence."""
    if busy:
        return f"{busy} ..."
    if unread:
        return shown_text(unread[0])
    last = state["poses"][-1] if state["poses"] else None
    if last and last["outlier"] and not last["excluded"]:
        return f"Pose {last['number']} does not fit: take it again in {last['place']}"
    if state["paths"] and (last is None or last["number"] <= state["written_until"]):
        return f"Finished with {pluralise(len(state['written']), 'pose')}"
    if state["stop"]:
        return "The target is met: finish, or take more poses"
    if not state["next"]:
        return "Take a pose"
    if state["progress"]["u_target_mm"] is None and all(p["poses"] >= p["wanted"] for p in state["places"]):
        return "Every place has its poses: finish, or take more"
    place = next(place for place in state["places"] if place["name"] == state["next"]["place"])
    alone = len(state["places"]) == 1
    goal = place["name"] if place["position"] else f"the next pose{'' if alone else ' for ' + place['name']}"
    return f"Go to {goal} and hold still"
