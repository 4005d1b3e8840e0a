"""What captures determine: ranks and null spaces known from the literature and from a reading of the paper (AUDIT)."""

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.data import observations as kinds

BOX = [[200, -300, 100], [600, 300, 500]]
ENDS = [((400, 200, 300), (600, 200, 300)), ((300, 400, 500), (300, 600, 500))]


@pytest.fixture(scope="module")
def single(paper_arm) -> aj.Capture:
    return aj.simulate(paper_arm, {"A": (400, 200, 300)}, poses=70)


@pytest.fixture(scope="module")
def parallel_arm() -> aj.Arm:
    """Three parallel axes, as on many robots."""
    return aj.Arm(
        alpha=np.radians([90, 0, 0, 90, -90, 0]),
        a=[0, -425, -392, 0, 0, 0],
        d=[89, 0, 0, 109, 95, 82],
        probe=(30, 10, 100),
    )


def pairs(arm, positions) -> aj.Capture:
    """400 measurements of a length standard, in so many positions, each between two single poses: no repeatability."""
    sockets, lengths = {}, []
    for i in range(400):
        sockets[f"a{i}"], sockets[f"b{i}"] = positions[i % len(positions)]
        lengths.append((f"a{i}", f"b{i}"))
    return aj.simulate(arm, sockets, poses=1, lengths=lengths)


# The paper's numbers: fixed parameters, number of lengths, rank, and the directions that nothing determines.
RANKS = {
    "25 on one socket": (
        ("probe_x", "probe_y"),
        0,
        20,
        {"all lengths together: the scale", "d_1", "theta_1", "a_6 and theta_6 trade off", "alpha_6 and d_6 trade off"},
    ),
    "21 on one socket": (None, 0, 20, {"all lengths together: the scale"}),
    "21 with one length": (None, 1, 21, set()),
}


@pytest.mark.first_rows(2)
@pytest.mark.parametrize("noise", [None, aj.Noise(encoder_arcsec=2.0, seating=0.005)], ids=["plain", "whitened"])
@pytest.mark.parametrize("case", RANKS)
def test_rank_and_null_space_of_the_paper(paper_arm, single, paper_capture, case, noise):
    held, lengths, rank, directions = RANKS[case]
    seen = aj.observability(
        paper_arm, paper_capture if lengths else single, aj.Parameters.free_of(paper_arm, held=held), noise=noise
    )
    assert seen.rank == rank
    assert {text.replace(" (has no effect on the measurements)", "") for text in seen.undetermined} == directions
    structural = {text for text, never in zip(seen.undetermined, seen.structural, strict=True) if never}
    assert not any("scale" in text for text in structural)
    assert len(structural) == len(directions) - ("all lengths together: the scale" in directions)
    if not lengths:
        assert seen.remedy == "A reference length would determine these parameters."


def test_directions_move_nothing(paper_arm, single):
    """A finite step along each named direction leaves the tips of a socket together."""
    space = aj.Parameters.free_of(paper_arm, held=("probe_x", "probe_y"))
    seen = aj.observability(paper_arm, single, space)
    for direction in seen.null.T:
        moved = space.arm(np.asarray(space.vector()) + 1e-3 * direction * np.asarray(space.scale))
        tips = np.asarray(moved.position(single.q))
        assert np.abs(tips - tips.mean(axis=0)).max() < 1e-6  # of steps of 1e-3 mm and 1e-6 rad, to second order


@pytest.mark.slow
@pytest.mark.parametrize(("positions", "rank"), [(1, 19), pytest.param(2, 21, marks=pytest.mark.slow)])
def test_lengths_alone(paper_arm, positions, rank):
    seen = aj.observability(paper_arm, pairs(paper_arm, ENDS[:positions]))
    assert seen.rank == rank
    if positions == 1:
        assert seen.remedy  # tried out: it says what would help
        assert not any(seen.structural)


def test_an_arm_off_by_mm_is_judged_alike(paper_arm):
    """Scattered tips would make d_1, theta_1 and the scale look determined."""
    space = aj.Parameters.free_of(paper_arm, held=("probe_x", "probe_y"))
    true = aj.perturbed_arm(aj.Parameters.free_of(paper_arm), length=3.0, angle=0.005, seed=2)
    capture = aj.simulate(true, {"A": (400, 200, 300)}, poses=60, encoder_arcsec=5.0, seating=0.01)
    assert aj.observability(paper_arm, capture, space).rank == 20


def test_indices_of_a_known_spectrum(paper_arm, paper_capture):
    """O1 to O5 by their definitions; all zero where a direction is lost."""
    seen = aj.observability(paper_arm, paper_capture)
    s, m = seen.singular, 71
    assert seen.indices == pytest.approx({
        "O1": np.prod(s) ** (1 / 21) / np.sqrt(m), "O2": s[-1] / s[0], "O3": s[-1], "O4": s[-1] ** 2 / s[0],
        "O5": 1 / np.sum(1 / s),
    })  # fmt: skip
    assert np.all(np.diff(s) <= 0)
    assert seen.condition < s[0] / s[-1] * 2
    assert set(seen._replace(singular=np.append(seen.singular[:-1], 0.0)).indices.values()) == {0.0}


def test_calibrate_warns_or_refuses(paper_arm, paper_capture):
    space = aj.Parameters.free_of(paper_arm, held=("d_1", "theta_1", "a_6", "probe_x", "probe_y"))
    bounds = aj.Bounds.around(paper_arm, space)
    with pytest.warns(aj.IdentifiabilityWarning, match="alpha_6 and d_6 trade off"):
        aj.calibrate(paper_arm, paper_capture, bounds)
    with pytest.raises(aj.InputError, match="alpha_6 and d_6 trade off"):
        aj.calibrate(paper_arm, paper_capture, bounds, undetermined="raise")


def test_what_few_poses_need(paper_arm, paper_capture):
    few = aj.Capture({"A": paper_capture.q[:5], "B": paper_capture.q[70:]}, paper_capture.lengths)
    (sentence,) = aj.observability(paper_arm, few).sentences()
    assert "4 more combinations. " in sentence
    assert "More poses in a socket" in sentence


@pytest.mark.first_rows(2)
@pytest.mark.parametrize("lengths", [0, 1])
def test_independent_parameters_are_the_papers(paper_arm, single, paper_capture, lengths):
    """With a length the 21; without, the longest link is fixed too. All are determined, none could be added."""
    capture = paper_capture if lengths else single
    chosen = aj.Parameters.independent(paper_arm, capture)
    default = set(aj.Parameters.free_of(paper_arm).names)
    assert set(chosen.names) == (default if lengths else default - {"d_3"})
    assert aj.observability(paper_arm, capture, chosen).rank == len(chosen.names)


@pytest.mark.first_rows(2)
@pytest.mark.parametrize(
    ("sockets", "certified", "target", "fixed"),
    [
        ({}, True, "", set()),
        ({}, False, "", {"d_3"}),  # the scale
        ({"A": (400, 200, 300)}, True, "", set()),
        ({}, True, "ball", {"theta_6", "d_6", "probe_z"}),  # its place is unknown
    ],
    ids=["points", "no scale", "points and a socket", "of a target"],
)
def test_independent_parameters_of_other_observations(paper_arm, sockets, certified, target, fixed):
    """Positions in a frame of their own, with sockets or without, determine what sockets with a length do."""
    if certified:
        place = (0, 60, 100) if target else None
        things = [kinds.SimulatedPoints("T", BOX, 40, (0.1, 0.2, 0.3, 900, 0, 0), u=0.01, target=target, place=place)]
    else:
        things = [kinds.SimulatedSphere("ball", (350, 100, 300), 100.0, 40, certified=False)]
    capture = aj.simulate(paper_arm, sockets, poses=8, observations=things, seed=2)
    chosen = aj.Parameters.independent(paper_arm, capture)
    assert set(chosen.names) == set(aj.Parameters.free_of(paper_arm).names) - fixed
    if certified:
        assert aj.observability(paper_arm, capture, chosen).rank == len(chosen.names)


def test_independent_parameters_of_a_straight_wrist():
    """The Panda's probe lies along its last axis: theta_6 and alpha_6 are imitated by a_6, d_6 and the probe."""
    panda = aj.load_arm("panda")
    capture = aj.simulate(panda, {"A": (400, 200, 300), "B": (450, 200, 300)}, poses=40, lengths=[("A", "B")])
    chosen = aj.Parameters.independent(panda, capture)
    assert set(chosen.held) == {"d_1", "theta_1", "a_7", "alpha_7", "theta_7", "d_7", "theta_6", "alpha_6"}
    assert len(chosen.names) == 23


def test_parallel_axes_get_hayatis_angle(parallel_arm):
    capture = aj.simulate(parallel_arm, {"A": (400, 200, 300), "B": (450, 200, 300)}, poses=40, lengths=[("A", "B")])
    seen = aj.observability(parallel_arm, capture)
    assert seen.parallel == (2, 3)
    assert "free beta_2" in " ".join(seen.sentences())
    chosen = aj.Parameters.independent(parallel_arm, capture)
    assert {"beta_2", "beta_3"} <= set(chosen.names)
    assert {"d_2", "d_3"} <= set(chosen.held)
    after = aj.observability(chosen.base, capture, chosen)
    assert after.rank == len(chosen.names) == 21
    assert not after.sentences()


def test_misfit_of_capture_and_arm(paper_arm):
    capture = aj.Capture({"A": np.zeros((3, 4))})
    for ask in (lambda: aj.observability(paper_arm, capture), lambda: aj.Parameters.independent(paper_arm, capture)):
        with pytest.raises(aj.InputError, match="4 columns, but the arm has 6 joints"):
            ask()
