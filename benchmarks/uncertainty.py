"""Are the uncertainties right? Coverage of 95 % intervals, planning against random poses, and real captures.

``python benchmarks/uncertainty.py [PART ...]`` runs the parts named (default: all) and writes
``results/uncertainty-DATE-PART.json``. About 20 minutes on two cores in all.
"""

import argparse
import datetime
import json
import math
import time
import warnings
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import aacmm_jax as aj
from aacmm_jax.uncertainty.degrees_of_freedom import Law, coverage_factor

ARCSEC = aj.units.ARCSEC
CAPTURES = Path(__file__).resolve().parents[1] / "examples/mukca"
NOISE = aj.Noise(encoder_arcsec=2.0, seating=0.005)
SIZES, NAMES = (70, 5, 5), ("S", "A", "B")
ENDS = [[[400, 200, 300], [700, 500, 500]]]


def study_of(trials: int, length_bound: float) -> aj.study.Study:
    """The paper's arm off by up to 1 mm and 0.1 deg; 70 poses in a socket, five at each end of a length, u = 2 um."""
    return aj.study.make_study(
        arm="cheng2018-simulation",
        trials=trials,
        seed=3,
        deviation={"length_mm": 1.0, "angle_deg": 0.1},
        capture={"positions_mm": [[400, 200, 300]], "poses": 70},
        noise={"encoder_arcsec": 2, "seating_mm": 0.005},
        reference={"ends_mm": [[ENDS[0][0], ENDS[0][1]]], "poses": 5, "u_mm": 0.002},
        bounds={"length_mm": length_bound},
        identification={"method": "joint"},
    )


def drawn_of(study: aj.study.Study, trials: int):
    """Readings, true parameters and certified values of every trial."""
    return aj.study.draw_trials(study, 0, np.arange(trials))[0]


def capture_of(q, value) -> aj.Capture:
    """One trial's capture."""
    ends = np.cumsum(SIZES)
    sockets = {name: q[end - size : end] for name, size, end in zip(NAMES, SIZES, ends, strict=True)}
    return aj.Capture(sockets, [aj.ReferenceLength("A", "B", value, 0.002)])


def lengths_over_volume(arm: aj.Arm) -> tuple[np.ndarray, np.ndarray]:
    """Sixty lengths of 300 mm and twenty of any length, all over the volume."""
    pairs = [
        aj.uncertainty.sample_lengths(arm, 60, length=300.0, seed=5),
        aj.uncertainty.sample_lengths(arm, 20, length=None, seed=6),
    ]
    return tuple(np.concatenate(column) for column in zip(*pairs, strict=True))


def calibrated(study, drawn, lengths, method, noise, noise_model, hold="d_3"):
    """Every trial by `aj.calibrate`: errors of parameters, k and lengths, their u, coverage factors, active bounds."""
    arm, space = study.nominal.arm, study.space
    bounds = aj.Bounds(space, drawn.lower[0], drawn.upper[0])
    start, end = (jnp.asarray(q) for q in lengths)

    def one(row):
        q, value, true = row
        result = aj.calibrate(
            arm, capture_of(q, value), bounds, method=method, noise=noise, noise_model=noise_model, hold=hold
        )
        uncertainty = aj.uncertainty_of(result)

        def measured(vector):
            body = space.arm(vector)
            return jnp.linalg.norm(body.position(start) - body.position(end), axis=-1)

        k = arm.d[2] / true[space.index("d_3")]
        errors = jnp.concatenate([
            result.parameters - true, jnp.stack([result.scale.value - k]), measured(result.parameters) - measured(true)
        ])  # fmt: skip
        u = jnp.concatenate([
            jnp.sqrt(jnp.diagonal(result.covariance)), jnp.stack([result.scale.u]), uncertainty.length(start, end)
        ])  # fmt: skip
        parts = jnp.concatenate([
            uncertainty.parts(jnp.eye(len(space.names))), uncertainty.length_parts(start, end)
        ])  # fmt: skip
        of_k = jnp.stack([result.scale.u**2 - result.scale.surplus, result.scale.surplus])
        freedom = jnp.asarray([uncertainty.scatter_degrees_of_freedom, max(uncertainty.lengths - 1, 1)])
        return errors, u, result.active, result.converged, parts, uncertainty.law, of_k, freedom

    rows = (jnp.asarray(drawn.q), jnp.asarray(drawn.value[:, 0]), jnp.asarray(drawn.true))
    found = jax.jit(lambda r: jax.lax.map(one, r, batch_size=16))(rows)
    errors, u, active, good, parts = (np.asarray(x) for x in found[:5])
    law, freedom = (jax.tree.map(lambda x: np.asarray(x)[0], each) for each in (found[5], found[7]))
    factor, p = coverage_factor(0.95, parts, law), len(space.names)
    factor = np.insert(factor, p, coverage_factor(0.95, np.asarray(found[6]), Law.of(freedom)), axis=1)
    return errors, u, factor, active, good


def coverage_row(inside: np.ndarray, names: tuple[str, ...]) -> dict:
    """Coverage in per cent: parameters, k, lengths; with the least and most covered."""
    share = 100 * np.nanmean(inside, axis=0)
    p = len(names)
    return {
        "parameters": [round(float(share[:p].min()), 2), round(float(share[:p].max()), 2)],
        "least": names[int(np.argmin(share[:p]))],
        "k": round(float(share[p]), 2),
        "lengths": [round(float(share[p + 1 :].min()), 2), round(float(share[p + 1 :].max()), 2)],
        "standard_error": round(100 * math.sqrt(0.95 * 0.05 / len(inside)), 2),
    }


def coverage(trials: int = 10_000) -> dict:
    """How often 95 % intervals hold the truth, for each view of the errors and each method."""
    study = study_of(trials, 10.0)
    drawn, lengths = drawn_of(study, trials), lengths_over_volume(study.nominal.arm)
    found = {"trials": trials}
    for method in ("joint", "two-stage"):
        for noise, noise_model in ((NOISE, "given"), (None, "estimated"), (None, "common"), (None, "robust")):
            begun = time.perf_counter()
            errors, u, factor, active, good = calibrated(study, drawn, lengths, method, noise, noise_model)
            row = coverage_row(np.abs(errors) <= factor * u, study.space.names)
            row |= {
                "factor": round(float(np.median(factor)), 3),
                "converged": float(good.mean()),
                "active": int(np.any(active, axis=1).sum()),
            }
            row["seconds"] = round(time.perf_counter() - begun, 1)
            found[f"{method}, {noise_model}"] = row
            print(method, noise_model, row, flush=True)
    return found


def sampled(trials: int = 10_000, draws: int = 199, length_bound: float = 10.0) -> dict:
    """Monte Carlo intervals: of each calibration, 199 repetitions about its own result; the interval is from the 5th to
    the 195th, which contains one more independent draw in 190 of 200 cases."""
    study = study_of(trials, length_bound)
    drawn, lengths = drawn_of(study, trials), lengths_over_volume(study.nominal.arm)
    arm, space = study.nominal.arm, study.space
    random = np.random.default_rng(8)
    owner = np.repeat(np.arange(3), SIZES)
    averaging = (owner[None] == np.arange(3)[:, None]) / np.array(SIZES)[:, None]
    bounds = aj.Bounds(space, drawn.lower[0], drawn.upper[0])
    template = capture_of(jnp.asarray(drawn.q[0]), 1.0)
    captures = aj.calibration.batch_of_captures(template, drawn.q, drawn.value)
    many = aj.calibrate_many(arm, captures, bounds, method="joint", noise=NOISE)
    start, end = (jnp.asarray(q) for q in lengths)

    @jax.jit
    def outputs(vectors):
        def one(vector):
            body = space.arm(vector)
            return jnp.linalg.norm(body.position(start) - body.position(end), axis=-1)

        return jax.lax.map(one, vectors, batch_size=256)

    inside, at_once, done = [], 50, 0
    begun = time.perf_counter()
    while done < trials:
        readings, values = [], []
        for i in range(done, min(done + at_once, trials)):
            body = space.arm(many.parameters[i])
            centroids = averaging @ np.asarray(body.position(drawn.q[i]))
            exact, _ = aj.kinematics.project_to_targets(body, drawn.q[i], centroids[owner])
            moves = np.linalg.pinv(np.asarray(body.jacobian(exact, [f"q_{j}" for j in range(1, 7)])))
            seats = 0.005 * random.normal(size=(draws, len(owner), 3))
            q = exact + np.einsum("Nic,tNc->tNi", moves, seats) + 2 * ARCSEC * random.normal(size=(draws, *exact.shape))
            readings.append(q)
            size = np.linalg.norm(centroids[2] - centroids[1])
            values.append(size + 0.002 * random.normal(size=(draws, 1)))
        again = aj.calibrate_many(
            arm,
            aj.calibration.batch_of_captures(template, np.concatenate(readings), np.concatenate(values)),
            bounds.lower,
            bounds.upper,
            many.stage1.parameters[done],
            method="joint",
            noise=NOISE,
        )
        count = len(readings)
        found = np.hstack([again.parameters, again.k[:, None], np.asarray(outputs(jnp.asarray(again.parameters)))])
        found = np.sort(found.reshape(count, draws, -1), axis=1)
        true = drawn.true[done : done + count]
        k = float(arm.d[2]) / true[:, space.index("d_3")]
        truth = np.hstack([true, k[:, None], np.asarray(outputs(jnp.asarray(true)))])
        inside.append((found[:, 4] <= truth) & (truth <= found[:, 194]))
        done += count
        if done % 1000 == 0:
            print(done, round(time.perf_counter() - begun), "s", flush=True)
    row = coverage_row(np.concatenate(inside).astype(float), space.names)
    print("sampled", row, flush=True)
    return {"trials": trials, "draws": draws, "joint, given": row}


def bounded(trials: int = 10_000) -> dict:
    """Boxes as narrow as the arm's errors, or narrower: coverage of parameters that are inside, and of lengths."""
    found = {"trials": trials}
    for width in (1.0, 0.9):
        study = study_of(trials, width)
        drawn, lengths = drawn_of(study, trials), lengths_over_volume(study.nominal.arm)
        p = len(study.space.names)
        for method, hold in (("joint", "d_3"), ("two-stage", None)):
            errors, u, factor, active, _ = calibrated(study, drawn, lengths, method, NOISE, "given", hold)
            held = np.any(active != 0, axis=1)
            outside = np.any((drawn.true < drawn.lower) | (drawn.true > drawn.upper), axis=1)
            inside = (np.abs(errors) <= factor * u).astype(float)
            inside[:, :p][active != 0] = np.nan  # on a bound: flagged, no interval is claimed
            row = {"active": round(100 * float(held.mean()), 1), "truth_outside": round(100 * float(outside.mean()), 1)}
            for what, rows in (
                ("none active", ~held),
                ("active, truth inside", held & ~outside),
                ("truth outside", outside),
            ):
                if rows.sum() > 50:
                    row[what] = coverage_row(inside[rows], study.space.names)
            found[f"half-width {width} mm, {method}, hold {hold}"] = row
            print(width, method, row, flush=True)
    return found


def shipped(trials: int = 400) -> dict:
    """Coverage of every free parameter of the shipped arms, one calibration after the other as a user makes them."""
    found: dict = {"trials": trials}
    for name, fixed in (
        ("cheng2018-simulation", ()),
        ("panda", ()),
        ("iiwa14", ()),
        ("panda", ("alpha_6", "theta_6")),
        ("iiwa14", ("alpha_6", "theta_6")),
    ):
        specification = aj.files.load_specification(name)
        free = specification.bounds().space.names
        space = aj.Parameters(specification.arm, tuple(other for other in free if other not in fixed))
        for method in ("two-stage", "joint"):
            row = shipped_coverage(space, method, trials)
            found[f"{name}{', fixed ' * bool(fixed)}{' and '.join(fixed)}, {method}"] = row
            print(name, fixed, method, row, flush=True)
    return found


def shipped_coverage(space: aj.Parameters, method: str, trials: int, seed: int = 4) -> dict:
    """Coverage of the 95 % intervals of each free parameter, %, over recordings of one arm that is not the nominal
    one."""
    true = aj.perturbed_arm(space, length=0.5, angle=1e-3, seed=seed)
    reach = 0.6 * float(np.abs(np.asarray(space.base.a)).sum() + np.abs(np.asarray(space.base.d[1:])).sum())
    directions = np.array([[0.6, 0.2, 0.1], [0.3, -0.5, 0.2], [-0.4, 0.4, 0.3], [0.2, 0.5, -0.1]])
    base = np.array([0, 0, float(space.base.d[0])])
    sockets = dict(
        zip("ABCD", base + reach * directions / np.linalg.norm(directions, axis=1, keepdims=True), strict=True)
    )
    exact = aj.simulate(true, sockets, poses=25, lengths=[("A", "B", 0.0), ("C", "D", 0.0)], seed=seed)
    q = np.asarray(exact.q)
    moves = np.linalg.pinv(np.asarray(true.jacobian(q, [f"q_{i}" for i in range(1, true.joints + 1)])))
    random, truth = np.random.default_rng(seed), np.asarray(space.vector(true))
    bounds = aj.Bounds.around(space.base, space, length=10.0, angle=0.0349)
    inside, active = [], 0
    for _ in range(trials):
        seats = 0.005 * random.normal(size=(len(q), 3))
        readings = q + np.einsum("Nic,Nc->Ni", moves, seats) + 2 * ARCSEC * random.normal(size=q.shape)
        rows = {name: readings[exact.owner == i] for i, name in enumerate(exact.names)}
        lengths = [
            aj.ReferenceLength(r.start, r.end, float(r.value) + 0.002 * random.normal(), 0.002) for r in exact.lengths
        ]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", aj.IdentifiabilityWarning)
            result = aj.calibrate(space.base, aj.Capture(rows, lengths), bounds, method=method)
        u = np.sqrt(np.diag(result.covariance))
        inside.append(np.abs(np.asarray(result.parameters) - truth) <= aj.uncertainty_of(result).factor(0.95) * u)
        active += bool(result.active_names())
    share = 100 * np.mean(inside, axis=0)
    return {
        "parameters": [round(float(share.min()), 2), round(float(share.max()), 2)],
        "mean": round(float(share.mean()), 2),
        "least": space.names[int(np.argmin(share))],
        "active": active,
        "standard_error": round(100 * math.sqrt(0.95 * 0.05 / trials), 2),
        "each": {name: round(float(value), 2) for name, value in zip(space.names, share, strict=True)},
    }


def planned(sets: int = 100) -> dict:
    """Planned against 70 random poses: the largest uncertainty of 400 lengths of 300 mm, by formula and simulation."""
    arm = aj.load_arm("cheng2018-simulation")
    space = aj.Parameters.free_of(arm)
    start, end = aj.uncertainty.sample_lengths(arm, 400, length=300.0, seed=99)
    found = {"plans": []}
    # Random poses know no table, so plans are compared without one; and shown with one.
    for above in (0.0, -math.inf):
        for seed in range(3):
            begun = time.perf_counter()
            plan = aj.planning.plan(arm, sockets=4, poses=25, seed=seed, above=above)
            seconds = time.perf_counter() - begun
            row = {"seed": seed, "table": above == 0.0, "seconds": round(seconds, 1)}
            row |= largest_uncertainty(arm, space, plan.capture(), start, end, 1000)
            found["plans"].append(row)
            print("plan", row, flush=True)
    given = {"S": (400, 200, 300), "A": (400, 200, 300), "B": (700, 500, 500)}
    planned_sockets = plan.sockets
    demonstration = {name: given[name] for name in "AB"}
    one, two = [("A", "B", 0.0)], [("A", "B", 0.0), ("C", "D", 0.0)]
    for name, sockets, poses, lengths in (
        ("70 random: 60 and 10 in the demonstration's sockets", demonstration, {"A": 60, "B": 10}, one),
        ("70 random: 35 and 35 in the demonstration's sockets", demonstration, 35, one),
        ("70 random in the last plan's sockets", planned_sockets, {"A": 18, "B": 18, "C": 17, "D": 17}, two),
        ("25 random in the last plan's sockets", planned_sockets, {"A": 7, "B": 6, "C": 6, "D": 6}, two),
    ):
        captures = (aj.simulate(arm, sockets, poses=poses, lengths=lengths, seed=seed) for seed in range(sets))
        rows = [largest_uncertainty(arm, space, capture, start, end, 100) for capture in captures]
        found[name] = {key: round(float(np.median([row[key] for row in rows])), 2) for key in rows[0]}
        print(name, found[name], flush=True)
    return found


def largest_uncertainty(arm, space, capture, start, end, draws) -> dict:
    """Largest standard uncertainty of lengths, um: predicted, and found in simulated calibrations."""
    lengths = [aj.ReferenceLength(r.start, r.end, r.value, 0.002) for r in capture.lengths]
    capture = aj.Capture(capture.sockets, lengths)
    bounds = aj.Bounds.around(arm, space)
    result = aj.calibrate(arm, capture, bounds, method="joint", noise=NOISE)
    predicted = 1e3 * np.asarray(aj.uncertainty_of(result).length(start, end))
    random = np.random.default_rng(1)
    moves = np.linalg.pinv(np.asarray(arm.jacobian(capture.q, [f"q_{j}" for j in range(1, 7)])))
    seats = 0.005 * random.normal(size=(draws, *capture.q.shape[:1], 3))
    q = (
        np.asarray(capture.q)
        + np.einsum("Nic,tNc->tNi", moves, seats)
        + 2 * ARCSEC * random.normal(size=(draws, *capture.q.shape))
    )
    values = np.array([float(r.value) for r in lengths]) + 0.002 * random.normal(size=(draws, len(lengths)))
    captures = aj.calibration.batch_of_captures(capture, q, values)
    many = aj.calibrate_many(arm, captures, bounds, method="joint", noise=NOISE)
    measured = _measured(space, jnp.asarray(many.parameters), jnp.asarray(start), jnp.asarray(end))
    off = 1e3 * (
        np.asarray(measured) - np.linalg.norm(np.asarray(arm.position(start)) - np.asarray(arm.position(end)), axis=1)
    )
    rms = np.sqrt(np.mean(off**2, axis=0))
    # The largest of 400 estimates is too large by chance: the length of the largest prediction is looked at too.
    at = int(np.argmax(predicted))
    metrics = {
        "largest_predicted": predicted.max(),
        "found_there": rms[at],
        "median_predicted": np.median(predicted),
        "median_found": np.median(rms),
        "largest_found": rms.max(),
    }
    return {name: round(float(value), 2) for name, value in metrics.items()}


@eqx.filter_jit
def _measured(space, vectors, start, end):
    def one(vector):
        body = space.arm(vector)
        return jnp.linalg.norm(body.position(start) - body.position(end), axis=-1)

    return jax.lax.map(one, vectors, batch_size=100)


def real() -> dict:
    """Recorded captures: errors in each placement left out, predicted from the others and found."""
    found = {}
    for name, manifest, bound in (
        ("panda_2_clean", "capture", None),
        ("panda_6", "panda_6", 10.0),
        ("kuka_14", "kuka_14", None),
    ):
        recording = aj.files.read_manifest(CAPTURES / f"{manifest}.toml")
        capture, nominal = recording.capture, recording.nominal
        nominal = nominal if bound is None else nominal._replace(length=bound)
        for method in ("two-stage", "joint"):
            checked = aj.cross_validate(nominal.arm, capture, nominal.bounds(), method=method, hold="d_3")
            row = {
                "rms_mm": checked.rms,
                "rms_predicted_mm": checked.rms_predicted,
                "length_error_rms_mm": checked.length_rms,
                "length_u_mm": checked.length_u,
                "excess": checked.excess,
            }
            found[f"{name}, {method}"] = {key: round(value, 3) for key, value in row.items()}
            print(name, method, found[f"{name}, {method}"], flush=True)
    return found


PARTS = {
    "coverage": coverage,
    "sampled": sampled,
    "bounded": bounded,
    "planned": planned,
    "real": real,
    "shipped": shipped,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", nargs="*", choices=[*PARTS, []], default=[])
    parser.add_argument("--trials", type=int, help="instead of 10,000")
    given = parser.parse_args()
    for part in given.part or list(PARTS):
        trials = () if part in ("planned", "real") or given.trials is None else (given.trials,)
        found = PARTS[part](*trials)
        path = Path(__file__).parent / "results" / f"uncertainty-{datetime.date.today()}-{part}.json"
        path.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
