"""Calibrations compared: figures worked out by hand, true changes found again, chance alone, and the command."""

import csv
import datetime
import io
import json
import math
import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from typer.testing import CliRunner

import aacmm_jax as aj
from aacmm_jax.cli import calibration_commands  # noqa: F401 - registers its commands
from aacmm_jax.cli.app import app
from aacmm_jax.core.units import ARCSEC
from aacmm_jax.data.recording import Recording
from aacmm_jax.drift.comparison import compare, trend
from aacmm_jax.files.hdf5 import provenance
from aacmm_jax.kinematics.parameters import ArmSpecification
from aacmm_jax.model.scale import divided_arm
from aacmm_jax.plot import drift as drift_figure
from aacmm_jax.summaries.drift import drift_csv, drift_summary
from tests.conftest import command_line
from tests.refusals import assert_refused

SOCKETS = {"A": (400, 200, 300), "B": (700, 500, 500)}
PAIRS, OTHERS = 30, 12
MOVED = {"theta_4": 20 * ARCSEC, "a_2": 0.05}


@pytest.fixture(scope="module")
def specification() -> ArmSpecification:
    return aj.files.load_specification("cheng2018-simulation")


@pytest.fixture(scope="module")
def space(paper_arm) -> aj.Parameters:
    return aj.Parameters.free_of(paper_arm)


def moved_arm(space, changes):
    vector = space.vector()
    for name, change in changes.items():
        vector = vector.at[space.index(name)].add(change)
    return space.arm(vector)


class Calibrations(dict):
    """Records by number, each calibrated when it is first asked for."""

    def __init__(self, record_of):
        self.record_of = record_of

    def __missing__(self, number):
        self[number] = self.record_of(number)
        return self[number]


@pytest.fixture(scope="module")
def calibrated(paper_arm, specification, space):
    """Calibrations with estimated noise of the paper's arm (60) and of one with two changed parameters (12)."""
    bounds = aj.Bounds.around(paper_arm, space)

    def record(number):
        capture = aj.simulate(
            paper_arm if number < 2 * PAIRS else moved_arm(space, MOVED),
            SOCKETS,
            poses={"A": 50, "B": 10},
            lengths=[("A", "B", 0.002)],
            encoder_arcsec=2.0,
            seating=0.005,
            seed=number,
        )
        calibration = aj.calibrate(paper_arm, capture, bounds, undetermined="ignore")
        made = aj.calibration.record_of(calibration, Recording(capture, specification))
        assert made.converged
        return made

    return Calibrations(record)


@pytest.fixture(scope="module")
def old(calibrated):
    return calibrated[0]


@pytest.fixture(scope="module")
def new(calibrated):
    return calibrated[1]


def shifted(record, changes, **fields):
    """The record with parameters of its arm changed, and whatever else."""
    space = aj.Parameters(record.calibrated.arm, record.names)
    return record._replace(calibrated=record.calibrated._replace(arm=moved_arm(space, changes)), **fields)


def certain(record, u, degrees_of_freedom=math.inf):
    """The record with independent parameters of standard uncertainty ``u`` (mm or mrad) and no common scale error."""
    steps = np.array([1e-3 if name.startswith(("alpha", "theta")) else 1.0 for name in record.names])
    return record._replace(
        covariance=np.diag((u * steps) ** 2),
        degrees_of_freedom=degrees_of_freedom,
        components=None,
    )


@pytest.mark.slow
def test_parameters_against_numbers_worked_out_by_hand(old, new):
    """Uncertainties of 3 and 4 steps make one of 5; 9.7 and 9.9 steps are either side of U = 9.80."""
    start = certain(old, 0.003)
    end = certain(shifted(old, {"theta_4": 9.9e-6, "a_2": 0.0097}, recording=new.recording), 0.004)
    found = compare(start, end)
    np.testing.assert_allclose(found.u[[found.names.index("a_2"), found.names.index("theta_4")]], [5e-3, 5e-6])
    np.testing.assert_allclose(found.expanded / found.u, stats.norm.ppf(0.975))
    assert [name for name, moved in zip(found.names, found.moved, strict=True) if moved] == ["theta_4"]
    assert found.joint_test.statistic == pytest.approx((9.9**2 + 9.7**2) / 25, rel=1e-6)
    assert (found.joint_test.rank, found.joint_test.degrees_of_freedom) == (21, math.inf)
    assert found.joint_test.p == pytest.approx(stats.chi2.sf((9.9**2 + 9.7**2) / 25, 21), rel=1e-6)
    assert found.by_chance == pytest.approx(1.05)
    assert (
        "1 of 21 parameters changed by more than its expanded uncertainty (95 %; 1 expected by chance): theta_4 by "
        "+2.04 arcsec" in " ".join(found.sentences())
    )


@pytest.mark.parametrize(
    ("u", "nu", "expected"),
    [((0.003, 0.003), (40.0, 40.0), 80.0), ((0.003, 0.004), (40.0, 90.0), 625 / (81 / 40 + 256 / 90))],
)
def test_estimated_noise_takes_f(old, new, u, nu, expected):
    """Two equal variances with 40 degrees of freedom each have 80 pooled; else Welch and Satterthwaite."""
    end = shifted(old, {"d_3": 0.02}, recording=new.recording)
    found = compare(certain(old, u[0], nu[0]), certain(end, u[1], nu[1]))
    assert found.joint_test.degrees_of_freedom == pytest.approx(expected)
    assert found.joint_test.p == pytest.approx(
        stats.f.sf(0.02**2 / (u[0] ** 2 + u[1] ** 2) / 21, 21, expected), rel=1e-6
    )
    np.testing.assert_allclose(found.expanded / found.u, stats.t.ppf(0.975, expected))


def test_robust_covariances_take_hotelling(old, new):
    """T^2 with 80 degrees of freedom of 21 parameters is 80 * 21 / 60 times F with 21 and 60."""
    end = shifted(old, {"d_3": 0.02}, recording=new.recording, noise_model="robust")
    found = compare(certain(old, 0.003, 40.0)._replace(noise_model="robust"), certain(end, 0.003, 40.0))
    assert found.joint_test.p == pytest.approx(stats.f.sf(0.02**2 / 18e-6 * 60 / (80 * 21), 21, 60), rel=1e-6)


@pytest.mark.slow
def test_only_what_both_determine_is_tested(old, new):
    """alpha_5 and d_6 trade off: changed together along the open direction they say nothing, across it they do."""
    pair, root = [old.names.index("alpha_5"), old.names.index("d_6")], math.sqrt(0.5)
    direction = np.zeros(21)
    direction[pair] = root
    projector = np.outer(direction, direction)
    determined = np.ones(21, dtype=bool)
    determined[pair] = False
    steps = np.where([name.startswith(("alpha", "theta")) for name in old.names], 1e-3, 1.0)
    inside = (np.eye(21) - projector) * 0.003**2 * np.outer(steps, steps)
    start = certain(old, 0.003)._replace(covariance=inside, open=projector, determined=determined)
    for side, statistic in ((1, 0.0), (-1, (0.01 * root * 2) ** 2 / (2 * 0.003**2))):
        end = shifted(start, {"alpha_5": 0.01e-3, "d_6": 0.01 * side}, recording=new.recording)
        found = compare(start, end)
        assert found.joint_test.rank == 20
        assert found.joint_test.statistic == pytest.approx(statistic, rel=1e-6, abs=1e-9)
        assert [found.reasons[i] for i in pair] == ["not determined by the data in both calibrations"] * 2
        assert np.isnan(found.u[pair]).all()
        assert not found.moved[pair].any()


def test_on_a_bound_or_fixed_there_is_no_uncertainty_of_change(old, new):
    active = np.zeros(21, dtype=int)
    active[old.names.index("a_3")] = 1
    without = old.names.index("d_6")
    kept = [i for i in range(21) if i != without]
    short = new._replace(
        components=None,
        names=tuple(old.names[i] for i in kept),
        covariance=new.covariance[np.ix_(kept, kept)],
        open=new.open[np.ix_(kept, kept)],
        determined=new.determined[kept],
        active=new.active[kept],
    )
    for pair, side in (((old._replace(active=active), short), "new"), ((short, old._replace(active=active)), "old")):
        found = compare(*pair)
        assert dict(zip(found.names, found.reasons, strict=True))["d_6"] == f"fixed in the {side} calibration"
        other = "old" if side == "new" else "new"
        assert dict(zip(found.names, found.reasons, strict=True))["a_3"] == f"on a bound in the {other} calibration"
        assert found.joint_test.rank == 19
        assert len(found.joint_test.names) == 19
        assert found.by_chance == pytest.approx(19 * 0.05)
        assert f"Parameters free only in the {other} calibration: d_6." in " ".join(found.warnings)
        rows = {row["parameter"]: row for row in drift_summary(found)["parameters"]}
        assert rows["d_6"]["u"] is rows["d_6"]["moved"] is None
        assert rows["d_6"]["change"] == pytest.approx(float(pair[1].calibrated.arm.d[5] - pair[0].calibrated.arm.d[5]))


COEFFICIENTS = {"cos1_3": 0.0, "gear_2": 0.0, "compliance3_2": 0.0}


def corrected(record, **values):
    """The record of an arm whose corrections were calibrated too, each with u = 1e-5."""
    arm = record.calibrated.arm
    arm = aj.kinematics.with_corrections(arm, list(COEFFICIENTS)).replace(**COEFFICIENTS | values)
    count, p = len(COEFFICIENTS), len(record.names)
    covariance, spread = np.zeros((p + count, p + count)), np.zeros((p + count, p + count))
    covariance[:p, :p], spread[:p, :p] = record.covariance, record.open
    covariance[p:, p:] = 1e-10 * np.eye(count)
    return record._replace(
        calibrated=record.calibrated._replace(arm=arm),
        names=(*record.names, *COEFFICIENTS),
        active=np.concatenate([record.active, np.zeros(count, dtype=int)]),
        determined=np.concatenate([record.determined, np.ones(count, dtype=bool)]),
        covariance=covariance,
        open=spread,
        components=None,
    )


@pytest.mark.slow
def test_coefficients_of_corrections_have_their_own_units(old):
    """1e-4 rad are 20.6 arcsec; of a gear it is ppm, of a compliance urad/m."""
    drift = compare(corrected(old), corrected(old, cos1_3=1e-4, gear_2=2e-4, compliance3_2=-3e-4))
    units = dict(zip(drift.names, drift.units, strict=True))
    assert [units[name] for name in ("d_3", "theta_2", *COEFFICIENTS)] == ["mm", "rad", "rad", "1", "rad/m"]
    text = " ".join(drift.findings())
    for part in ("cos1_3 by +20.6 arcsec", "gear_2 by +200 ppm", "compliance3_2 by -300 urad/m"):
        assert part in text
    rows = {row["parameter"]: row for row in drift_summary(drift)["parameters"]}
    assert rows["gear_2"]["unit"] == "1"
    assert {cause["unit"] for cause in drift_summary(drift)["joint"]["causes"]} == {"rad", "1", "rad/m"}


def test_an_arm_without_corrections_is_compared_with_one_that_has_some(old):
    drift = compare(old, corrected(old, gear_2=2e-4))
    i = drift.names.index("gear_2")
    assert (drift.old[i], drift.new[i], drift.reasons[i]) == (
        0.0,
        2e-4,
        "fixed at 0 by the model in the old calibration",
    )
    assert "Parameters free only in the new calibration: cos1_3, gear_2, compliance3_2" in " ".join(drift.warnings)


@pytest.mark.slow
def test_lengths_follow_the_scale(paper_arm, specification):
    """After two stages u(k) is in every length."""
    space = aj.Parameters.free_of(paper_arm)
    capture = aj.simulate(
        paper_arm, SOCKETS, poses={"A": 50, "B": 10}, lengths=[("A", "B", 0.05)], encoder_arcsec=2.0, seed=3
    )
    record = aj.calibration.record_of(
        aj.calibrate(paper_arm, capture, aj.Bounds.around(paper_arm, space)), Recording(capture, specification)
    )
    found = compare(record, record, points=30).lengths
    alone = aj.uncertainty_of(record).length(found.q, found.q_end)
    np.testing.assert_allclose(found.u, math.sqrt(2) * np.asarray(alone), rtol=1e-9)
    # One length of 583 mm with u = 0.05 mm dominates: every length is uncertain by nearly the same fraction.
    assert found.u_scale_change == pytest.approx(math.sqrt(2) * record.u_k, rel=0.05)


@pytest.mark.slow
def test_lengths_are_those_of_the_two_arms(old, new):
    found = compare(old, new, points=50, length=250.0).lengths
    by = [
        np.linalg.norm(
            np.asarray(record.calibrated.arm.position(found.q_end) - record.calibrated.arm.position(found.q)), axis=1
        )
        for record in (old, new)
    ]
    np.testing.assert_allclose(by[0], 250, atol=1e-6)
    np.testing.assert_allclose(found.change, by[1] - by[0], atol=1e-9)
    length = eqx.filter_jit(lambda uncertainty: uncertainty.length(found.q, found.q_end))
    each = [np.asarray(length(aj.uncertainty_of(record))) for record in (old, new)]
    np.testing.assert_allclose(found.u, np.hypot(*each), rtol=1e-9)

    space = aj.Parameters(old.calibrated.arm, old.names)  # of both arms: their fixed parameters are equal

    @jax.jit
    @jax.grad
    def slope(vector):
        arm = space.arm(vector)
        return jnp.mean(jnp.linalg.norm(arm.position(found.q_end) - arm.position(found.q), axis=-1))

    means = [slope(space.vector(record.calibrated.arm)) for record in (old, new)]
    variance = sum(float(g @ record.covariance @ g) for g, record in zip(means, (old, new), strict=True))
    assert found.u_scale_change == pytest.approx(math.sqrt(variance) / 250, rel=1e-6)
    assert found.largest == found.change[np.argmax(np.abs(found.change))]
    assert found.rms == pytest.approx(float(np.sqrt(np.mean((by[1] - by[0]) ** 2))))


@pytest.mark.slow
def test_an_arm_that_grew_measures_everything_longer(old, new):
    grown = old.calibrated._replace(arm=divided_arm(old.calibrated.arm, jnp.asarray(1 / 1.0002)))
    found = compare(old, new._replace(calibrated=grown))
    np.testing.assert_allclose(found.lengths.change, 0.06, rtol=1e-6)
    assert found.lengths.scale_change == pytest.approx(2e-4, rel=1e-6)
    assert found.lengths.moved.all()
    assert "measures these lengths 200 um/m longer than the old one does" in found.sentences()[-1]
    # The artefact's 2 um in 469 mm, twice, is all that two angle-perfect arms could differ by; poses add to it.
    assert found.lengths.u_scale_change > math.sqrt(2) * 0.002 / math.dist(*SOCKETS.values())


def test_the_scale_left_open_is_no_drift(old, new):
    scale = np.asarray(aj.Parameters(old.calibrated.arm, old.names).vector()) * np.array(
        [0.0 if name.startswith(("alpha", "theta")) else 1.0 for name in old.names]
    )
    scale /= np.linalg.norm(scale)
    found = compare(old, new._replace(open=np.outer(scale, scale)))
    assert not found.lengths.moved.any()
    assert np.isinf(found.lengths.u_scale_change)
    assert drift_summary(found)["lengths"]["mean_expanded_um_per_m"] is None
    assert "do not determine all of these lengths" in " ".join(found.findings())


@pytest.mark.exhaustive
def test_chance_alone_flags_one_parameter_in_twenty(calibrated):
    """60 pairs of captures of one arm: 5 % of parameters and lengths move, and the joint test's p is uniform."""
    found = [compare(calibrated[2 * i], calibrated[2 * i + 1], points=40) for i in range(PAIRS)]
    # Parameters of one calibration are correlated: 1260 changes count for about 300, which scatter by 1.3 %.
    assert 0.02 < np.mean([drift.moved for drift in found]) < 0.09
    assert 0.02 < np.mean([drift.lengths.moved for drift in found]) < 0.10
    assert stats.kstest([drift.joint_test.p for drift in found], "uniform").pvalue > 0.005
    ratio = np.mean([drift.lengths.rms**2 for drift in found]) / np.mean(
        [drift.lengths.rms_by_chance**2 for drift in found]
    )
    assert 0.7 < ratio < 1.3


@pytest.mark.slow
def test_true_changes_are_found(calibrated, paper_arm, space):
    """theta_4 and a_2 changed, 12 times: only they are flagged and named, and lengths change as the true ones do."""
    other = moved_arm(space, MOVED)
    found = [compare(calibrated[i], calibrated[2 * PAIRS + i], points=40) for i in range(OTHERS)]
    for name in MOVED:
        assert np.mean([drift.moved[space.index(name)] for drift in found]) > 0.9
    rest = [i for i, name in enumerate(space.names) if name not in MOVED]
    assert np.mean([drift.moved[rest] for drift in found]) < 0.12
    assert max(drift.joint_test.p for drift in found) < 1e-6
    for name, size in MOVED.items():
        found_sizes = [dict(drift.joint_test.causes).get(name, math.nan) for drift in found]
        np.testing.assert_allclose(np.nanmedian(found_sizes), size, rtol=0.1)
    off = []
    for drift in found:
        ends = [(arm.position(drift.lengths.q), arm.position(drift.lengths.q_end)) for arm in (paper_arm, other)]
        before, after = (np.linalg.norm(np.asarray(end - start), axis=1) for start, end in ends)
        off.append((drift.lengths.change - (after - before)) / drift.lengths.u)
    assert np.sqrt(np.mean(np.square(off))) == pytest.approx(1, abs=0.3)


def capture_of(record, q):
    lengths = [aj.ReferenceLength("A", "B", length.value, length.u) for length in record.recording.capture.lengths]
    return aj.Capture({"A": q[:50], "B": q[50:]}, lengths)


def half_shared(old, new):
    q = np.concatenate([np.asarray(old.recording.capture.q)[:30], np.asarray(new.recording.capture.q)[30:]])
    return new._replace(recording=new.recording._replace(capture=capture_of(new, q)))


def other_nominal(old, new):
    nominal = new.recording.nominal
    arm = nominal.arm
    changed = aj.Arm(alpha=arm.alpha, a=arm.a, d=arm.d.at[2].add(0.5), theta=arm.theta, probe=arm.probe)
    return new._replace(recording=new.recording._replace(nominal=nominal._replace(arm=changed, name="another arm")))


WARNINGS = {
    "failed": (
        lambda o, n: n._replace(converged=False, reason="Not converged."),
        "Failed: the new calibration. Not converged.",
    ),
    "implausible": (lambda o, n: n._replace(k=25.4), "Implausible scale: k = 25.4 in the new calibration."),
    "itself": (
        lambda o, n: o,
        "Not independent: the old calibration and the new calibration are the same calibration",
    ),
    "same capture": (
        lambda o, n: n._replace(recording=o.recording),
        "Not independent: the old calibration and the new calibration were computed from the same capture",
    ),
    "shared poses": (half_shared, "share 30 of 60 poses, so the uncertainties of the changes are wrong"),
    "nominal": (
        other_nominal,
        "The nominal arms differ in d_3 ('Cheng 2018, simulated arm' of the old calibration, 'another arm'",
    ),
    "method": (
        lambda o, n: n._replace(method="joint"),
        "the old calibration is two-stage, the new calibration is joint",
    ),
}


@pytest.mark.first_rows(2)
@pytest.mark.parametrize("case", WARNINGS)
def test_what_makes_a_comparison_doubtful_is_said_first(old, new, case):
    change, text = WARNINGS[case]
    found = compare(old, change(old, new), points=5)
    assert text in found.sentences()[0]
    assert len(found.warnings) == 1


def test_two_good_calibrations_of_one_arm_have_no_warnings(old, new):
    assert compare(old, new, points=5).warnings == ()


@pytest.mark.parametrize(
    ("ask", "parts"),
    [
        (lambda old, new, panda: compare(old, new, level=95), ("level is 95",)),
        (lambda old, new, panda: compare(old, new, length=1e5), ("does not fit into the volume",)),
        (lambda old, new, panda: compare(old, panda), ("with 6 joints", "with 7 joints; compare")),
        (lambda old, new, panda: compare(old, new.calibrated), ("new is ", "give a CalibrationRecord")),
        (lambda old, new, panda: trend([old], ["2026-01-01"]), ("at least two calibrations",)),
        (lambda old, new, panda: trend([old, new], ["2026-01-01"]), ("2 calibrations and 1 dates",)),
        (lambda old, new, panda: trend([old, new], ["2026-01-01", "yesterday"]), ("'yesterday' is not a date",)),
    ],
    ids=["level", "length", "joints", "type", "one", "dates", "date"],
)  # fmt: skip
def test_refused(old, new, ask, parts):
    panda = aj.files.load_specification("panda")
    other = old._replace(recording=old.recording._replace(nominal=panda), calibrated=panda)
    assert_refused(lambda: ask(old, new, other), *parts)


@pytest.mark.slow
def test_a_trend_is_in_the_order_of_its_dates(calibrated):
    """Given last first; noon in Paris is before noon in London."""
    given = [calibrated[2 * PAIRS], calibrated[1], calibrated[0]]
    table = trend(given, ["2026-03-01", "2026-01-01T12:00:00+00:00", "2026-01-01T12:00:00+01:00"], points=40)
    assert table.order == (2, 1, 0)
    assert table.dates[2] == datetime.datetime(2026, 3, 1, tzinfo=datetime.UTC)
    alone = compare(calibrated[0], calibrated[2 * PAIRS], points=40)
    np.testing.assert_array_equal(table.change[2], alone.change)
    np.testing.assert_array_equal(table.expanded[2], alone.expanded)
    assert table.change[0].tolist() == [0.0] * 21
    assert not table.moved[0].any()
    assert table.drifts[1].lengths.rms == alone.lengths.rms
    assert table.warnings == []
    rows = list(csv.DictReader(io.StringIO(drift_csv(table, ["last.h5", "mid,dle.h5", "first.h5"]))))
    assert len(rows) == 2 * 21
    assert {(row["old_calibration"], row["new_calibration"]) for row in rows} == {
        ("first.h5", "mid,dle.h5"), ("first.h5", "last.h5")
    }  # fmt: skip
    assert [float(row["change"]) for row in rows[21:]] == alone.change.tolist()


@pytest.mark.slow
def test_figures_draw_the_numbers(calibrated, tmp_path):
    given, dates = [calibrated[i] for i in (0, 1, 2 * PAIRS)], ["2026-01-01", "2026-02-01", "2026-07-01"]
    table = trend(given, dates, points=40)
    upper, lower = drift_figure.drift_trend(table)
    named = {text.get_text().split()[0] for text in upper.get_legend().get_texts()}
    assert named == {name for name, moved in zip(table.names, table.moved[-1], strict=True) if moved}
    i = table.names.index("a_2")
    ends = [line.get_ydata()[-1] for line in upper.lines if len(line.get_ydata()) == 3]
    assert any(end == pytest.approx(table.change[-1, i] / table.expanded[-1, i]) for end in ends)
    found = {line.get_label(): line for line in lower.lines}["RMS"]
    np.testing.assert_allclose(found.get_ydata(), [1e3 * drift.lengths.rms for drift in table.drifts])
    # January is 31 of 181 days: places are in proportion to time.
    np.testing.assert_allclose(found.get_xdata(), [2 * 31 / 181, 2])
    assert lower.get_xlabel() == "calibration"
    by_file = drift_figure.drift_trend(table._replace(dated_by_file=(True, False, True)))[1]
    assert "(*: date of the file" in by_file.get_xlabel()
    assert [label.get_text().endswith("*") for label in by_file.get_xticklabels()] == [True, False, True]
    two = drift_figure.drift_trend(trend(given[::2], dates[::2], points=40))
    assert [label.get_text().split()[0] for label in two[0].get_xticklabels()] == list(table.names)
    for suffix, start in (("png", b"\x89PNG"), ("svg", b"<?xml"), ("pdf", b"%PDF")):
        drift_figure.save_drift_trend(table, tmp_path / f"trend.{suffix}")
        assert (tmp_path / f"trend.{suffix}").read_bytes().startswith(start)


@pytest.fixture
def run(tmp_path, monkeypatch):
    """The command in this process, in an empty folder: exit code and standard output, or the refusal that it raised."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "110")

    def command(*arguments):
        return CliRunner().invoke(app, ["compare", *map(str, arguments)])

    return command


def saved(record, path, created, monkeypatch):
    from aacmm_jax.files import hdf5

    genuine = provenance
    with monkeypatch.context() as patch:
        patch.setattr(hdf5, "provenance", lambda kind: genuine(kind) | {"created": created})
        aj.files.save_calibration(path, record)


@pytest.fixture
def files(calibrated, tmp_path, monkeypatch):
    for name, record, month in (("a", calibrated[0], 1), ("b", calibrated[1], 2), ("c", calibrated[2 * PAIRS], 3)):
        saved(record, tmp_path / f"{name}.h5", f"2026-0{month}-01T00:00:00+00:00", monkeypatch)
    return tmp_path


@pytest.mark.slow
def test_command(run, files, calibrated):
    printed = run("a.h5", "c.h5")
    assert printed.exit_code == 0, printed.exception
    words = " ".join(printed.stdout.split())
    assert words.startswith("The arm has changed: zero of joint 4 by ")
    assert "Cheng 2018, simulated arm: c.h5 (2026-03-01) compared with a.h5 (2026-01-01) Tested together, the" in words
    assert "Warning" not in words
    assert "* beyond U" in words
    summary = json.loads(
        run("a.h5", "c.h5", "--json").stdout, parse_constant=lambda text: pytest.fail(f"{text} is no JSON")
    )
    expected = compare(calibrated[0], calibrated[2 * PAIRS])
    assert [row["change"] for row in summary["parameters"]] == expected.change.tolist()
    assert summary["lengths"]["largest_mm"] == expected.lengths.largest
    assert summary["moved"] == expected.moved.sum()
    largest = abs(expected.lengths.largest)
    failed = run("a.h5", "c.h5", "--max-length-change-mm", 0.9 * largest)
    assert failed.exit_code == 1
    assert "Failed: the largest change of a length of 300 mm" in " ".join(failed.stdout.split())
    assert run("a.h5", "c.h5", "--max-length-change-mm", 1.1 * largest).exit_code == 0
    again = run("c.h5", "a.h5")
    assert "was made before c.h5 (" in " ".join(again.stdout.split())


@pytest.mark.slow
def test_command_on_three_calibrations(run, files):
    done = run("c.h5", "a.h5", "b.h5", "--figure", "trend.svg", "--csv", "table.csv", "--json")
    assert done.exit_code == 0
    summary = json.loads(done.stdout)
    assert [row["calibration"] for row in summary["trend"]] == ["a.h5", "b.h5", "c.h5"]
    assert (summary["old"], summary["new"]) == ("a.h5", "c.h5")
    assert len((files / "table.csv").read_text().splitlines()) == 1 + 2 * 21
    assert (files / "trend.svg").stat().st_size > 10_000
    printed = " ".join(run("c.h5", "a.h5", "b.h5").stdout.split())
    assert "Each calibration minus the first" in printed
    assert "For the change of every parameter from the first calibration, use --csv" in printed


@pytest.fixture(scope="module")
def with_gear(calibrated):
    """A calibration whose model of the joints the others lack."""
    recording = calibrated[2].recording
    arm = aj.kinematics.with_corrections(recording.nominal.arm, "gear")
    options = {"cross_validate": False, "shared_errors": False}
    return aj.calibrate_capture(recording._replace(nominal=recording.nominal._replace(arm=arm)), **options)


@pytest.mark.slow
@pytest.mark.parametrize("order", ["abm", "amb", "mab"])
def test_command_where_one_of_three_has_a_model_of_its_joints(run, files, calibrated, with_gear, monkeypatch, order):
    """Coefficients that a model lacks are 0, and the table says so."""
    records = {"a": calibrated[0], "b": calibrated[1], "m": with_gear}
    for month, name in enumerate(order, start=1):
        saved(records[name], files / f"{name}.h5", f"2026-0{month}-01T00:00:00+00:00", monkeypatch)
    done = run(*(f"{name}.h5" for name in order), "--csv", "table.csv", "--json")
    assert done.exit_code == 0, done.exception
    at = with_gear.names.index("gear_2")
    values = {name: record.vectors()["calibrated"][at] if name == "m" else 0.0 for name, record in records.items()}
    first, *others = json.loads(done.stdout)["trend"]
    for calibration in others:
        row = {row["parameter"]: row for row in calibration["parameters"]}["gear_2"]
        pair = [found["calibration"].removesuffix(".h5") for found in (first, calibration)]
        assert [row["old"], row["new"]] == [values[name] for name in pair]
        lacking = [which for which, name in zip(("old", "new"), pair, strict=True) if name != "m"]
        where = "both calibrations" if len(lacking) == 2 else f"the {lacking[0]} calibration"
        assert row["without"] == f"fixed at 0 by the model in {where}"
        assert (row["unit"], row["u"]) == ("1", None)
    assert len((files / "table.csv").read_text().splitlines()) == 1 + 2 * (21 + 6)


@pytest.mark.slow
def test_command_refuses(run, files):
    """What is refused is raised, and becomes one sentence and exit code 2 in `main`; nothing is written."""
    before = sorted(files.iterdir())
    for arguments, text in (
        (("a.h5",), "a.h5 alone cannot be compared"),
        (("a.h5", "none.h5"), "none.h5 does not exist"),
        (("a.h5", "b.h5", "--figure", "trend.gif"), "a file name that ends in .png, .svg or .pdf"),
        (("a.h5", "b.h5", "--csv", "b.h5"), "b.h5 is one of the files that this command reads"),
        (("a.h5", "b.h5", "--level", 0), "level is 0"),
    ):
        error = run(*arguments).exception
        assert isinstance(error, aj.InputError)
        assert text in str(error)
    assert sorted(files.iterdir()) == before


@pytest.mark.slow
def test_command_in_a_process_of_its_own(aacmm_process, files):
    refused = aacmm_process("compare", "a.h5", "b.h5", "--length-mm", 100000, expect=2)
    assert refused.stderr.startswith("Error: a length of 100000 mm does not fit")


@pytest.mark.slow
def test_a_comparison_is_kept_shown_and_reported(run, files):
    """The file holds what was printed, and the report begins with the answer."""
    for names in (("a.h5", "b.h5"), ("a.h5", "b.h5", "c.h5")):
        printed = run(*names, "-o", "changes.h5").stdout
        shown = command_line(files, "show", "changes.h5").stdout
        assert printed.startswith(shown.rstrip())
        summary = json.loads(run(*names, "--json").stdout)
        assert aj.files.load_comparison(files / "changes.h5") == summary
        report = json.loads(command_line(files, "report", "changes.h5", "-o", "changes.html", "--json").stdout)
        assert report["verdict"] == summary["answer"]
        page = (files / "changes.html").read_text()
        parts = re.split("[:.] ", summary["answer"].split(";")[0])  # a headline, and what follows
        assert [part for part in parts if part[1:] not in page] == []


@pytest.mark.first_rows(1)
@pytest.mark.parametrize("noise", [math.inf, 80.0])
def test_a_change_that_is_called_detectable_is_found_in_95_of_100_cases(old, noise):
    """A change by that size has the noncentrality with which the test has this power."""
    first = certain(old, 0.01, noise)
    same = compare(first, first, points=20)
    assert "No change of the arm is seen. A change would have been seen in 95 of 100 cases if any zero" in same.answer
    size = dict(zip(same.joint_test.names, same.joint_test.detectable, strict=True))["theta_4"]
    test = compare(first, shifted(first, {"theta_4": size}), points=20).joint_test
    rank, freedom = test.rank, test.degrees_of_freedom
    limit = stats.chi2(rank).isf(0.05) if math.isinf(freedom) else stats.f(rank, freedom).isf(0.05)
    power = (
        stats.ncx2(rank, test.statistic).sf(limit)
        if math.isinf(freedom)
        else stats.ncf(rank, freedom, test.statistic).sf(limit)
    )
    assert power == pytest.approx(0.95, abs=1e-3)


@pytest.mark.first_rows(1)
@pytest.mark.parametrize(
    ("changes", "begins"),
    [
        ({}, "No change of the arm is seen"),
        ({"probe_z": 0.3}, "The probe was remounted ("),
        ({"theta_4": 1.2e-4}, "The arm has changed: zero of joint 4 by +"),
        ({"a_2": 0.3}, "The arm has changed: a_2 by +"),
    ],
)
def test_the_answer_comes_first(old, new, changes, begins):
    drift = compare(old, shifted(new, changes), points=20)
    assert drift.answer.startswith(begins)


REMOUNTED = {"probe_z": 0.3}  # the only coordinate of the probe that is free here


@pytest.mark.first_rows(1)
@pytest.mark.parametrize(
    ("changes", "remounted"),
    [({}, None), (REMOUNTED, True), (MOVED, False), ({"a_2": 0.3}, False), ({"theta_2": 1e-3, **REMOUNTED}, False)],
    ids=["nothing", "probe", "arm", "one length", "both"],
)
def test_a_remounted_probe_is_told_from_a_changed_arm(old, new, changes, remounted):
    """Compared are a calibration of the arm and one of the arm with these changes."""
    drift = compare(old, shifted(new, changes), points=20)
    probe = drift.joint_test.probe
    said = " ".join(drift.findings())
    assert ("Probe remounted" in said) == (remounted is True)
    assert ("Not only the probe has changed" in said) == (remounted is False)
    if remounted is None:
        assert probe is None
        return
    assert probe.remounted == remounted
    if remounted:
        assert dict(probe.change)["probe_z"] == pytest.approx(0.3, abs=0.05)
        assert "so the arm has not changed" in said


@pytest.mark.slow
def test_sessions_of_a_real_arm_with_the_ball_remounted(mukca):
    records = []
    for name in ("panda_3", "panda_3_bis"):
        recording = aj.files.read_manifest(mukca / f"{name}.toml")
        bounds = recording.nominal.bounds()
        result = aj.calibrate(bounds.space.base, recording.capture, bounds, undetermined="ignore")
        records.append(aj.calibration.record_of(result, recording))
    drift = compare(*records, points=50)
    assert drift.joint_test.probe.remounted
    assert dict(drift.joint_test.probe.change)["probe_x"] == pytest.approx(-0.347, abs=0.01)
    assert drift.findings()[0].startswith("Probe remounted: a change of the probe alone (probe_x by -34")
    assert drift_summary(drift)["joint"]["probe"]["remounted"]
