"""Requirements of standards: a complete procedure bears the standard's name, one that breaks any of them does not."""

import math
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import aacmm_jax as aj
from aacmm_jax.acceptance import geometry, measured_by, run
from aacmm_jax.acceptance.geometry import elbow_sides
from aacmm_jax.acceptance.procedure import plan_procedure, simulate_procedure
from aacmm_jax.acceptance.requirements import TESTS, Confidence, requirements_table
from aacmm_jax.acceptance.results import Measured
from aacmm_jax.kinematics.workspace import arm_reach
from tests.example_counts import example_count

ISO = ("probing size and form", "articulated location", "length error")
ASME = ("effective diameter", "single-point articulation", "volumetric")
JJF = "single point and length, as in Cheng et al. 2018"


@pytest.fixture(scope="module")
def cheng():
    return aj.files.load_specification("cheng2018-simulation")


@pytest.fixture(scope="module")
def complete(cheng) -> dict[str, Measured]:
    """Noise-free measurements of the planned procedures."""
    found = {}
    for standard in ("iso", "asme", "jjf"):
        planned = plan_procedure(cheng.arm, standard, above=50.0, margin=math.radians(10), measuring_range=2700.0)
        recorded = simulate_procedure(planned, cheng, cheng)
        found[standard] = measured_by(cheng.arm, recorded)
    return found


def missing(measured: Measured, title: str) -> tuple[str, ...]:
    (test,) = [test for test in run(measured) if test.title == title]
    assert test.called.startswith("based on") == bool(test.missing)
    return test.missing


@pytest.mark.slow
@pytest.mark.parametrize(("standard", "titles"), [("iso", ISO), ("asme", ASME), ("jjf", (JJF,))])
def test_a_complete_procedure_bears_the_standards_name(complete, standard, titles):
    for title in titles:
        assert missing(complete[standard], title) == ()


def spheres(measured: Measured, test: str, change, which=slice(None)) -> Measured:
    """The spheres of one test changed; ``which`` of them."""
    chosen = [sphere for sphere in measured.spheres if sphere.test == test][which]
    changed = tuple(change(s) if any(s is one for one in chosen) else s for s in measured.spheres)
    return measured._replace(spheres=tuple(sphere for sphere in changed if sphere is not None))


def each_group(change):
    return lambda sphere: sphere._replace(groups=tuple(change(group, sphere) for group in sphere.groups))


def centre(group):
    return aj.acceptance.fit_sphere(group).centre


def cap(group, sphere):
    return centre(group) + (sphere.diameter + sphere.stylus) / 2 * around_the_pole(len(group))


def around_the_pole(count):
    """The recommended touches at half their angles from the pole."""
    directions = geometry.touch_directions(count)
    polar = np.arccos(directions[:, 2]) / 2
    return np.column_stack([np.sin(polar)[:, None] * geometry.unit_rows(directions[:, :2] @ np.eye(2, 3))[:, :2],
                            np.cos(polar)])  # fmt: skip


def straight_rings(group, sphere):
    """Two rings of four touches on the same meridians."""
    rows = [[0, 0, 1]]
    for height in (0.7, 0.0):
        rows += [[math.sqrt(1 - height**2) * math.cos(a), math.sqrt(1 - height**2) * math.sin(a), height]
                 for a in np.arange(4) * math.pi / 2]  # fmt: skip
    return centre(group) + (sphere.diameter + sphere.stylus) / 2 * np.array(rows)


def bars(measured: Measured, move, which) -> Measured:
    """The ends of bars moved: ``move(number, start, end)``, a number for each bar that ``which`` names."""
    sockets = dict(measured.sockets)
    chosen = [length for length in measured.lengths if which(length)]
    for number, length in enumerate(chosen):
        start, end = (sockets[name] for name in (length.start, length.end))
        sockets[length.start], sockets[length.end] = move(number, start, end)
    return measured._replace(sockets=sockets)


def along(direction):
    """Every bar turned about its middle into one direction."""

    def move(number, start, end):
        middle, half = (start + end) / 2, np.linalg.norm(end - start, axis=1)[:, None] / 2
        way = np.array(direction(number), dtype=float)
        way /= np.linalg.norm(way)
        return middle - half * way, middle + half * way

    return move


def to_one_place(number, start, end):
    middle = (start + end) / 2
    return start - middle + [400.0, 0, 300.0], end - middle + [400.0, 0, 300.0]


def parallel_and_near(number, start, end):
    """What was once called complete: parallel bars 20 mm apart."""
    half = np.linalg.norm(end - start, axis=1)[:, None] / 2 * [1, 0, 0]
    middle = np.array([400.0, 20.0 * number, 300.0])
    return middle - half, middle + half


def without_length(name):
    return lambda measured: measured._replace(
        lengths=tuple(length for length in measured.lengths if not length.start.startswith(name))
    )


def one_bar(length):
    return length.start.startswith("bar1")


def every(length):
    return True


def repeated(measured: Measured) -> Measured:
    """The last position of the first bar is the first again."""
    sockets = dict(measured.sockets)
    first, *_, last = [length for length in measured.lengths if one_bar(length)]
    sockets[last.start], sockets[last.end] = sockets[first.start] + 1.0, sockets[first.end] + 1.0
    return measured._replace(sockets=sockets)


def fewer_readings(measured: Measured) -> Measured:
    """One position has two readings; more elsewhere do not make up for it."""
    more = {name: np.repeat(points, 2, axis=0) for name, points in measured.sockets.items() if name.startswith("bar2")}
    return measured._replace(sockets={**measured.sockets, **more, "bar1/01/a": measured.sockets["bar1/01/a"][:2]})


def scaled_bar(name, factor):
    """A bar of another length."""

    def change(measured: Measured) -> Measured:
        shorter = bars(
            measured, lambda n, start, end: (start, start + factor * (end - start)), lambda x: x.start.startswith(name)
        )
        return shorter._replace(
            lengths=tuple(
                length if not length.start.startswith(name)
                else aj.ReferenceLength(length.start, length.end, factor * float(length.value))
                for length in measured.lengths
            )
        )  # fmt: skip

    return change


def without_socket(name):
    return lambda m: m._replace(sockets={key: points for key, points in m.sockets.items() if key != name})


def elbow(angle):
    def change(m: Measured) -> Measured:
        assert m.postures is not None
        sides = {name: np.full_like(sides, angle) for name, sides in m.postures.elbows.items()}
        return m._replace(postures=m.postures._replace(elbows=sides))

    return change


def one_orientation(m: Measured) -> Measured:
    assert m.postures is not None
    probes = {key: tuple(groups[:1] * len(groups)) for key, groups in m.postures.probes.items()}
    return m._replace(postures=m.postures._replace(probes=probes))


def no_range(m: Measured) -> Measured:
    return m._replace(measuring_range=None)


def together(sphere):
    shift = np.array([400.0, 0.0, 300.0]) - centre(sphere.groups[0])
    return sphere._replace(groups=tuple(group + shift for group in sphere.groups))


# One row a requirement: the procedure that breaks it alone, and words of the only sentence that says so.
BROKEN = [
    ("iso", ISO[0], lambda m: spheres(m, "probing", lambda s: s._replace(diameter=60.0)), "10 to 51 mm"),
    ("iso", ISO[0], lambda m: spheres(m, "probing", each_group(lambda g, s: g[:24])), "25 points per group"),
    ("iso", ISO[0], lambda m: spheres(m, "probing", each_group(cap), slice(1)), "spread over a hemisphere"),
    (
        "iso",
        ISO[0],
        lambda m: spheres(m, "probing", lambda s: None, slice(1)),
        "far apart; the number of positions measured is 1",
    ),
    ("iso", ISO[0], lambda m: spheres(m, "probing", together), "far apart; the number of positions measured is 1"),
    ("iso", ISO[0], no_range, "measuring range"),
    ("iso", ISO[1], lambda m: spheres(m, "articulation", lambda s: s._replace(diameter=60.0)), "10 to 51 mm"),
    ("iso", ISO[1], lambda m: spheres(m, "articulation", lambda s: s._replace(groups=s.groups[:4])), "5 orientations"),
    ("iso", ISO[1], lambda m: spheres(m, "articulation", each_group(lambda g, s: g[:4])), "5 points per group"),
    ("iso", ISO[1], lambda m: spheres(m, "articulation", each_group(cap), slice(1)), "spread over a hemisphere"),
    ("iso", ISO[1], one_orientation, "orientations of the probe must differ"),
    ("iso", ISO[1], lambda m: m._replace(postures=None), "orientations of the probe; record"),
    ("iso", ISO[1], lambda m: spheres(m, "articulation", lambda s: None, slice(1)), "2 positions that are far apart"),
    ("iso", ISO[1], no_range, "measuring range"),
    ("iso", ISO[2], without_length("bar1"), "5 different lengths"),
    ("iso", ISO[2], without_length("bar2/07"), "7 different positions of every length"),
    ("iso", ISO[2], repeated, "7 different positions of every length"),
    ("iso", ISO[2], fewer_readings, "3 readings in each position are required (one position has 2"),
    ("iso", ISO[2], lambda m: bars(m, along(lambda n: (1, 0, 0)), one_bar), "not all in one plane"),
    ("iso", ISO[2], lambda m: bars(m, along(lambda n: (math.cos(n), math.sin(n), 0)), one_bar), "not all in one plane"),
    ("iso", ISO[2], lambda m: bars(m, to_one_place, one_bar), "scatter by 0.0 %"),
    ("iso", ISO[2], no_range, "measuring range"),
    ("iso", ISO[2], scaled_bar("bar5", 0.9), "A length of 1782 mm or more"),
    ("asme", ASME[0], lambda m: spheres(m, "effective-diameter", lambda s: s._replace(diameter=51.0)), "10 to 50 mm"),
    ("asme", ASME[0], lambda m: spheres(m, "effective-diameter", each_group(lambda g, s: g[:8])), "9 points"),
    (
        "asme",
        ASME[0],
        lambda m: spheres(m, "effective-diameter", lambda s: s._replace(groups=s.groups[:2])),
        "3 repeats",
    ),
    ("asme", ASME[0], lambda m: spheres(m, "effective-diameter", each_group(cap)), "spread over a hemisphere"),
    ("asme", ASME[0], lambda m: spheres(m, "effective-diameter", each_group(straight_rings)), "at least 22.5 deg"),
    ("asme", ASME[1], without_socket("spat/near"), "at 0 to 20 % of the reach (0 to 270 mm"),
    ("asme", ASME[1], lambda m: m._replace(reach=None), "zones of the reach cannot be determined"),
    ("asme", ASME[1], elbow(1.0), "with the elbow on the left"),
    ("asme", ASME[1], elbow(0.0), "with the elbow on the left"),
    ("asme", ASME[1], lambda m: m._replace(postures=None), "side the elbow was"),
    ("asme", ASME[1], no_range, "measuring range"),
    ("asme", ASME[2], without_length("bar1/0"), "Each bar must be measured in 5 positions"),
    ("asme", ASME[2], scaled_bar("bar1", 0.5), "A bar of 50 to 75 %"),
    ("asme", ASME[2], without_length("bar1/07"), "20 different positions are required (19 given)"),
    ("asme", ASME[2], repeated, "20 different positions are required (19 given)"),
    ("asme", ASME[2], lambda m: bars(m, along(lambda n: (math.cos(n), math.sin(n), 0)), every), "not all in one plane"),
    ("asme", ASME[2], lambda m: bars(m, to_one_place, every), "scatter by 0.0 %"),
    ("asme", ASME[2], no_range, "measuring range"),
    ("jjf", JJF, without_socket("socket/middle"), "10 poses"),
    ("jjf", JJF, lambda m: m._replace(lengths=m.lengths[1:]), "30 different positions are required (29 given)"),
]


@pytest.mark.first_rows(1)
@pytest.mark.parametrize(("standard", "title", "breaks", "words"), BROKEN)
def test_a_procedure_that_breaks_one_requirement_is_incomplete(complete, standard, title, breaks, words):
    """Every requirement that can be checked has a procedure that breaks it, and that only it speaks of."""
    found = missing(breaks(complete[standard]), title)
    assert any(words in sentence for sentence in found), found
    # A spread that is lost, or a bar left out, costs other requirements too.
    assert len(found) <= (2 if "0.0 %" in words or "5 positions" in words else 1), found


def test_every_requirement_that_is_checked_has_a_procedure_that_breaks_it():
    checked = {(test.title, one.says) for test in TESTS for one in test.requirements if one.lacking is not None}
    broken = {(title, words) for _, title, _, words in BROKEN}
    assert len(broken) >= len(checked)
    assert {title for title, _ in broken} == {title for title, _ in checked}
    assert {one.confidence for test in TESTS for one in test.requirements} <= set(get_args(Confidence))


@pytest.mark.slow
def test_parallel_bars_beside_each_other_and_touches_of_a_cap_are_no_complete_test(complete):
    """105 readings of 35 parallel bars 20 mm apart, and 25 touches around the pole."""
    near = bars(complete["iso"], parallel_and_near, every)
    assert sum(map(len, near.sockets.values())) == 210
    assert len(missing(near, "length error")) >= 2
    assert missing(spheres(complete["iso"], "probing", each_group(cap)), "probing size and form")


def test_the_table_of_requirements_is_that_of_the_documentation():
    page = Path(__file__).parents[2] / "docs" / "standards.md"
    assert requirements_table() in page.read_text()


@settings(deadline=None, max_examples=example_count(5))
@given(st.integers(0, 10**6), st.sampled_from([25, 9, 5]), st.floats(0.0, 0.08))
def test_touches_by_hand_in_any_orientation_are_recognised(seed, count, off):
    """The recommended pattern, turned at random and touched some degrees away from it."""
    random = np.random.default_rng(seed)
    turned = Rotation.random(rng=random).apply(geometry.touch_directions(count))
    directions = geometry.unit_rows(turned + off / math.sqrt(3) * random.uniform(-1, 1, size=(count, 3)))
    assert geometry.covers_hemisphere([1.0, 2.0, 3.0] + 15 * directions, count)
    assert not geometry.covers_hemisphere(15 * around_the_pole(count), count)


@pytest.mark.parametrize(("count", "turn"), [(25, 22.5), (9, 45.0)])
def test_rings_of_the_recommended_touches_are_turned(count, turn):
    assert math.degrees(geometry.least_turn(geometry.touch_directions(count))) == pytest.approx(turn)


def test_the_side_of_the_elbow():
    """A planar arm that turns about the vertical: shoulder, elbow up or to a side, tip straight ahead along x."""
    arm = aj.Arm(alpha=[-math.pi / 2, 0.0], a=[0.0, 300.0], d=[0.0, 0.0], theta=[0, 0], probe=[0.0, 300.0, 0.0])
    up = elbow_sides(arm, np.array([[0.0, -math.pi / 4]]), arm_reach(arm))
    assert up == pytest.approx([0.0], abs=1e-9)
    flat = aj.Arm(alpha=[0.0, 0.0], a=[300.0, 0.0], d=[0.0, 0.0], theta=[0, 0], probe=[300.0, 0.0, 0.0])
    left, right = elbow_sides(flat, np.array([[0.5, -1.0], [-0.5, 1.0]]), arm_reach(flat))
    assert (left, right) == pytest.approx((math.pi / 2, -math.pi / 2))


# --- Influences ---


def test_thermal_expansion_by_hand():
    """A steel bar of 1 m at 22 C is 23 um longer; u: 2 K x 1e-6, 11.5e-6 x 0.1 K and their product 1e-7, on 1 m."""
    warm = aj.acceptance.Expansion(11.5e-6, 1e-6, 22.0, 0.1)
    assert warm.relative == pytest.approx(23e-6)
    assert warm.u == pytest.approx(math.sqrt(2.0**2 + 1.15**2 + 0.1**2) * 1e-6)
    sockets = {"A": np.zeros((1, 3)), "B": np.array([[1000.023, 0, 0]])}
    lengths = (aj.ReferenceLength("A", "B", 1000.0, 0.002),)
    of_test = aj.acceptance.Influences(u_relative=3e-6, artefact=warm)
    (value,) = next(
        metric.values
        for test in run(Measured(sockets, lengths), u_test=0.001, influences=of_test)
        for metric in test.metrics
        if metric.name == "E_Uni"
    )
    assert value.value == pytest.approx(0.0, abs=1e-9)
    u = math.sqrt(0.002**2 + 0.001**2 + 0.003**2 + (1000 * warm.u) ** 2)
    assert value.expanded == pytest.approx(2 * u)
    # An arm that is as warm, and expands as the bar does, measures it as calibrated.
    assert of_test._replace(arm=warm).correction(1000.0) == 0.0


def test_the_certified_form_and_its_uncertainty_count_in_the_form_error():
    """U(P_Form) = 2 sqrt((F / 2)^2 + u(F)^2), with what the test adds."""
    touched = 15.5 * geometry.touch_directions(25)
    sphere = aj.data.ProbedSphere("S", "probing", (touched,), 25.0, 0.003, 6.0, 0.0008, 0.0003)
    metrics = {m.name: m for test in run(Measured({}, spheres=(sphere,)), u_test=0.001) for m in test.metrics}
    assert metrics["P_Form"].worst.expanded == pytest.approx(2 * math.sqrt(0.0004**2 + 0.0003**2 + 0.001**2))
    assert metrics["P_Size"].worst.expanded == pytest.approx(2 * math.hypot(0.003, 0.001))


@pytest.mark.parametrize("text", ["bar=11.5,1,20,0", "artefact=11.5,1,20", "artefact=a,1,20,0", "arm"])
def test_expansions_that_cannot_be_read_are_refused(text):
    from aacmm_jax.acceptance.judgement import read_expansions
    from tests.refusals import assert_refused

    assert_refused(lambda: read_expansions([text]), "--expansion", "artefact=11.5,1,20.8,0.2")
    assert_refused(lambda: read_expansions(["arm=1e6,0,20,0"]), "arm", "per K")
    assert_refused(lambda: read_expansions(["arm=11.5e-6,0,20,0"]), "in 1/K; give the coefficient in 1e-6/K")
    assert_refused(lambda: read_expansions(["arm=1,0,20,0", "arm=1,0,20,0"]), "two expansions")


@pytest.mark.slow
def test_symbols_are_of_complete_tests(complete):
    tests = {test.title: test for test in run(complete["iso"])}
    (length,) = tests["length error"].metrics
    assert tests["length error"].symbol(length) == "E_Uni:0:Tact.AArm"
    after = {test.title: test for test in run(no_range(complete["iso"]))}
    assert after["length error"].symbol(length) == "E_Uni"
    assert after["length error"].called == "based on ISO 10360-12:2016"
    assert {test.rule for test in tests.values()} == {"iso-2017", "simple"}
