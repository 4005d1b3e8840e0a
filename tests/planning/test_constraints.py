"""Plans that an arm can run: poses inside their cones and clear of obstacles, checked here by sampled points."""

import math
from itertools import pairwise

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.files.plans import plan_csv, plan_manifest
from aacmm_jax.kinematics import Box, Cell, Cone, HalfSpace, body_along_links
from aacmm_jax.kinematics.workspace import skeleton
from aacmm_jax.planning import kit_placement
from aacmm_jax.planning import placement as placements
from aacmm_jax.summaries.planning import kit_plan_summary, plan_summary

SOCKETS = {"A": (450, 100, 200), "B": (450, -300, 200), "C": (600, 0, 300)}
CONE = {"A": Cone(math.radians(40)), "B": Cone(math.radians(30), (0.5, 0.0, 0.8)), "C": Cone(math.radians(70))}
RADIUS, BOX = 55.0, Box("cabinet", (300, 600, 300), (500, 300, 600), (0.0, 0.0, 0.3))
WALL = HalfSpace("wall", (1.0, 0.0, 0.0), (-350.0, 0.0, 0.0))


@pytest.fixture(scope="module")
def panda():
    return aj.files.load_specification("panda")


@pytest.fixture(scope="module")
def constrained(panda) -> aj.planning.Plan:
    return aj.planning.plan(
        panda.arm, sockets=SOCKETS, lengths=[("A", "B"), ("A", "C")], poses=24, space=panda.space(), cone=CONE,
        cell=Cell(body_along_links(panda.arm, RADIUS, 8.0), (BOX, WALL), clearance=3.0), retract=40.0,
        unconstrained=True, candidates=600, seed=2,
    )  # fmt: skip


def body_points(arm, q) -> tuple[np.ndarray, np.ndarray]:
    """Points along the skeleton but its first offset, each with its radius; the tool ends 16 mm before the tip."""
    corners = skeleton(arm, q)
    points, radii = [], []
    for number, (start, end) in enumerate(pairwise(np.moveaxis(corners, 1, 0))):
        tool = number == corners.shape[1] - 2
        length = np.linalg.norm(end - start, axis=1).max()
        if number == 0 or length < 1e-6:
            continue
        fractions = np.linspace(0, 1 - 16 / length if tool else 1, 40)
        points.append(start[:, None] + fractions[None, :, None] * (end - start)[:, None])
        radii += [8.0 if tool else RADIUS] * 40
    return np.concatenate(points, axis=1), np.array(radii)


def gaps(arm, q) -> dict[str, float]:
    """Smallest distances from the table, the wall and the box, by sampled points."""
    points, radii = body_points(arm, q)
    turn = BOX.rotation[2]
    rotation = np.array([[math.cos(turn), -math.sin(turn), 0], [math.sin(turn), math.cos(turn), 0], [0, 0, 1]])
    local = (points - np.array(BOX.centre)) @ rotation
    half = np.array(BOX.size) / 2
    return {
        "table": float((points[..., 2] - radii).min()),
        "wall": float((points[..., 0] + 350 - radii).min()),
        "cabinet": float((np.linalg.norm(local - np.clip(local, -half, half), axis=-1) - radii).min()),
    }


@pytest.mark.slow
def test_every_pose_is_in_its_cone(panda, constrained):
    """By the last frame's z axis, socket by socket; and the tilts that the plan states."""
    tool = np.asarray(panda.arm.pose(constrained.q))[:, :3, 2]
    for i, name in enumerate(constrained.sockets):
        cone, rows = CONE[name], constrained.owner == i
        unit = np.array(cone.normal) / np.linalg.norm(cone.normal)
        tilt = np.arccos(np.clip(-tool[rows] @ unit, -1, 1))
        assert np.degrees(tilt).max() <= math.degrees(cone.half_angle) + 1e-4
        np.testing.assert_allclose(constrained.motion.tilt[rows], tilt, atol=1e-6)
    points = np.array([constrained.sockets[name] for name in constrained.sockets])
    np.testing.assert_allclose(panda.arm.position(constrained.q), points[constrained.owner], atol=1e-5)


@pytest.mark.slow
def test_every_pose_is_clear(panda, constrained):
    """Of table, wall and box by sampled points of the body; no nearer than the plan states, nor than is allowed."""
    found = gaps(panda.arm, constrained.q)
    assert min(found.values()) >= 3.0 - 1e-9
    smallest = constrained.motion.clearance.min()
    assert smallest >= 3.0
    assert min(found.values()) >= smallest - 1e-6
    assert ("offset d_1", "table") in constrained.cell.unchecked
    everywhere = np.random.default_rng(0).uniform(-1.5, 1.5, (200, 7))
    assert min(gaps(panda.arm, everywhere).values()) < 0  # the check can fail


@pytest.mark.slow
def test_approach_points_and_straight_moves(panda, constrained):
    """40 mm along the normals; the moves between them are clear but where the plan says otherwise."""
    motion = constrained.motion
    points = np.array([constrained.sockets[name] for name in constrained.sockets])[constrained.owner]
    np.testing.assert_allclose(
        panda.arm.position(motion.approach), points + 40 * constrained.cones.normals[constrained.owner], atol=1e-5
    )
    limits = np.asarray(panda.arm.limits)
    assert np.all((motion.approach >= limits[:, 0]) & (motion.approach <= limits[:, 1]))
    for path in zip(motion.approach, constrained.q, strict=True):
        assert min(gaps(panda.arm, np.linspace(*path, 20)).values()) >= 3.0 - 0.5
    said = {index for index, *_ in motion.blocked}
    for number, move in enumerate(pairwise(motion.approach), start=1):
        if number not in said:  # samples of the plan are 2 deg apart
            assert min(gaps(panda.arm, np.linspace(*move, 60)).values()) >= 3.0 - 3.0
    assert motion.travel < motion.unordered


@pytest.mark.slow
def test_what_the_constraints_cost_is_predicted(constrained):
    assert constrained.predicted.largest < constrained.random.largest
    assert constrained.unconstrained.largest < constrained.predicted.largest


@pytest.mark.slow
def test_files_and_summary(constrained):
    lines = [line.split(",") for line in plan_csv(constrained, "rad").splitlines()]
    assert lines[0][:4] == ["pose", "move", "socket", "x_mm"]
    assert "q_7_rad" in lines[0]
    assert [line[1] for line in lines[1:4]] == ["approach", "pose", "retract"]
    assert len(lines) == 1 + 3 * 24
    q = np.array([line[6:13] for line in lines[2::3]], dtype=float)
    np.testing.assert_allclose(q, constrained.q, atol=1e-6)
    np.testing.assert_allclose(np.array([r[6:13] for r in lines[1::3]], float), constrained.motion.approach, atol=1e-6)
    assert 'unit = "rad"' in plan_manifest(constrained, "panda", angles="rad")
    summary = plan_summary(constrained, "Panda")
    assert summary["collisions"]["obstacles"] == ["table", "cabinet", "wall"]
    assert summary["collisions"]["unchecked"] == [["offset d_1", "table"]]
    assert summary["collisions"]["smallest_clearance_mm"] >= 3
    assert summary["unconstrained"]["largest_mm"] < summary["predicted"]["largest_mm"]
    for row in summary["sockets"]:
        assert row["largest_tilt_deg"] <= row["cone_deg"]


@pytest.mark.slow
def test_sockets_are_placed_within_their_own_cones(panda, monkeypatch):
    """Through all stages: random placements, their neighbours, chosen and moved poses; the names keep their cones."""
    for name, value in {"_PLACEMENTS": 12, "_NEIGHBOURS": 20, "_DESIGNED": 1, "_STARTS": 200}.items():
        monkeypatch.setattr(placements, name, value)
    normals = {"A": (0.0, 0.0, 1.0), "B": (0.8, 0.0, 0.6)}
    found = aj.planning.plan(
        panda.arm, sockets=2, poses=14, space=panda.space(), candidates=200, length=300.0, seed=1,
        cone={name: Cone(math.radians(25), normal) for name, normal in normals.items()},
    )  # fmt: skip
    assert sorted(found.sockets) == ["A", "B"]
    tool = np.asarray(panda.arm.pose(found.q))[:, :3, 2]
    for i, name in enumerate(found.sockets):
        tilt = np.arccos(np.clip(-tool[found.owner == i] @ np.array(normals[name]), -1, 1))
        assert np.degrees(tilt).max() <= 25 + 1e-4
    assert found.motion.approach is None
    assert found.motion.clearance is None


@pytest.mark.slow
def test_a_low_ceiling(panda, monkeypatch):
    """Most poses would break through it, and nothing but the choice of poses keeps them below."""
    ceiling = HalfSpace("ceiling", (0.0, 0.0, -1.0), (0.0, 0.0, 480.0))
    options = dict(sockets=PAIR, lengths=[("A", "B")], poses=16, space=panda.space(), candidates=300)
    low = aj.planning.plan(panda.arm, cell=Cell(body_along_links(panda.arm, RADIUS), (ceiling,)), **options)
    points, radii = body_points(panda.arm, low.q)
    assert (points[..., 2] + radii).max() <= 480 + 1e-9
    points, radii = body_points(panda.arm, aj.planning.plan(panda.arm, **options).q)
    assert np.mean((points[..., 2] + radii).max(axis=1) > 480) > 0.3


@pytest.mark.slow
def test_a_plate_carries_its_normal(panda, monkeypatch):
    """A plate that lies on its side: the cone is about the plate's own normal, and approach points are along it."""
    monkeypatch.setattr(kit_placement, "_PLACEMENTS", 4)
    monkeypatch.setattr(kit_placement, "_NEIGHBOURS", 2)
    points = {"a": (0, 0, 0), "b": (150, 0, 0), "c": (0, 150, 0)}
    plate = aj.data.observations.SimulatedArtefact("plate", points, 4, (0, -0.9, 0, 500, 0, 300), u=0.002)
    tracker = aj.data.observations.SimulatedPoints("tracker", ((300, -300, 200), (600, 300, 500)), 4, u=0.02)
    found = aj.planning.plan_kit(
        panda.arm, [aj.planning.KitItem(plate, places=0, half_angle=math.radians(35)), tracker], poses=18,
        space=aj.Parameters(panda.arm, ("a_3", "d_3", "theta_3", "theta_5")), candidates=300, retract=30.0,
        cell=Cell(body_along_links(panda.arm, RADIUS, 8.0)), criterion="A", seed=1,
    )  # fmt: skip
    normal = np.array([-math.sin(0.9), 0, math.cos(0.9)])
    of_plate, of_tracker = found.motions
    q = np.asarray(found.observations[0].q)
    tool = np.asarray(panda.arm.pose(q))[:, :3, 2]
    assert np.degrees(np.arccos(-tool @ normal)).max() <= 35 + 1e-4
    lift = np.asarray(panda.arm.position(of_plate.approach)) - np.asarray(panda.arm.position(q))
    np.testing.assert_allclose(lift, np.tile(30 * normal, (len(q), 1)), atol=1e-5)
    assert of_tracker.approach is None
    summary = kit_plan_summary(found, "Panda")
    assert summary["largest_tilt_deg"] == pytest.approx(math.degrees(of_plate.tilt.max()))
    rows = [line.split(",")[1:3] for line in plan_csv(found).splitlines()[1:]]
    assert rows.count(["approach", "plate"]) == rows.count(["pose", "plate"]) == len(q)
    assert rows.count(["approach", "tracker"]) == 0
    with pytest.raises(aj.InputError, match=r"'plate' at .* cannot be reached in enough poses"):
        aj.planning.plan_kit(
            panda.arm, [aj.planning.KitItem(plate, 0, "any", math.radians(2), (0, 0, -1.0))], candidates=100
        )


PAIR = {"A": (450, 100, 200), "B": (450, -300, 200)}
LOW = {"A": (450, 100, 5), "B": (450, -300, 200)}
REFUSED = {
    "narrow": (
        {"cone": {"A": Cone(math.radians(20), (0, 0, -1.0))}, "sockets": LOW},
        "'A' .* widen the cone",
    ),
    "obstacle": (
        {"cell": True, "sockets": {"A": (300, 600, 300), "B": (450, -300, 200)}},
        r"socket 'A' at \(300, 600, 300\) mm cannot be reached .* obstacles",
    ),
    "approach": ({"retract": 990.0}, "cannot be reached .* shorten retract"),
    "unknown": ({"cone": {"Q": Cone()}}, "unknown socket 'Q'"),
    "retract": ({"retract": -1.0}, "retract is -1 mm; it must be"),
    "tool": ({"tool_axis": (0.0, 0.0, 0.0)}, "tool.s axis has the length 0"),
}


@pytest.mark.first_rows(1)
@pytest.mark.parametrize("case", REFUSED)
def test_refused(panda, case):
    options, text = REFUSED[case]
    if "cell" in options:
        options = options | {"cell": Cell(body_along_links(panda.arm, RADIUS), (BOX,))}
    with pytest.raises(aj.InputError, match=text):
        aj.planning.plan(
            panda.arm, **({"sockets": PAIR, "lengths": [("A", "B")], "poses": 20, "candidates": 100} | options)
        )
