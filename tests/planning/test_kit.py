"""Plans with artefacts and instruments: information of the model's rows, placements, and files for all kinds."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import aacmm_jax as aj
from aacmm_jax.data import observations as kinds
from aacmm_jax.files.plans import plan_manifest, save_plan
from aacmm_jax.kinematics.workspace import search_region
from aacmm_jax.planning import KitItem, KitPlan, kit_placement, plan_kit
from aacmm_jax.planning.designs import Candidates, Objective, _best, covariance_of, exchange
from aacmm_jax.planning.kit_placement import candidates_of_kit, least_poses
from aacmm_jax.planning.problem import DesignProblem, Prediction
from aacmm_jax.summaries.planning import kit_plan_summary

from ..calibration.test_observed import BAR, BOX, FRAME, NOISE, SIMULATED

FEW = ("a_2", "a_3", "d_4", "theta_2", "theta_3")
EVERYTHING = [
    kinds.SimulatedSocket("hole", (400, 100, 300), 5),
    kinds.SimulatedPoints("tracker", BOX, 5, FRAME, u=0.02),
    kinds.SimulatedTransforms("T6", BOX, 5, (10, 20, 80, 0.1, 0.2, 0.3), FRAME, u=0.01, u_angle=1e-4),
    kinds.SimulatedSphere("ball", (300, 0, 300), 50.0, 5, u=0.001),
    *SIMULATED["planes"],
    kinds.SimulatedArtefact("bar", BAR, 5, (0, 0, 0, 300, 0, 200), u=0.001),
    kinds.SimulatedDistances("ballbar", BOX, 5, (900, 300, 100), u=0.003),
]


@pytest.fixture(scope="module")
def space(paper_arm):
    return aj.Parameters(paper_arm, FEW)


@pytest.fixture(scope="module")
def problem(space):
    region = search_region(space.base, None, 0.1, 0.0, 0)
    functions = np.random.default_rng(0).normal(size=(30, len(FEW)))
    return DesignProblem(region, space, NOISE, Objective("functions", functions, 8.0))


@pytest.mark.slow
@pytest.mark.parametrize(
    "which", [slice(1, 4, 2), pytest.param(slice(None), marks=pytest.mark.exhaustive)], ids=["two", "all"]
)
def test_information_is_that_of_a_calibration(paper_arm, space, problem, which):
    """The covariance that a plan predicts is what the calibration of its poses finds, for every kind at once."""
    simulated = [one.changed(poses=8) for one in EVERYTHING[which]]
    capture = aj.simulate(paper_arm, {}, observations=simulated, noise=aj.Noise(), seed=2)
    candidates = candidates_of_kit(problem, capture.observations)
    predicted = covariance_of(candidates.information(candidates.rows), len(FEW))
    # A plan predicts independent errors. Residuals without the noise that is stated seem to share some.
    result = aj.calibrate(paper_arm, capture, aj.Bounds.around(paper_arm, space), noise=NOISE, shared_errors=False)
    steps = np.asarray(space.scale)
    u = np.sqrt(np.diag(result.covariance))
    # Weights are those of the nominal arm here, and of the arm found there.
    np.testing.assert_allclose(
        predicted * np.outer(steps / u, steps / u), result.covariance / np.outer(u, u), atol=2e-3
    )


@pytest.mark.parametrize("kind", ["functions", "trace", "determinant"])
def test_candidates_of_six_rows(kind):
    """The best candidate is the one that improves the objective most; those of three rows, filled up, are the same."""
    random = np.random.default_rng(3)
    objective = Objective(kind, random.normal(size=(9, 4)), 2.0 if kind != "determinant" else 0.0)
    rows = random.normal(size=(15, 6, 7))
    rows[:8, 3:] = 0.0
    information = np.eye(7) + rows[0].T @ rows[0]
    allowed = np.ones(15, dtype=bool)
    candidates = Candidates(rows, np.zeros(15, dtype=int), np.eye(7), 4)
    best = _best(candidates, information, objective, allowed)
    if kind == "determinant":
        change = [objective.value(covariance_of(information + row.T @ row, 4)) for row in rows]
        assert best == np.argmin(change)
    three = Candidates(rows[:8, :3], candidates.owner[:8], candidates.base, 4)
    six = Candidates(rows[:8], candidates.owner[:8], candidates.base, 4)
    np.testing.assert_array_equal(exchange(three, 4, objective), exchange(six, 4, objective))


@pytest.mark.slow
def test_a_whole_plan(paper_arm, space, monkeypatch):
    """Placed within the region, every place with its poses, better than random poses, and what each part adds."""
    monkeypatch.setattr(kit_placement, "_PLACEMENTS", 4)
    monkeypatch.setattr(kit_placement, "_NEIGHBOURS", 3)
    items = [KitItem(EVERYTHING[6], places=2, turned="vertical"), EVERYTHING[1]]
    found = plan_kit(
        paper_arm, items, poses=20, space=space, region={"z": (100, 600)}, candidates=150, criterion="A", seed=1
    )
    assert [one.name for one in found.observations] == ["bar/1", "bar/2", "tracker"]
    assert found.parts == ("bar", "bar", "tracker")
    assert found.poses == 20
    for one, least in zip(found.observations, (3, 3, 3), strict=True):
        assert np.bincount(one.places).min() >= least
    assert {one.artefact for one in found.observations[:2]} == {"bar"}
    first, second = (np.asarray(one.frame) for one in found.kit[:2])
    assert np.abs(first[:2]).max() < 1e-12
    assert np.abs(first - second).max() > 1
    assert all(100 <= z <= 600 for frame in (first, second) for z in [frame[5]])
    for simulated, one in zip(found.kit[:2], found.observations[:2], strict=True):
        tips = np.asarray(paper_arm.position(one.q))
        points = simulated.changed(poses=1).tips(np.random.default_rng(0))
        assert np.abs(tips - points[list(one.owner)]).max() < 1e-5
    assert found.predicted.largest < found.random.largest
    assert found.more.largest <= found.predicted.largest * 1.001
    assert set(found.without) == {"bar", "tracker"}
    assert min(one.largest for one in found.without.values()) >= found.predicted.largest * 0.999
    summary = kit_plan_summary(found, "paper's")
    assert sum(place["poses"] for row in summary["observations"] for place in row["places"]) == 20


@pytest.mark.parametrize(
    "simulated",
    [
        kinds.SimulatedSphere("ball", (300, 0, 300), 50.0, 1, u=0.1, stylus=6.0),
        kinds.SimulatedCylinder("ring", ((300, 0, 300), (300, 0, 320)), 50.0, 1, u=0.1, stylus=6.0, inside=True),
    ],
    ids=["sphere", "cylinder"],
)
def test_candidates_have_the_certified_values_that_were_stated(problem, simulated):
    """Not those of a certificate drawn at random: the plan's manifest repeats them."""
    assert (
        float(kit_placement.set_up(problem.region, kit_placement.Thing(KitItem(simulated), simulated), 4).diameter)
        == 50.0
    )


@pytest.mark.slow
def test_files_of_every_kind_can_be_imported(paper_arm, tmp_path):
    """The manifest of a plan reads files that hold what it says: readings, and what was measured."""
    capture = aj.simulate(paper_arm, {}, observations=EVERYTHING, noise=aj.Noise(), seed=2)
    parts = tuple(one.name for one in EVERYTHING)
    none = [Prediction(0.0, 0.0)] * 4
    found = KitPlan(
        paper_arm, FEW, tuple(EVERYTHING), parts, capture.observations, NOISE, "length", 200.0, *none, without={}
    )
    save_plan(tmp_path / "plan.csv", found)
    rows = (tmp_path / "plan.csv").read_text().splitlines()
    assert len(rows) == 1 + found.poses
    assert rows[0].startswith("pose,observation,point,x_mm,y_mm,z_mm,q_1_deg")
    (tmp_path / "capture.toml").write_text(plan_manifest(found, "cheng2018-simulation"))
    for one in found.observations:
        stored = one.stored()
        extra = [np.zeros((one.q.shape[0], 0))]
        if "points" in stored:
            extra.append(np.asarray(stored["points"]))
        if "values" in stored:
            extra.append(np.asarray(stored["values"])[:, None])
        if "rotations" in stored:
            extra.append(Rotation.from_matrix(np.asarray(stored["rotations"])).as_quat(scalar_first=True))
        table = np.hstack([np.rad2deg(np.asarray(one.q)), *extra])
        held = stored.get("point", stored.get("side", np.full(len(table), "")))
        for point in dict.fromkeys(held.tolist()):
            name = f"{one.name}-{point}.csv" if point else f"{one.name}.csv"
            np.savetxt(tmp_path / name, table[held == point], delimiter=",", fmt="%.17g")
    read = aj.files.read_manifest(tmp_path / "capture.toml").capture
    known = {observation.name: observation for observation in read.observations} | dict(read.sockets)
    assert known.keys() == {one.name for one in found.observations}
    for one in found.observations:
        again = known[one.name]
        q = again if one.kind == "socket" else again.q
        np.testing.assert_allclose(q, one.q, atol=1e-12)
        if one.kind != "socket":
            assert again.unknowns == one.unknowns
            if hasattr(one, "points"):
                np.testing.assert_allclose(again.points, one.points, atol=1e-9)
                np.testing.assert_allclose(again.covariance, one.covariance, atol=1e-9)


def test_least_poses():
    """A bar has 12 unknowns and 2 points of 3 rows a pose; a certified sphere 4 and one; a plane 3 and one."""
    q = np.zeros((4, 6))
    bar = kinds.Artefact("bar", {"a": (0, 0, 0), "b": (1, 0, 0)}, {"a": q, "b": q}, u=0.001)
    sphere, plane = kinds.Sphere("ball", q, diameter=20.0, u=0.001), kinds.Plane("wall", q)
    np.testing.assert_array_equal(least_poses([bar, sphere, plane]), [3, 3, 5, 4])


@pytest.mark.first_rows(2)
@pytest.mark.parametrize(
    ("kit", "options", "text"),
    [
        ([], {}, "the kit is empty"),
        ([EVERYTHING[3], EVERYTHING[3]], {}, "two items of the kit have the name 'ball'"),
        ([KitItem(EVERYTHING[1], places=2)], {}, "'tracker' is an instrument, which the plan does not place"),
        ([kinds.SimulatedSphere("far", (5000, 0, 0), 50.0, 5)], {}, "'far' at .* cannot be reached"),
        ([EVERYTHING[1]], {"poses": 2}, "2 poses are too few for this kit; give at least 3"),
        ([EVERYTHING[3]], {"region": {"w": (0, 1)}}, "unknown key 'w'"),
    ],
)
def test_refused(paper_arm, space, kit, options, text):
    with pytest.raises(aj.InputError, match=text):
        plan_kit(paper_arm, kit, space=space, candidates=100, check_length=200.0, **options)


def bar(**options):
    simulated = kinds.SimulatedArtefact("bar", {"a": (400, 0, 300), "b": (500, 0, 300)}, 2, u=0.001)
    return KitItem(simulated, **options)


@pytest.mark.first_rows(1)
@pytest.mark.parametrize(
    ("item", "options", "text"),
    [
        (
            bar(places=0, half_angle=1e-5, normal=(1, 0, 0)),
            {},
            "widen the cone",
        ),
        (
            bar(places=0, half_angle=0.3, normal=(0, 0, -1)),
            {"retract": 500.0},  # under the table
            "shorten retract",
        ),
        (bar(half_angle=0.001), {"region": {"z": (200, 400)}}, "fewer placements, or wider cones"),
    ],
    ids=["cone", "approach", "placed"],
)
def test_what_cannot_be_reached_says_why(paper_arm, space, monkeypatch, item, options, text):
    monkeypatch.setattr(kit_placement, "_PLACEMENTS", 2)
    with pytest.raises(aj.InputError) as refused:
        plan_kit(paper_arm, [item], space=space, poses=20, candidates=100, check_length=200.0, **options)
    assert text in str(refused.value)


@pytest.mark.slow
def test_a_kit_that_leaves_parameters_open(paper_arm):
    """Touches of one sphere say nothing of where the arm stands or of its first offset."""
    with pytest.raises(aj.InputError, match="this kit cannot determine all parameters"):
        plan_kit(
            paper_arm,
            [EVERYTHING[3]],
            space=aj.Parameters(paper_arm, ("d_1", "a_2")),
            poses=12,
            candidates=100,
            check_length=200.0,
        )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("thing", "names", "held"),
    [(EVERYTHING[3], ("d_1", "a_2"), ("d_1",)), (EVERYTHING[1], ("d_1", "a_2"), ("d_1",)), (EVERYTHING[1], FEW, ())],
    ids=["sphere", "tracker", "tracker, nothing open"],
)
def test_what_a_kit_leaves_open_is_held_if_asked(paper_arm, thing, names, held):
    """Neither a sphere nor a tracker that stands anywhere says at which height the arm stands."""
    given = {"poses": 12, "candidates": 100, "check_length": 200.0, "hold_undetermined": True}
    planned = plan_kit(paper_arm, [thing], space=aj.Parameters(paper_arm, names), **given)
    assert planned.held == held
    assert {*planned.names} == {*names} - {*held}
    assert np.isfinite(planned.predicted.largest)
    seen = aj.observability(paper_arm, planned.capture(), aj.Parameters(paper_arm, planned.names))
    assert seen.rank == len(planned.names)
