"""Planning: exchange against all sets, plans that can be carried out, predictions that calibrations confirm."""

import inspect
import itertools
from inspect import unwrap  # calls a function without the run-time type checker of the tests

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.files.plans import plan_csv, plan_manifest, save_plan
from aacmm_jax.planning import placement as placements
from aacmm_jax.planning.designs import Candidates, Objective, covariance_of, exchange, relaxed_value
from aacmm_jax.planning.problem import DesignProblem, PlanOptions
from aacmm_jax.summaries.planning import plan as view
from aacmm_jax.summaries.planning import plan_summary

FUNCTIONS = np.random.default_rng(5).normal(size=(12, 3))
HELD = ("d_1", "theta_1", "theta_2", "a_6", "alpha_6", "probe_x", "probe_y")  # beta_2 for theta_2
OBJECTIVES = {
    "A": Objective("trace", FUNCTIONS, 0.0),
    "E": Objective("trace", FUNCTIONS, 8.0),
    "D": Objective("determinant", FUNCTIONS),
    "length": Objective("functions", FUNCTIONS, 8.0),
}


@pytest.fixture(scope="module")
def candidates() -> Candidates:
    """Twelve poses in two sockets, three parameters."""
    random = np.random.default_rng(1)
    rows = np.zeros((12, 3, 9))
    owner = np.arange(12) % 2
    rows[:, :, :3] = random.normal(size=(12, 3, 3)) * np.array([1.0, 3.0, 0.3])
    for i in range(12):
        rows[i, :, 3 + 3 * owner[i] : 6 + 3 * owner[i]] = -np.eye(3)
    base = 1e-4 * np.eye(9)
    tie = np.array([0, 0, 0, 1, 0, 0, -1, 0, 0.0])
    return Candidates(rows, owner, base + np.outer(tie, tie), 3)


def value_of(candidates, objective, chosen) -> float:
    return objective.value(covariance_of(candidates.information(candidates.rows[list(chosen)]), 3))


@pytest.mark.parametrize("name", OBJECTIVES)
def test_exchange_finds_nearly_the_best_of_all_sets(candidates, name):
    objective = OBJECTIVES[name]
    sets = [
        s for s in itertools.combinations(range(12), 6) if min(np.bincount(candidates.owner[list(s)], minlength=2)) >= 2
    ]
    values = sorted(value_of(candidates, objective, s) for s in sets)
    found = exchange(candidates, 6, objective)
    assert len(set(found)) == 6
    assert np.bincount(candidates.owner[found]).min() >= 2
    assert value_of(candidates, objective, found) <= np.quantile(values, 0.01)


def test_the_first_poses_are_chosen_right_although_nothing_is_determined_yet(candidates):
    """Information of 1e11 next to that of 1e-4: determinants written out without pivots would be rounding errors."""
    precise = candidates._replace(rows=3e5 * candidates.rows)
    chosen: list[int] = []
    for _ in range(4):
        others = [i for i in range(12) if i not in chosen]
        chosen.append(min(others, key=lambda i: value_of(precise, OBJECTIVES["D"], [*chosen, i])))
    assert exchange(precise, 4, OBJECTIVES["D"], least=0, sweeps=0).tolist() == chosen


@pytest.mark.parametrize("name", OBJECTIVES)
def test_a_relaxed_design_is_a_little_better_than_an_exact_one(candidates, name):
    """Fractions of poses include whole ones, and fewer iterations end at a larger value."""
    objective = OBJECTIVES[name]
    exact = value_of(candidates, objective, exchange(candidates, 6, objective))
    random, few, many = (relaxed_value(candidates, 6, objective, iterations) for iterations in (0, 8, 200))
    everything = candidates.base + 0.5 * (candidates.information(candidates.rows) - candidates.base)
    assert random == pytest.approx(objective.value(covariance_of(everything, 3)))
    assert many <= few <= random
    assert many <= exact


@pytest.mark.parametrize("name", OBJECTIVES)
def test_criteria_are_what_they_say(name):
    """Values by their definitions, and derivatives by differences."""
    factor = np.random.default_rng(2).normal(size=(3, 3))
    matrix = factor @ factor.T
    eigenvalues = np.linalg.eigvalsh(matrix)
    variances = np.einsum("vp,pq,vq->v", FUNCTIONS, matrix, FUNCTIONS)
    expected = {
        "A": np.log(eigenvalues.sum()),
        "E": np.log(np.sum(eigenvalues**9)) / 9,
        "D": np.mean(np.log(eigenvalues)),
        "length": np.log(np.mean(variances**9)) / 9,
    }[name]
    objective = OBJECTIVES[name]
    assert objective.value(matrix) == pytest.approx(expected)
    change = 1e-6 * (lambda m: m + m.T)(np.random.default_rng(3).normal(size=(3, 3)))
    difference = (objective.value(matrix + change) - objective.value(matrix - change)) / 2
    assert np.sum(objective.gradient(matrix) * change) == pytest.approx(difference, rel=1e-5)
    if name == "E":
        assert expected == pytest.approx(np.log(eigenvalues[-1]), abs=0.1)


@pytest.fixture
def quick(monkeypatch) -> None:
    """Fewer placements."""
    for name, value in {"_PLACEMENTS": 12, "_NEIGHBOURS": 2, "_DESIGNED": 2, "_STARTS": 200}.items():
        monkeypatch.setattr(placements, name, value)


@pytest.fixture(scope="module")
def given(paper_arm) -> aj.planning.Plan:
    """Twenty poses in the demonstration's sockets."""
    sockets = {"A": (400, 200, 300), "B": (700, 500, 500)}
    return aj.planning.plan(paper_arm, sockets=sockets, lengths=[("A", "B", 0.003)], poses=20, candidates=600, seed=4)


def test_poses_can_be_taken(paper_arm, given):
    """Tips in their sockets, joints within limits and margin, in the order of the sockets, the length as planned."""
    points = np.array(list(given.sockets.values()))
    np.testing.assert_allclose(paper_arm.position(given.q), points[given.owner], atol=1e-5)
    assert np.abs(given.q).max() <= np.radians(175) + 1e-12
    assert np.all(np.diff(given.owner) >= 0)
    heights = [paper_arm.position(given.q)[:, 2]]
    for joint in range(1, 6):  # origins of the frames: arms cut off after each joint
        part = aj.Arm(
            alpha=paper_arm.alpha[:joint],
            a=paper_arm.a[:joint],
            d=paper_arm.d[:joint],
            theta=paper_arm.theta[:joint],
            probe=(0, 0, 0),
        )
        heights.append(part.position(given.q[:, :joint])[:, 2])
    assert np.min(heights) >= -1e-6
    assert np.bincount(given.owner).min() >= 2
    (length,) = given.lengths
    assert (length.start, length.end, float(length.u)) == ("A", "B", 0.003)
    assert float(length.value) == pytest.approx(np.linalg.norm(points[1] - points[0]))


@pytest.mark.slow
def test_predictions_are_those_of_calibrations(paper_arm, given):
    """The prediction is the uncertainty of a joint calibration on the planned capture."""
    bounds = aj.Bounds.around(paper_arm, aj.Parameters.free_of(paper_arm))
    result = aj.calibrate(paper_arm, given.capture(), bounds, method="joint", noise=given.noise)
    volume = aj.volumetric_uncertainty(aj.uncertainty_of(result), length=given.check_length, points=400, seed=9)
    # Other lengths than those of the prediction, so only the middle of them is alike.
    assert np.median(volume.u_length) == pytest.approx(given.predicted.median, rel=0.1)


@pytest.mark.slow
def test_a_plan_is_better_than_random_poses_and_ten_more_are_better_still(given):
    assert given.predicted.largest < 0.9 * given.random.largest
    assert given.predicted.median < given.random.median
    assert given.more.largest < given.predicted.largest
    assert given.loose.largest == pytest.approx(given.predicted.largest, rel=0.1)


@pytest.mark.slow
def test_placements_are_in_the_region_and_the_range(paper_arm, quick):
    region = {"z": (100.0, 900.0), "distance": (300.0, 1200.0)}
    reported = []
    found = aj.planning.plan(
        paper_arm,
        sockets=3,
        poses=15,
        length=(300.0, 600.0),
        region=region,
        farthest=0.7,
        candidates=300,
        criterion="D",
        progress=lambda stage, fraction: reported.append((stage, fraction)),
    )
    points = np.array(list(found.sockets.values()))
    assert list(found.sockets) == ["A", "B", "C"]
    assert np.all((points[:, 2] >= 100) & (points[:, 2] <= 900))
    assert np.all((np.linalg.norm(points, axis=1) >= 300) & (np.linalg.norm(points, axis=1) <= 1200))
    assert 300 <= float(found.lengths[0].value) <= 600
    reach = aj.kinematics.arm_reach(paper_arm)
    assert np.linalg.norm(points - reach.shoulder, axis=1).max() <= 0.7 * reach.radius
    assert list(dict.fromkeys(stage for stage, _ in reported)) == [
        "Placing the sockets", "Choosing poses"
    ]  # fmt: skip
    assert all(0 <= fraction <= 1 for _, fraction in reported)


@pytest.mark.slow
def test_placements_keep_off_the_end_of_the_reach(paper_arm):
    """By default off the last 5 %, in whatever ranges are given."""
    reach = aj.kinematics.arm_reach(paper_arm)
    along = reach.shoulder + reach.radius * np.outer([0.94, 0.96, 1.0], [1.0, 0.0, 0.0])
    defaults = inspect.signature(aj.planning.plan).parameters["farthest"].default
    for ranges in (None, {"x": (-5000.0, 5000.0)}):
        problem = DesignProblem.of(paper_arm, PlanOptions(region=ranges))
        assert problem.contains(along).tolist() == [True, False, False]
        problem = DesignProblem.of(paper_arm, PlanOptions(region=ranges, farthest=1.0))
        assert problem.contains(along).tolist() == [True, True, True]
    assert inspect.signature(aj.planning.plan_kit).parameters["farthest"].default == defaults


@pytest.mark.parametrize(
    ("options", "z"),
    [
        ({}, (20, 1000)),
        ({"above": -400.0}, (-380, 600)),
        ({"above": -np.inf}, (-np.inf, np.inf)),
        ({"region": {"x": (0.0, 500.0)}}, (20, 1000)),
        ({"region": {"z": (0.0, np.inf)}}, (0, np.inf)),
    ],
)
def test_by_default_what_is_placed_is_between_the_table_and_a_hand(options, z):
    assert PlanOptions(**options).ranges["z"] == z


@pytest.mark.slow
def test_the_same_seed_gives_the_same_plan(paper_arm, quick):
    """And keeps to the usual heights, at a cost that it states."""
    options = {"sockets": 2, "poses": 12, "candidates": 200, "seed": 3}
    one, other = (aj.planning.plan(paper_arm, **options, unconstrained=number == 1) for number in range(2))
    np.testing.assert_array_equal(one.q, other.q)
    assert all(20 <= z <= 1000 for *_, z in one.sockets.values())
    assert other.unconstrained.largest <= other.predicted.largest
    printed = [" ".join(str(line) for line in view(plan_summary(found, "an arm"))) for found in (one, other)]
    assert "Limits: sockets at z from 20 mm to 1000 mm (--region). To see what these limits cost" in printed[0]
    assert "12 poses planned without limits of height, direction, obstacles and approach points" in printed[1]
    assert "To see what" not in printed[1]


@pytest.mark.slow
def test_files(given, tmp_path):
    save_plan(tmp_path / "plan.csv", given)
    lines = (tmp_path / "plan.csv").read_text().splitlines()
    columns = ["pose", "socket", *(f"{axis}_mm" for axis in "xyz"), *(f"q_{i}_deg" for i in range(1, 7))]
    assert lines[0].split(",") == [*columns, *(f"probe_direction_{axis}" for axis in "xyz")]
    assert len(lines) == 21
    angles = np.array([[float(cell) for cell in line.split(",")[5:11]] for line in lines[1:]])
    np.testing.assert_allclose(np.radians(angles), given.q, atol=1e-5)
    named = given._replace(sockets={'left, "low"': (1.0, 2.0, 3.0), "B": (4.0, 5.0, 6.0)})
    assert '1,"left, ""low""",1.000' in plan_csv(named)
    summary = plan_summary(given, "an arm")
    assert sum(row["poses"] for row in summary["sockets"]) == 20


@pytest.mark.slow
def test_readings_taken_by_the_plan_come_back_through_its_manifest(paper_arm, given, tmp_path):
    (tmp_path / "capture.toml").write_text(plan_manifest(given, "cheng2018-simulation"))
    for name, q in given.capture().sockets.items():
        np.savetxt(tmp_path / f"{name}.csv", np.degrees(q), delimiter=",")
    imported = aj.files.read_manifest(tmp_path / "capture.toml").capture
    assert imported.names == tuple(given.sockets)
    np.testing.assert_allclose(imported.q, given.q, rtol=1e-12)
    (length,), (planned,) = imported.lengths, given.lengths
    assert (length.start, length.end, float(length.u)) == (planned.start, planned.end, float(planned.u))
    assert float(length.value) == pytest.approx(float(planned.value), abs=1e-6)


REFUSED = {
    "too few": ({"poses": 5}, "too few for 4 sockets"),
    "equations": ({"poses": 9, "sockets": 4}, "plan at least 11"),
    "criterion": ({"criterion": "B"}, "criterion is 'B'; choose one of length, A, D, E"),
    "margin": ({"margin": 4.0}, "no range of motion between the limits"),
    "u": ({"u": 0.0}, "u of a reference length is 0 mm"),
    "length": ({"length": 9000.0}, "does not fit this arm"),
    "range": ({"length": (500.0, 300.0)}, "does not fit this arm"),
    "region": ({"region": {"r": (0.0, 1.0)}}, "unknown key 'r'"),
    "far region": ({"region": {"x": (5000.0, 6000.0)}}, "no placement of the sockets"),
    "far socket": ({"sockets": {"A": (5000, 0, 0), "B": (400, 200, 300)}}, "cannot be reached"),
    "two coordinates": ({"sockets": {"A": (400, 200), "B": (400, 300, 300)}}, "give its three coordinates"),
    "no u": (
        {"sockets": {"A": (400, 200, 300), "B": (400, 300, 300)}, "lengths": [("A", "B", 0.0)]},
        "u of a reference length is 0",
    ),
    "twice": (
        {"sockets": {"A": (400, 200, 300), "B": (400, 300, 300)}, "lengths": [("A", "B"), ("B", "A")]},
        "given twice",
    ),
    "itself": (
        {"sockets": {"A": (400, 200, 300), "B": (400, 300, 300)}, "lengths": [("A", "A")]},
        "joins a socket to itself",
    ),
    "same position": (
        {"sockets": {"A": (400, 200, 300), "B": (400, 200, 300)}, "lengths": [("A", "B")]},
        "at the same position",
    ),
    "beyond the reach": ({"farthest": 1.2}, "farthest is 1.2; it must be"),
    "no range": ({"region": {"z": (10.0, 0.0)}}, "which is not a range"),
    "under the table": ({"above": 2000.0, "region": {"z": (0.0, np.inf)}}, "reaches all sockets"),
    "high table": ({"above": 3000.0}, "no placement of the sockets.*z from 3020 to 4000 mm"),
    "no length": (
        {"sockets": {"A": (400, 200, 300), "B": (400, 300, 300)}},
        "cannot determine all parameters.*the scale",
    ),
    "unknown end": (
        {"sockets": {"A": (400, 200, 300), "B": (400, 300, 300)}, "lengths": [("A", "C")]},
        "unknown socket 'C'",
    ),
    "lengths without sockets": ({"lengths": [("A", "B")]}, "between sockets with given positions"),
}


@pytest.mark.first_rows(5)
@pytest.mark.parametrize("case", REFUSED)
def test_refused(paper_arm, quick, case):
    options, text = REFUSED[case]
    with pytest.raises(aj.InputError, match=text):
        unwrap(aj.planning.plan)(paper_arm, **({"candidates": 200, "poses": 30} | options))
