"""Kinds whose residuals are none in mm: a theodolite's two angles, and the pixels of a camera, at an unknown place.

What reports lengths takes the distance of the tip from the line of sight, and each kind has its RMS in its own unit.
"""

import json
import math
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Float
from pydantic import Field, create_model

import aacmm_jax as aj
from aacmm_jax.core.linear_algebra import products_by_column
from aacmm_jax.core.numpy_or_jax import AnyArray, namespace, to_numpy
from aacmm_jax.core.rotations import cross, cross_matrix, rotation_and_derivative, rotation_vector
from aacmm_jax.data.observations.declared import Part, declared
from aacmm_jax.data.observations.geometry import seen_from, variances
from aacmm_jax.data.observations.measured import AbstractInBox
from aacmm_jax.data.observations.observation import FRAME, AbstractObservation, Rows
from aacmm_jax.data.observations.simulated import OTHER_KINDS
from aacmm_jax.files import manifest, manifest_tables
from tests.conftest import SLOW, command_line

from .test_observations import POSES, TIPS, Q, check_derivatives, columns

NOISE = aj.Noise(encoder_arcsec=2.0, seating=0.005)
FOCAL = 3000.0  # px


class AbstractSight(AbstractObservation):
    """The tip as seen from an unknown place, in two numbers."""

    noun = "sight"
    frame = Part("frame of {name}", *FRAME)

    def start(self, tips, offset):
        """Directions are parallel to M x + c, which is linear in M and c (direct linear transformation)."""
        xp = namespace(tips)
        middle = xp.mean(tips.position, axis=1, keepdims=True)
        x = (tips.position - middle) / 100.0
        x = xp.concatenate([x, xp.ones_like(x[:1])])
        directions = self.directions(self.seen())
        equations = xp.einsum("ijm,km->mijk", cross_matrix(directions), x).reshape(-1, 12)
        matrix = xp.linalg.svd(equations, full_matrices=False)[2][-1].reshape(3, 4)
        matrix = matrix * xp.sign(xp.sum(directions * (matrix @ x)))
        left, _, right = xp.linalg.svd(matrix[:, :3])
        origin = middle[:, 0] - 100.0 * xp.linalg.inv(matrix[:, :3]) @ matrix[:, 3]
        return {self.frame: xp.concatenate([rotation_vector((left @ right).T), origin])}

    def residual(self, tips, unknowns):
        xp, frame, m = namespace(tips, unknowns), unknowns[self.frame], self.q.shape[0]
        rotation, axes = rotation_and_derivative(frame[:3])
        between = tips.position - frame[3:]
        values, by_local = self.seen_at(products_by_column(rotation.swapaxes(0, 1), between))
        by_tip = xp.einsum("rim,jim->rjm", by_local, xp.broadcast_to(rotation, (3, 3, m)))
        turned = [cross(xp.broadcast_to(axes[:, k], (3, m)), between) for k in range(3)]
        by_turn = [-xp.sum(by_tip * moved[None], axis=1) for moved in turned]
        return Rows(
            values=values - self.seen(),
            by_tip=by_tip,
            by_unknowns={self.frame: xp.concatenate([xp.stack(by_turn), -xp.moveaxis(by_tip, 1, 0)])},
            measured=variances(self.u, m) * xp.asarray(np.eye(2))[None],
        )


class Bearing(AbstractSight):
    """Two angles of a theodolite."""

    kind, table, row_units = "bearing", "bearing", ("rad", "rad")
    azimuth: Float[AnyArray, " m"] = declared("measured azimuth", "rad", "pose")
    elevation: Float[AnyArray, " m"] = declared("measured elevation", "rad", "pose")
    u: Float[AnyArray, ""] = declared("standard uncertainty of an angle", "rad", default=1e-5)

    @classmethod
    def of(cls, name, q, values):
        return cls(name, q, *values)

    def seen(self):
        return namespace(self.azimuth).stack([self.azimuth, self.elevation])

    def directions(self, seen):
        xp, (azimuth, elevation) = namespace(seen), seen
        flat = xp.cos(elevation)
        return xp.stack([flat * xp.cos(azimuth), flat * xp.sin(azimuth), xp.sin(elevation)])

    def seen_at(self, local):
        xp, (x, y, z) = namespace(local), local
        flat, square = xp.sqrt(x**2 + y**2), x**2 + y**2 + z**2
        by_azimuth = xp.stack([-y, x, xp.zeros_like(x)]) / flat[None] ** 2
        by_elevation = xp.stack([-x * z / flat, -y * z / flat, flat]) / square[None]
        return xp.stack([xp.arctan2(y, x), xp.arctan2(z, flat)]), xp.stack([by_azimuth, by_elevation])


class Picture(AbstractSight):
    """Pixels of a camera without distortion."""

    kind, table, row_units = "picture", "picture", ("px", "px")
    pixels: Float[AnyArray, "m 2"] = declared("column and row in the image", "px", "pose", "image_axis")
    u: Float[AnyArray, ""] = declared("standard uncertainty of an image coordinate", "px", default=0.03)

    @classmethod
    def of(cls, name, q, values):
        return cls(name, q, values.T)

    def seen(self):
        return self.pixels.T

    def directions(self, seen):
        xp = namespace(seen)
        return xp.stack([xp.full_like(seen[0], FOCAL), *seen])

    def seen_at(self, local):
        xp, (x, y, z) = namespace(local), local
        none = xp.zeros_like(x)
        by_local = [xp.stack([-y / x, none + 1, none]), xp.stack([-z / x, none, none + 1])]
        return FOCAL * xp.stack([y, z]) / x[None], xp.stack(by_local) * FOCAL / x[None, None]


class AbstractSimulatedSight(AbstractInBox):
    """What is seen of random places in a box."""

    frame: Float[np.ndarray, "6"] = declared("frame of the instrument, its x axis forwards", "mm", moves="frame")
    seen: type[AbstractSight]

    def recorded(self, q, transforms, random):
        exact = self.seen.of(self.name, q, np.zeros((2, len(q))))
        values, _ = exact.seen_at(seen_from(self.frame, transforms[:, :3, 3]).T)
        return self.seen.of(self.name, q, values + exact.u * random.normal(size=values.shape))


class SimulatedBearing(AbstractSimulatedSight):
    """Of a theodolite."""

    table, seen = "bearing", Bearing


class SimulatedPicture(AbstractSimulatedSight):
    """Of a camera."""

    table, seen = "picture", Picture


BOX = [[200, -300, 100], [600, 300, 500]]
KINDS = {"bearing": ("rad", Bearing, SimulatedBearing), "picture": ("px", Picture, SimulatedPicture)}
FRAMES = {"left": (0.1, 0.05, 0.4, -1200, -600, 300), "right": (0, 0.1, -0.5, -1000, 900, 200)}
SOCKETS = {"A": (400, 200, 300), "B": (500, -300, 100), "C": (300, -300, 300), "D": (550, 200, 100)}
LENGTHS = [("A", "B", 0.002), ("C", "D", 0.002)]
UNSEEN = {"E": (450, 100, 250), "F": (550, 100, 250)}
TESTED = [Bearing, SimulatedBearing, Picture, SimulatedPicture]


@pytest.fixture(autouse=True)
def known():
    OTHER_KINDS.extend(TESTED)
    yield
    del OTHER_KINDS[-len(TESTED) :]


@pytest.fixture(scope="module", params=KINDS)
def kind(request):
    return request.param


@pytest.fixture(scope="module")
def recording(kind, paper_arm):
    """Two instruments that see the tip, and two pairs of sockets at a certified distance; and the arm."""
    nominal = aj.kinematics.ArmSpecification(paper_arm, "paper's", length=3.0, angle=0.006)
    true = aj.perturbed_arm(nominal.space(), length=1.0, angle=0.002, seed=1)
    simulated = KINDS[kind][2]
    sights = [simulated(name, BOX, 50, frame) for name, frame in FRAMES.items()]
    capture = aj.simulate(true, SOCKETS, poses=12, lengths=LENGTHS, observations=sights, noise=NOISE, seed=3)
    return aj.Recording(capture, nominal, true=nominal._replace(arm=true))


@pytest.fixture(scope="module", params=SLOW)
def files(recording, kind, tmp_path_factory):
    """Captures of that arm to calibrate from and to evaluate with; what the calibration prints, and its ``--json``."""
    folder = tmp_path_factory.mktemp(kind)
    aj.files.save_capture(folder / "c.h5", recording)
    sights = [KINDS[kind][2]("again", BOX, 20, FRAMES["left"])]
    true = recording.true.arm
    fresh = aj.simulate(true, UNSEEN, poses=8, lengths=[("E", "F", 0.002)], observations=sights, noise=NOISE, seed=8)
    aj.files.save_capture(folder / "fresh.h5", aj.Recording(fresh, recording.nominal))
    OTHER_KINDS.extend(TESTED)
    shown = command_line(folder, "calibrate", "c.h5", "-o", "r.h5", "--cross-validate", "--only-poses", 120)
    summary = json.loads(command_line(folder, "show", "r.h5", "--json").stdout)
    del OTHER_KINDS[-len(TESTED) :]
    return folder, shown.stdout, summary


@pytest.mark.parametrize("observed", [Bearing, Picture])
def test_derivatives_are_exact(observed):
    sight = to_numpy(observed.of("s", Q, np.zeros((2, POSES))))
    frame = np.array([0.1, 0.05, 0.4, -1200, -600, 300])
    values, _ = sight.seen_at(seen_from(frame, TIPS.position.T).T)
    sight = to_numpy(observed.of("s", Q, values))
    found = sight.start(TIPS, np.zeros(3))
    np.testing.assert_allclose(found["frame of s"], frame, atol=1e-6)
    check_derivatives(sight, columns(found))


def test_a_residual_in_mm_is_the_distance_from_the_line_of_sight():
    """Whatever the unit, and nothing along the line, which no residual depends on."""
    frame = np.array([0.1, 0.05, 0.4, -1200, -600, 300])
    for observed in (Bearing, Picture):
        sight = to_numpy(observed.of("s", Q, np.zeros((2, POSES))))
        values, _ = sight.seen_at(seen_from(frame, TIPS.position.T).T)
        sight = to_numpy(observed.of("s", Q, values))
        line = TIPS.position - frame[3:, None]
        line = line / np.linalg.norm(line, axis=0)
        moved = np.random.default_rng(0).normal(size=line.shape) * 1e-3
        rows = sight.residual(TIPS._replace(position=TIPS.position + moved), columns({"frame of s": frame}))
        across = moved - line * np.sum(line * moved, axis=0)
        np.testing.assert_allclose(sight.in_mm(rows.values, rows.by_tip), across, atol=1e-7)


@pytest.mark.parametrize("units", [("rad", "mm"), ("mm", "rad", "px"), ("deg",)])
def test_units_that_no_kind_may_have(units):
    with pytest.raises(TypeError, match="declare the rows in mm first"):
        type("Wrong", (Bearing,), {"row_units": units})


def test_calibrate_prints_each_kind_in_its_unit(files, kind):
    """Noise of 1e-5 rad, or of 0.03 px: about 0.02 mm at that distance, besides errors of the tip."""
    _, shown, summary = files
    unit = KINDS[kind][0]
    key, other = ("rms_angle_rad", "rms_px") if unit == "rad" else ("rms_px", "rms_angle_rad")
    assert "joint: converged" in shown
    assert f"calibrated [{'deg' if unit == 'rad' else 'px'}]" in shown
    rows = {row["observation"]: row for row in summary["observations"]}
    for name in FRAMES:
        row = rows[name]
        assert row["kind"] == kind
        assert row[other] is None
        # What is seen from 1.6 m: the residual in mm, over this distance.
        by_distance = row["rms_after_mm"] / 1600 * (1.0 if unit == "rad" else FOCAL)
        assert 0.6 * by_distance < row[key] < 1.7 * by_distance
        assert row["rms_after_mm"] < 0.05 < row["rms_before_mm"]
        assert row["reduced_chi"] == pytest.approx(1.0, abs=0.3)
    assert rows["A"][key] is None
    assert summary["held_out_poses"]["held_out"]["rms_mm"] < 0.05
    others = {row["observation"]: row for row in summary["held_out_poses"]["observations"]}
    assert others["left"][key] is not None
    assert others["A"].get(key) is None
    largest = summary["truth"]["calibrated"]["length_error_largest_mm"]
    assert largest < 0.5 < summary["truth"]["nominal"]["length_error_largest_mm"]
    assert summary["warnings"] == []


def test_cross_validation_predicts_the_distances(files):
    validation = files[2]["cross_validation"]
    assert validation is not None
    assert not validation["surprising"]
    for row in validation["left_out"]:
        assert 0.5 < row["rms_mm"] / row["rms_predicted_mm"] < 2.0


@pytest.mark.slow
def test_evaluate_compares_with_what_was_predicted(files, kind):
    folder, _, _ = files
    shown = command_line(folder, "evaluate", "r.h5", "fresh.h5", "-o", "e.h5").stdout
    assert f"calibrated [{'deg' if kind == 'bearing' else 'px'}]" in shown
    held_out = json.loads(command_line(folder, "show", "e.h5", "--json").stdout)["held_out"]
    (row,) = held_out["observations"]
    assert 0.5 < row["rms_mm"] / row["rms_predicted_mm"] < 2.0
    assert row["nominal_rms_mm"] > 5 * row["rms_mm"]
    assert 0.5 < row["reduced_chi"] < 1.6
    assert held_out["calibrated"]["observed_rms_mm"] < 0.05
    command_line(folder, "report", "e.h5", "-o", "e.html")
    assert "RMS distance of poses from their geometry" in Path(folder / "e.html").read_text()


@pytest.mark.slow
def test_reports_and_certificates_have_it(files, kind):
    folder, _, _ = files
    command_line(folder, "report", "r.h5", "-o", "r.html")
    page = (folder / "r.html").read_text()
    unit = "deg" if kind == "bearing" else "px"
    for words in (f"calibrated [{unit}]", f"u of measured values [{unit}]", f"[{unit}]"):
        assert words in page
    record = aj.files.load_calibration(folder / "r.h5")
    axes = aj.plot.residuals_by_kind(record, unit)
    assert f"[{unit}]" in axes.get_ylabel()
    wrong = "px" if kind == "bearing" else "deg"
    with pytest.raises(aj.InputError, match=f"no residuals in {wrong}"):
        aj.plot.residuals_by_kind(record, wrong)


@pytest.mark.slow
def test_sights_alone_calibrate_an_arm_whose_scale_is_that_of_its_anchor(recording, kind):
    """Nothing at all is in mm: neither the first weights, nor what is compared."""
    capture = aj.Capture({}, [], recording.capture.observations)
    found = aj.identify(recording.nominal.arm, capture, recording.nominal.bounds(), noise=NOISE)
    assert bool(found.converged)
    assert found.observed.rms < 0.05
    record = aj.calibration.record_of(found, recording._replace(capture=capture, true=None))
    # An uncertainty of 1e-5 is small in mm, not in rad.
    assert "small-u" not in {finding.code for finding in aj.diagnostics.findings_of(record)}
    residuals = aj.diagnostics.pose_residuals.observation_residuals(record)
    assert [[*part.other] for part in residuals] == [[KINDS[kind][0]]] * 2


def test_a_manifest_reads_its_columns(recording, kind, tmp_path, monkeypatch):
    unit, observed, _ = KINDS[kind]
    model = manifest_tables._model(observed)
    monkeypatch.setattr(manifest, "TABLES", manifest_tables.TABLES | {observed: model})
    tables = create_model(
        "Manifest", __base__=manifest.PosesManifest, **{kind: (list[model], Field(default_factory=list))}
    )
    monkeypatch.setattr(manifest, "PosesManifest", tables)
    sight = recording.capture.observations[0]
    entries = [entry for entry in observed.entries if entry.of_poses and entry.name != "q"]
    picked = {entry.name: [f"{entry.name}{i} [{unit}]" for i in range(math.prod(entry.row_shape))] for entry in entries}
    header = ",".join([*(f"q{i}" for i in range(1, 7)), *(name for names in picked.values() for name in names)])
    table = np.column_stack([sight.q, *(getattr(sight, name) for name in picked)])
    np.savetxt(tmp_path / "a.csv", table, "%.17g", ",", header=header, comments="")
    columns_of = ", ".join(f"{name} = {json.dumps(names)}" for name, names in picked.items())
    text = f'arm = "cheng2018-simulation"\n[angles]\nunit = "rad"\n[[{kind}]]\nfile = "a.csv"\n'
    (tmp_path / "c.toml").write_text(f'{text}columns = {{ q = "q?", {columns_of} }}\n')
    (again,) = aj.files.read_manifest(tmp_path / "c.toml").capture.observations
    assert isinstance(again, observed)
    for name in picked:
        np.testing.assert_array_equal(getattr(again, name), getattr(sight, name))


@pytest.mark.slow
def test_plans_choose_poses_of_it(paper_arm, kind):
    item = aj.planning.KitItem(KINDS[kind][2]("sight", BOX, 20, FRAMES["left"]), places=0)
    planned = aj.planning.plan_kit(
        paper_arm, [item, aj.data.observations.SimulatedSphere("ball", (400, 0, 300), 50.0, 9, u=0.001)],
        space=aj.Parameters(paper_arm, ("a_2", "d_4", "theta_3")), poses=20, candidates=120, seed=1,
    )  # fmt: skip
    assert {one.kind for one in planned.observations} == {kind, "sphere"}


@pytest.mark.slow
def test_a_batch_of_arms_is_evaluated_alike(recording):
    """The same numbers from JAX as from NumPy, to rounding."""
    arms = [recording.nominal.arm, recording.true.arm]
    alone = [aj.evaluate(arm, recording.capture).observed for arm in arms]
    together = aj.evaluate(jax.tree.map(lambda *leaves: jnp.stack(leaves), *arms), recording.capture).observed
    for i, one in enumerate(alone):
        for name in ("rms", "rms_angle", "rms_px", "reduced_chi"):
            np.testing.assert_allclose(getattr(together, name)[i], getattr(one, name), rtol=1e-6)


class Exposures(Picture):
    """Pictures that were exposed several times in each pose: two residuals for each."""

    kind, table = "exposures", "exposures"
    pixels: Float[AnyArray, "m r"] = declared("column and row of each exposure", "px", "pose", "exposure")

    @property
    def row_units(self):
        return ("px",) * self.pixels.shape[1]

    def residual(self, tips, unknowns):
        rows, count = super().residual(tips, unknowns), self.rows // 2
        xp = namespace(rows)
        measured = variances(self.u, self.q.shape[0]) * xp.asarray(np.eye(self.rows))[None]
        by_unknowns = {name: xp.concatenate([by] * count, axis=1) for name, by in rows.by_unknowns.items()}
        by_tip, values = (xp.concatenate([array] * count) for array in (rows.by_tip, rows.values + self.seen()))
        return Rows(values - self.pixels.T, by_tip, by_unknowns, measured)

    def seen(self):
        return self.pixels[:, :2].T


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["picture"], indirect=True, scope="module")
def test_a_pose_may_have_more_residuals_than_its_tip_has_coordinates(recording):
    """Ten exposures of each pose count as one whose variance is a tenth."""
    random, once, several = np.random.default_rng(0), [], []
    for sight in recording.capture.observations:
        pixels = np.asarray(sight.pixels)[:, None] + 0.3 * random.normal(size=(len(sight.q), 10, 2))
        several.append(Exposures(sight.name, sight.q, pixels.reshape(len(pixels), -1), u=0.3))
        once.append(Picture(sight.name, sight.q, pixels.mean(axis=1), u=0.3 / np.sqrt(10)))
    bounds, found, unseen = recording.nominal.bounds(), [], []
    for observations in (once, several):
        capture = aj.Capture(recording.capture.sockets, recording.capture.lengths, observations)
        found.append(aj.calibrate(recording.nominal.arm, capture, bounds, noise=NOISE))
        assert bool(found[-1].converged)
        # Compared with the same poses, as if they were others.
        unseen.append(aj.calibration.unseen_errors(aj.uncertainty_of(found[-1]), capture).of(["left", "right"]))
    np.testing.assert_allclose(found[0].parameters, found[1].parameters, atol=1e-6)
    covariances = [result.parameter_covariance.matrix for result in found]
    np.testing.assert_allclose(*covariances, rtol=1e-3, atol=1e-9 * np.abs(covariances[0]).max())
    np.testing.assert_allclose(found[1].observed.reduced_chi[-2:], 1.0, atol=0.15)
    np.testing.assert_allclose(found[0].observed.rms_after, found[1].observed.rms_after, rtol=1e-3)
    for name in ("count", "rms", "predicted"):
        assert getattr(unseen[0], name) == pytest.approx(getattr(unseen[1], name), rel=1e-3)
