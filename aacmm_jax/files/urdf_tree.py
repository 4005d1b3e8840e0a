"""The links and joints of a URDF as a tree: the chain between two links, and which joints an arm may have."""

from collections.abc import Sequence

from ..core.errors import InputError
from ..core.text import quoted, shorten
from .urdf_text import Robot, UrdfJoint

_MOVING = ("revolute", "continuous", "prismatic")
_LARGEST, _IN_DEGREES = 15.0, 720.0  # rad: limits of joints end below; those in degrees are mostly between
_LISTED = 12  # links that a message names


def check_moving(joint: UrdfJoint) -> None:
    """Refuse a joint that an arm does not have."""
    what = f"joint {quoted(joint.name)}"
    if joint.kind not in _MOVING:
        known = joint.kind in ("floating", "planar")
        kind = f"is {joint.kind}" if known else f"has the unknown type {quoted(joint.kind)}"
        raise InputError(f"{what} {kind}, which is no joint of an arm; name links without it between them.")
    if joint.mimics is not None:
        raise InputError(
            f"{what} mimics {quoted(joint.mimics)}, so it has no reading; name links without it between them."
        )
    if joint.axis is None:
        raise InputError(f"{what} has an axis of length 0; correct its <axis xyz=...>.")
    if joint.kind != "continuous" and (joint.limits is None or not joint.limits[0] < joint.limits[1]):
        unit, factor = ("m", 1e-3) if joint.kind == "prismatic" else ("rad", 1.0)
        state = (
            "has no limits"
            if joint.limits is None
            else f"has the limits {factor * joint.limits[0]:g} and {factor * joint.limits[1]:g} {unit}"
        )
        other = "" if joint.kind == "prismatic" else ', or type="continuous"'
        raise InputError(
            f"{what} is {joint.kind} and {state}; give it <limit lower=... upper=...> in {unit}, the lower below the "
            f"upper{other}."
        )
    if joint.kind == "revolute" and joint.limits is not None and _LARGEST < max(map(abs, joint.limits)) <= _IN_DEGREES:
        low, high = joint.limits
        raise InputError(
            f"{what} has the limits {low:g} and {high:g} rad, as if in degrees; a URDF is in rad, so convert them."
        )


def _joint_to(robot: Robot) -> dict[str, UrdfJoint]:
    """By link the joint that it is the child of."""
    found: dict[str, UrdfJoint] = {}
    for joint in robot.joints.values():
        if joint.child in found:
            raise InputError(
                f"link {quoted(joint.child)} is the child of two joints, {quoted(found[joint.child].name)} and "
                f"{quoted(joint.name)}; a URDF is a tree, so take one of them out."
            )
        found[joint.child] = joint
    return found


def _ancestors(to: dict[str, UrdfJoint], link: str) -> list[UrdfJoint]:
    """The joints from a link back to the root."""
    found: list[UrdfJoint] = []
    while link in to:
        if len(found) > len(to):
            raise InputError(f"the joints before link {quoted(link)} form a circle; a URDF is a tree, so correct it.")
        found.append(to[link])
        link = found[-1].parent
    return found


def joints_between(robot: Robot, base: str, tip: str) -> list[UrdfJoint]:
    """The joints from base to tip."""
    back = _ancestors(_joint_to(robot), tip)
    parents = [joint.parent for joint in back]
    if base in parents:
        return back[: parents.index(base) + 1][::-1]
    if base == tip:
        raise InputError(f"base and tip are the same link, {quoted(base)}; name two.")
    other = _ancestors(_joint_to(robot), base)
    if any(joint.parent == tip for joint in other):
        raise InputError(f"{quoted(base)} comes after {quoted(tip)}, not before it; exchange base and tip.")
    common = next((joint.parent for joint in other if joint.parent in parents), None)
    if common is None:
        raise InputError(f"there is no chain of joints from {quoted(base)} to {quoted(tip)}; name links of one arm.")
    raise InputError(
        f"{quoted(base)} and {quoted(tip)} are on two branches that part at {quoted(common)}; name that as the base, "
        "or a tip on the branch of the base."
    )


def base_and_tip(robot: Robot, base: str | None, tip: str | None) -> tuple[str, str]:
    """Base and tip: those that are named, else the only possible ones."""
    to = _joint_to(robot)
    for what, link in (("base", base), ("tip", tip)):
        if link is not None and link not in robot.links:
            raise InputError(
                f"there is no link {quoted(link)} for the {what}; its links are {_listed(list(robot.links))}."
            )
    if base is None:
        if tip is not None and _ancestors(to, tip):
            base = _ancestors(to, tip)[-1].parent
        else:
            roots = [link for link in robot.links if link not in to]
            if robot.links and not roots:
                raise InputError("every link has a joint before it, in a circle; a URDF is a tree, so correct it.")
            if not robot.links:
                raise InputError("it has no <link>; name the URDF of a robot.")
            if len(roots) != 1:
                raise InputError(f"it has {len(roots)} roots, {_listed(roots)}; name the base (base= or --base).")
            base = roots[0]
    if tip is None:
        parents = {joint.parent for joint in robot.joints.values()}
        backs = {link: _ancestors(to, link) for link in robot.links if link not in parents}
        tips = [
            link
            for link, back in backs.items()
            if any(joint.parent == base for joint in back)
            and any(joint.kind != "fixed" for joint in back[: [j.parent for j in back].index(base) + 1])
        ]
        if not tips:
            raise InputError(f"no joint after {quoted(base)} moves; name another base (base= or --base).")
        if len(tips) > 1:
            raise InputError(f"its chains end at {_listed(tips)}; name the tip (tip= or --tip).")
        tip = tips[0]
    return base, tip


def _listed(links: Sequence[str]) -> str:
    return shorten([quoted(link) for link in links], _LISTED)
