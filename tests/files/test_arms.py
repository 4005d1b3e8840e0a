"""Arm files: the shipped arms against what was published, units and conventions, exact round trips, and bad files."""

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.files.arms import specification_toml
from tests import published
from tests.refusals import assert_refused, refusal

K = published.LENGTH_MEAN / published.LENGTH_NOMINAL

# Nominal standard D-H, deg and mm: alpha, a, d (shared/data/mukca/README.md, from the makers' Craig tables).
MAKERS = {
    "panda": (
        [-90, 90, 90, -90, 90, 90, 0],
        [0, 0, 82.5, -82.5, 0, 88, 0],
        [333, 0, 316, 0, 384, 0, 107],
        [0, 0, 130],
    ),
    "iiwa14": (
        [-90, 90, 90, -90, -90, 90, 0],
        [0, 0, 0, 0, 0, 0, 0],
        [360, 0, 420, 0, 400, 0, 126],
        [0, 0, 100],
    ),
}
# Panda as its maker prints it, in Craig's convention: alpha_{i-1} in deg, a_{i-1} and d_i in mm.
PANDA_CRAIG = ([0, -90, 90, 90, -90, 90, 90], [0, 0, 0, 82.5, -82.5, 0, 88], [333, 0, 316, 0, 384, 0, 107])

SMALL = """
name = "small"
convention = "standard"
length_unit = "mm"
angle_unit = "deg"
probe = [0.0, 20.0, 130.0]

joint = [
  { alpha = -90.0, a = 12.5, d = 333.0, theta = 1.5, beta = 0.25, limits = [-166.0, 166.0] },
  { alpha = 45.0, a = 400.0, d = 0.0, theta = -0.5, beta = 0.0, limits = [-101.0, 10.0] },
]

[identification]
held = ["d_1", "theta_1"]
length = 20.0
angle = 2.0
override = { probe_z = 60.0, theta_2 = 0.5 }
"""


def written(tmp_path, text: str):
    path = tmp_path / "arm.toml"
    path.write_text(text)
    return path


def assert_same_arm(arm: aj.Arm, other: aj.Arm, rtol: float = 0.0) -> None:
    for kind in ("alpha", "a", "d", "theta", "beta", "probe"):
        value, expected = getattr(arm, kind), getattr(other, kind)
        assert (value is None) == (expected is None)
        if value is not None:
            np.testing.assert_allclose(value, expected, rtol=rtol, atol=0, err_msg=kind)
    assert (arm.limits is None) == (other.limits is None)
    if arm.limits is not None:
        np.testing.assert_allclose(arm.limits, other.limits, rtol=rtol, atol=0)


def test_simulated_arm_is_the_papers():
    """The arm of the paper's section 3 is in the middle of its first box; d_1 is that of the experiment."""
    arm = aj.load_arm("cheng2018-simulation")
    space = aj.Parameters.free_of(arm)
    lower, upper = (np.array(side) for side in published.BOXES[1])
    assert space.names == published.ORDER
    np.testing.assert_allclose(space.vector(), (lower + upper) / 2, rtol=0, atol=1e-12)
    held = [float(x) for x in (arm.theta[0], arm.d[0], arm.a[5], arm.alpha[5], *arm.probe[:2])]
    assert held == [0, 376.5, 0, -np.pi / 2, 0, 0]


def test_real_arm_is_equation_18_with_its_scale_fixed():
    arm = aj.load_arm("cheng2018-ra7125")
    space = aj.Parameters.free_of(arm)
    assert space.names == published.ORDER
    expected = np.where(space.lengths, published.EQUATION_18 / K, published.EQUATION_18)
    np.testing.assert_allclose(space.vector(), expected, rtol=1e-15, atol=0)
    np.testing.assert_array_equal(np.round(np.asarray(space.vector())[space.lengths], 4), published.TABLE_2_LENGTHS)
    assert float(arm.d[0]) == 376.5


@pytest.mark.parametrize("name", MAKERS)
def test_robots_are_their_makers(name):
    specification = aj.files.load_specification(name)
    alpha, a, d, probe = MAKERS[name]
    assert_same_arm(
        specification.arm,
        aj.Arm(alpha=np.deg2rad(alpha), a=a, d=d, probe=probe, limits=specification.arm.limits),
        rtol=1e-15,
    )
    # Joint 7 is redundant with the probe, all three coordinates of which are unknown to 60 mm; and since the probe
    # lies along the last axis, the angles of joint 6 are imitated by a_6, d_6 and the probe.
    assert set(specification.held) == {"theta_1", "d_1", "alpha_6", "theta_6", "alpha_7", "a_7", "theta_7", "d_7"}
    assert specification.override == {f"probe_{axis}": 60.0 for axis in "xyz"}
    assert specification.angle == pytest.approx(np.deg2rad(2))


def test_every_shipped_arm_loads_and_is_reachable_by_name():
    measuring, robots = {"cheng2018-ra7125", "cheng2018-simulation"}, {"iiwa14", "panda", "fr3", "irb120", "so100"}
    robots |= {"ur3e", "ur5e", "ur10", "ur10e", "gen3", "gen3-lite"}
    assert set(aj.files.shipped_arms()) == measuring | robots
    for name in measuring | robots:
        assert aj.load_arm(name).limits is not None or name in measuring
    for name in (*measuring, "panda", "iiwa14"):  # each with an [identification] of its own
        specification = aj.files.load_specification(name)
        assert specification.name
        assert specification.bounds().space.names


def test_craig_table_gives_the_same_arm(tmp_path):
    """Craig's rows hold the link before the joint, standard rows the link after it; the chain between is the same."""
    rows = [f"{{ alpha = {alpha}, a = {a}, d = {d} }}" for alpha, a, d in zip(*PANDA_CRAIG, strict=True)]
    text = 'convention = "craig"\nlength_unit = "mm"\nangle_unit = "deg"\nprobe = [0, 0, 130]\n'
    arm = aj.load_arm(written(tmp_path, text + f"joint = [{', '.join(rows)}]\n"))
    panda = aj.load_arm("panda")
    for kind in ("alpha", "a", "d", "theta", "probe"):
        np.testing.assert_array_equal(getattr(arm, kind), getattr(panda, kind), err_msg=kind)


def test_units_change_the_numbers_and_not_the_arm(tmp_path):
    in_mm_and_deg = aj.files.load_specification(written(tmp_path, SMALL))
    turn = np.pi / 180
    one = f"alpha = {-90 * turn}, a = 0.0125, d = 0.333, theta = {1.5 * turn}, beta = {0.25 * turn}"
    two = f"alpha = {45 * turn}, a = 0.4, d = 0.0, theta = {-0.5 * turn}, beta = 0.0"
    text = f"""
        length_unit = "m"
        angle_unit = "rad"
        probe = [0.0, 0.02, 0.13]
        joint = [
          {{ {one}, limits = [{-166 * turn}, {166 * turn}] }},
          {{ {two}, limits = [{-101 * turn}, {10 * turn}] }},
        ]
        [identification]
        held = ["d_1", "theta_1"]
        length = 0.02
        angle = {2 * turn}
        override = {{ probe_z = 0.06, theta_2 = {0.5 * turn} }}
    """
    in_m_and_rad = aj.files.load_specification(written(tmp_path, text))
    assert_same_arm(in_m_and_rad.arm, in_mm_and_deg.arm, rtol=1e-14)
    for one, other in zip(in_m_and_rad.bounds().lower, in_mm_and_deg.bounds().lower, strict=True):
        assert float(one) == pytest.approx(float(other), rel=1e-14, abs=1e-15)
    assert in_mm_and_deg.override == pytest.approx({"probe_z": 60.0, "theta_2": 0.5 * turn})
    assert (in_mm_and_deg.length, in_mm_and_deg.angle) == (20.0, 2 * turn)
    assert in_m_and_rad.name == "arm"  # of the file, where it states none


@pytest.mark.slow
def test_saved_arm_reads_back_the_same_numbers(tmp_path):
    for name in aj.files.shipped_arms():
        arm = aj.load_arm(name)
        path = tmp_path / f"{name}.toml"
        aj.files.save_arm(arm, path, name="copy", source="the test")
        assert_same_arm(aj.load_arm(path), arm)
    assert aj.files.load_specification(str(path)).name == "copy"


@pytest.mark.parametrize(
    ("old", "new", "parts"),
    [
        ("alpha = 45.0", "alhpa = 45.0", ["unknown key 'joint 2.alhpa'", "did you mean 'alpha'?"]),
        ("length_unit", "lenght_unit", ["unknown key 'lenght_unit'", "did you mean 'length_unit'?"]),
        ("held =", "hold =", ["unknown key 'identification.hold'", "did you mean 'held'?"]),
        ('"mm"', '"inch"', ["'length_unit' must be 'mm' or 'm', not 'inch'"]),
        ('"deg"', '"grad"', ["'angle_unit' must be 'rad' or 'deg', not 'grad'"]),
        ('"standard"', '"denavit"', ["'convention' must be 'standard' or 'craig', not 'denavit'"]),
        ('length_unit = "mm"', "", ["'length_unit' is missing; add it"]),
        ("a = 400.0, ", "", ["'joint 2.a' is missing; add it"]),
        (", limits = [-101.0, 10.0]", "", ["limits are given for some joints only", "for all joints or for none"]),
        ("[-101.0, 10.0]", "[10.0]", ["'joint 2.limits' has 1 entries", "give at least 2"]),
        ("[-101.0, 10.0]", "[10.0, -101.0]", ["joint 2: the limits are 10 to -101", "lower limit must be below"]),
        ("45.0", '"forty-five"', ["'joint 2.alpha' must be a valid number, not 'forty-five'"]),
        ("45.0", '"45.0"', ["'joint 2.alpha' must be a valid number, not '45.0'"]),
        ("45.0", "1e300", ["'joint 2.alpha' is implausibly large"]),
        ('"deg"', '"rad"', ["joint 1 has alpha = ", "rad, more than a revolution; is alpha in degrees?"]),
        ("45.0", "nan", ["'joint 2.alpha' must be a finite number, not nan"]),
        ("45.0", "", ["not valid TOML", "line 10"]),
        ("130.0]", "]", ["'probe' has 2 entries", "give at least 3"]),
        ('"standard"', '"craig"', ["joint 1 has a twist or a length", "alpha_0", "choose a base frame"]),
        ("probe_z = 60.0", "probe_q = 60.0", ["unknown parameter 'probe_q' of a 2-joint arm", "did you mean 'probe_"]),
        ("probe_z = 60.0", "d_1 = 60.0", ["'d_1' is held, not free"]),
        ("probe_z = 60.0", "probe_z = -60.0", ["'identification.override.probe_z' must be greater than 0, not -60.0"]),
        ('["d_1", ', '["d_9", ', ["unknown parameter 'd_9' of a 2-joint arm", "did you mean 'd_"]),
    ],
    ids=[
        *("misspelt in a row", "misspelt at the top", "misspelt in identification", "length unit", "angle unit"),
        *("convention", "no unit", "no key in a row", "limits of some", "one limit", "limits reversed", "text"),
        *("quoted", "too large", "degrees stated as radians", "nan"),
        *("not TOML", "probe", "craig before joint 1", "override unknown", "override held"),
        *("override negative", "held unknown"),
    ],
)
def test_bad_file(tmp_path, old, new, parts):
    assert SMALL.count(old) == 1
    path = written(tmp_path, SMALL.replace(old, new))
    assert_refused(lambda: aj.load_arm(path), path, *parts)


def test_radians_stated_as_degrees(tmp_path):
    """Twists of a quarter turn in radians are refused; small ones in degrees are not."""
    head = 'length_unit = "mm"\nangle_unit = "deg"\njoint = ['
    rows = "{{ alpha = {}, a = 0, d = 99 }}, {{ alpha = 0, a = 9, d = 0 }}, {{ alpha = {}, a = 0, d = 9 }}]"
    for twists in ((-1.5708, 1.5708), (1.570796326794897, 3.141592653589793)):
        path = written(tmp_path, head + rows.format(*twists))
        assert_refused(lambda path=path: aj.load_arm(path), path, "multiple of pi/2", "are the angles in rad?")
    for twists in ((-90, 1.5708), (0.01, -0.02), (1.5, -1.5)):
        aj.load_arm(written(tmp_path, head + rows.format(*twists)))


@pytest.mark.parametrize(("stated", "meant", "length"), [("m", "mm", 400.0), ("mm", "m", 0.4)])
def test_lengths_in_the_other_unit(tmp_path, stated, meant, length):
    row = f"{{ alpha = 0, a = {length}, d = 0 }}"
    path = written(tmp_path, f'length_unit = "{stated}"\nangle_unit = "deg"\njoint = [{row}, {row}]')
    assert_refused(lambda: aj.load_arm(path), path, f"are the lengths in {meant}?", "length_unit")


def test_what_is_not_an_arm_file(tmp_path):
    (tmp_path / "folder.toml").mkdir()
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    craig = (
        'convention = "craig"\nlength_unit = "mm"\nangle_unit = "deg"\njoint = [{ alpha = 0, a = 0, d = 1, beta = 1 }]'
    )
    assert_refused(
        lambda: aj.load_arm(written(tmp_path, craig)), "beta", "only with convention = 'standard'", "remove beta"
    )
    assert_refused(lambda: aj.load_arm("so101"), "'so101' does not ship", "so100 has other zeros", "URDF of the SO-101")
    assert_refused(lambda: aj.load_arm("pandaa"), "'pandaa' is neither a file nor an arm", "did you mean 'panda'?")
    assert_refused(lambda: aj.load_arm("zzz"), "'zzz'", "choose one of cheng2018-ra7125", "ur5e.")
    assert_refused(lambda: aj.load_arm("missing.toml"), "missing.toml does not exist", "check the path")
    assert_refused(lambda: aj.load_arm(tmp_path / "folder.toml"), tmp_path, "is a folder", "give a file")
    assert_refused(lambda: aj.load_arm(tmp_path / "binary.toml"), tmp_path, "not UTF-8 text")


@pytest.mark.parametrize("model", ["ur5", "UR16e", "iiwa7", "irb_1200"])
def test_a_robot_that_does_not_ship_is_not_a_misspelt_name(model):
    said = refusal(lambda: aj.load_arm(model))
    assert f"'{model}' does not ship" in said
    assert f"'{model}.urdf'" in said
    assert "did you mean" not in said


@pytest.mark.parametrize(
    ("name", "meant"),
    [("UR-5e", "ur5e"), ("gen3lite", "gen3-lite"), ("cheng2018-simulaton", "cheng2018-simulation")],
)
def test_another_writing_of_a_shipped_arm(name, meant):
    assert_refused(lambda: aj.load_arm(name), f"'{name}'", f"did you mean '{meant}'?")


def test_a_batch_of_arms_has_no_file(tmp_path):
    batch = aj.Arm(alpha=np.zeros((2, 3)), a=np.zeros(3), d=np.zeros(3))
    assert_refused(lambda: aj.files.save_arm(batch, tmp_path / "arm.toml"), "one arm", "select one arm of the batch")


ROBOT = """
length_unit = "mm"
angle_unit = "deg"
probe = [30.0, 10.0, 100.0]
joint = [
  { alpha = 90.0, a = 0.0, d = 89.0 },
  { alpha = 0.0, a = -425.0, d = 0.0 },
  { alpha = 0.0, a = -392.0, d = 0.0 },
  { alpha = 90.0, a = 0.0, d = 109.0 },
  { alpha = -90.0, a = 0.0, d = 95.0 },
  { alpha = 0.0, a = 0.0, d = 82.0 },
]
"""


@pytest.mark.slow
def test_a_file_without_identification_gets_independent_parameters(tmp_path):
    """Three parallel axes: two of their offsets are fixed, and Hayati's angles are free instead; also after a round
    trip."""
    path = written(tmp_path, ROBOT)
    specification = aj.files.load_specification(path)
    chosen = aj.Parameters.independent(specification.arm)
    assert specification.space().names == chosen.names
    assert specification.free == ("beta_2", "beta_3")
    assert {"d_2", "d_3"} <= set(specification.held)
    assert specification.arm.beta is None  # the file states none
    path.write_text(specification_toml(specification))
    again = aj.files.load_specification(path)
    assert (again.held, again.free, again.bounds().space.names) == (
        specification.held,
        specification.free,
        chosen.names,
    )
    aj.files.save_arm(specification.arm, path)  # a file of the arm alone proposes nothing
    assert "identification" not in path.read_text()
    assert aj.files.load_specification(path).space().names == chosen.names


@pytest.mark.parametrize("target", ["reflector", ""])
def test_the_parameters_of_a_shipped_arm_are_for_its_own_probe(target):
    """Of targets alone theta_6 and alpha_6 of panda are determined, and its probe is not."""
    arm, random = aj.load_arm("panda"), np.random.default_rng(1)
    q = random.uniform(-1.5, 1.5, (40, 7))
    seen = np.asarray(arm.replace(probe=[80.0, 30.0, 50.0]).position(q))
    points = aj.data.observations.MeasuredPoints("tracker", q, seen, u=0.02, target=target)
    specification = aj.files.load_specification("panda", capture=aj.Capture({}, [], [points]))
    names = specification.space().names
    assert ("theta_6" in names) == ("alpha_6" in names) == bool(target)
    assert ("probe_x" in names) == (not target)
    assert set(specification.override) <= set(names)
    assert len(specification.bounds().lower) == len(names)
