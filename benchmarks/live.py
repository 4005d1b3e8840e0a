"""Live captures: the poses that guidance needs, rest told from creep, and the time from a pose to the next one.

`python benchmarks/live.py [arms] [stillness] [time]` writes results/live.json, which it updates part by part.

*Arms.* For each layout (an arm, and four sockets with two reference lengths where a plan of 25 poses places them) and
each simulated arm the target is the largest uncertainty of a length after that plan, whose poses an operator takes with
joints off by 3 deg. Counted is how many poses reach it: guided without the plan, guided from the plan, random
candidates, and a person's habit (six neighbouring poses in a socket, then the next socket). What a pose tells is that
of its rows at the configuration that was taken.

*Stillness.* Sessions of forty poses of six joints: a motion, creep for 0.5 to 2 s, rest; tremor of 3 to 30 times the
encoders' noise at 8 to 12 Hz, or wandering with a correlation time of 0.1 s. Creep is stated as the drift in 0.3 s in
standard deviations of the tremor. A take states where the arm is. It is false where the arm's motion within the
readings that are averaged moves their mean away from where the arm is at the take, without tremor and noise, by more
than the standard deviation of the tremor (root mean square over joints). A slower creep is taken, and counted beside.
The first three rests teach. Late is a rest that is taken later than 0.4 s after its begin.

*Time.* Seven joints, 200 poses: CPU from a pose to residuals and the next pose.
"""

import json
import sys
import time
from pathlib import Path

import numpy as np

import aacmm_jax as aj
from aacmm_jax.core.numpy_or_jax import to_numpy
from aacmm_jax.data.observations import SimulatedSocket
from aacmm_jax.kinematics.arm import joint_limits
from aacmm_jax.kinematics.inverse_kinematics import project_to_targets
from aacmm_jax.kinematics.workspace import reached
from aacmm_jax.live.candidates import Search
from aacmm_jax.live.guidance import Guide
from aacmm_jax.live.places import Setup, TakenPose, setup_of
from aacmm_jax.live.proposals import Proposals
from aacmm_jax.live.samples import Sample
from aacmm_jax.live.stillness import Stillness

FILE = Path(__file__).parent / "results" / "live.json"
LAYOUTS = (("cheng2018-simulation", 0), ("panda", 0), ("cheng2018-simulation", 1), ("panda", 1), ("ur10e", 0))
ARMS, POSES, MOST, OFF = 10, 25, 150, np.radians(3)
RATE, ENCODER, JOINTS = 100, 1e-5, 6


def layout(name: str, seed: int) -> tuple[Setup, aj.planning.Plan]:
    specification, noise = aj.files.load_specification(name), aj.files.load_noise(name)
    # What sockets and lengths determine: theta_n of a robot changes no tip.
    names = aj.Parameters.independent(specification.arm)
    specification = specification._replace(held=names.held)
    planned = aj.planning.plan(
        specification.arm, sockets=4, poses=POSES, candidates=800, seed=seed, space=names, noise=noise.noise
    )
    sockets = list(planned.sockets)
    kit = [SimulatedSocket(name, point, poses=10) for name, point in planned.sockets.items()]
    poses = [(sockets[i], q) for i, q in zip(planned.owner, planned.q, strict=True)]
    return setup_of(specification, noise, kit, planned.lengths, poses), planned


def taken_rows(search: Search, seed: int) -> np.ndarray:
    """Rows of all candidates as an operator takes them with a simulated arm."""
    random, space = np.random.default_rng(seed), search.problem.space
    true = to_numpy(aj.perturbed_arm(space, length=0.5, angle=1e-3, seed=seed))
    sets = []
    for parts in search._sets:
        moved = []
        for thing, part in zip(search.things.values(), parts, strict=True):
            q = np.asarray(part.q)
            seat = thing.seat(search.problem.region)._replace(arm=true)
            targets = np.tile(np.asarray(search.setup.place(thing.simulated.name).position), (len(q), 1))
            there, good = reached(seat, q + OFF * random.normal(size=q.shape), targets)
            moved.append(thing.recorded(search.problem.region, np.where(good[:, None], there, q), part))
        sets.append(moved)
    return search._pool(sets, "", "").candidates.rows


def counted(search: Search, rows: np.ndarray, order: np.ndarray, target: float) -> int:
    """How many poses, in this order, reach a target."""
    information = search.pool().candidates.base.copy()
    for number, i in enumerate(order[:MOST], 1):
        information = information + rows[i].T @ rows[i]
        if search.u(information) <= target:
            return number
    return MOST


def guided(search: Search, rows: np.ndarray, target: float) -> int:
    """How many poses guidance takes, each where it is proposed."""
    pool, ahead, now, taken = search.pool(), list(search.planned), None, list[TakenPose]()
    names = [place.name for place in search.setup.places]
    information, counts = pool.candidates.base.copy(), np.zeros(len(names), dtype=int)
    for number in range(1, MOST):
        known = pool.known(information)
        proposed = Proposals(search, known, search.problem.arm, {}, taken, now, ()).best(ahead, None)
        if proposed is None:
            return MOST
        same = (pool.place == names.index(proposed.place)) & (pool.q == proposed.q).all(axis=1)
        best, now = int(np.flatnonzero(same)[0]), proposed.q
        ahead = [row for row in ahead if row != best]
        taken.append(TakenPose(number, proposed.place, 0.0, now, np.zeros(len(now))))
        counts[pool.place[best]] += 1
        information = information + rows[best].T @ rows[best]
        u = search.u(information)
        if u <= target:
            return number
        ahead = search.ahead(
            pool.known(information), ahead, np.maximum(2 - counts, 0), target if u < 3 else None, search.lacking(taken)
        )
    return MOST


def habit(search: Search, random: np.random.Generator) -> np.ndarray:
    """Six neighbouring poses in a socket, then in the next."""
    pool, order, now = search.pool(), list[int](), None
    left = np.ones(len(pool.q), dtype=bool)
    while len(order) < MOST and left.any():
        for place in np.unique(pool.place):
            for _ in range(6):
                rows = np.flatnonzero(left & (pool.place == place))
                if not len(rows):
                    break
                near = 0 if now is None else np.argmin(np.abs(pool.q[rows] - now).sum(axis=1))
                order.append(int(rows[near if now is not None else random.integers(len(rows))]))
                left[order[-1]], now = False, pool.q[order[-1]]
    return np.array(order)


def arms() -> None:
    rows_of = []
    for name, seed in LAYOUTS:
        try:
            setup, _ = layout(name, seed)
            from_plan, alone = Search(setup), Search(setup._replace(planned=()))
        except aj.InputError as error:
            print(name, seed, error)
            continue
        for number in range(ARMS):
            random = np.random.default_rng(number)
            rows = taken_rows(from_plan, number)
            planned = from_plan.planned
            target = from_plan.u(from_plan.pool().known(from_plan.pool().candidates.base).information(rows[planned]))
            drawn = [counted(from_plan, rows, random.permutation(len(rows)), target) for _ in range(3)]
            row = {
                "arm": name, "layout": seed, "number": number, "plan": POSES,
                "guided": guided(alone, taken_rows(alone, number), target),
                "guided from the plan": guided(from_plan, rows, target),
                "random": float(np.median(drawn)), "habit": counted(from_plan, rows, habit(from_plan, random), target),
            }  # fmt: skip
            print(row, flush=True)
            rows_of.append(row)
        written("arms", rows_of)


def tremor(random: np.random.Generator, count: int, level: float, kind: str) -> np.ndarray:
    if kind == "wandering":
        moves, now = random.normal(size=(count, JOINTS)), random.normal(size=JOINTS)
        for i in range(count):
            now = moves[i] = 0.9 * now + 0.436 * moves[i]
        return level * ENCODER * moves
    times = np.arange(count)[:, None] / RATE
    phase = random.uniform(0, 2 * np.pi, JOINTS) + np.cumsum(random.normal(size=(count, JOINTS)), 0) / np.sqrt(RATE)
    return level * ENCODER * np.sqrt(2) * np.sin(2 * np.pi * random.uniform(8, 12, JOINTS) * times + phase)


def session(seed: int, kind: str, creep: float) -> list[tuple[int, float, float, float]]:
    """Of each take: number of the pose, time since its rest began, s, its error in tremors, and in what it states."""
    random, q, parts, rests = np.random.default_rng(seed), np.zeros(JOINTS), [], []
    level = np.exp(random.uniform(np.log(3), np.log(30)))
    for number in range(RESTS):
        goal, s = random.uniform(-0.5, 0.5, JOINTS), np.linspace(0, 1, int(random.uniform(60, 150)))[:, None]
        parts.append(q + (10 * s**3 - 15 * s**4 + 6 * s**5) * (goal - q))
        q = goal
        if number >= TAUGHT and creep:
            way = random.normal(size=JOINTS)
            steps = np.arange(1, int(random.uniform(50, 200)))[:, None] / RATE / 0.3
            parts.append(q + steps * creep * level * ENCODER * way / np.sqrt(np.mean(way**2)))
            q = parts[-1][-1]
        at, hold = sum(map(len, parts)), int(random.uniform(100, 200))
        parts.append(np.tile(q, (hold, 1)))
        rests.append((at, at + hold))
    true = np.concatenate(parts)
    readings = true + tremor(random, len(true), level, kind) + ENCODER * random.normal(size=true.shape)
    stillness, before, takes = Stillness(JOINTS), False, []
    for i, reading in enumerate(readings):
        stillness.add(Sample(i / RATE, reading))
        rest = stillness.rest
        if rest is not None and not before:
            number, begin = next((n, begin) for n, (begin, end) in enumerate(rests) if i < end)
            away = true[i + 1 - rest.count : i + 1].mean(axis=0) - true[i]
            error, stated = (float(np.sqrt(np.mean((away / u) ** 2))) for u in (level * ENCODER, rest.u))
            takes.append((number, (i - begin) / RATE, error, stated))
        before = rest is not None
    return [take for take in takes if take[0] >= TAUGHT]


def stillness() -> None:
    rows = []
    for kind in KINDS:
        for creep in (0, 1, 3, 4, 5, 10, 30):
            takes, late = [], []
            for seed in range(SESSIONS):
                found = session(seed, kind, creep)
                takes += found
                first = {number: after for number, after, error, _ in reversed(found) if error <= 1}
                late += [first.get(number, np.inf) for number in range(TAUGHT, RESTS)]
            _, after, errors, stated = np.array(takes).T
            row = {
                "tremor": kind, "creep": creep, "rests": len(late), "takes": len(takes),
                "false": int(np.sum(errors > 1)), "in creep": int(np.sum(after < 0)), "largest error": errors.max(),
                "error over stated u, 99.9 %": float(np.quantile(stated, 0.999)),
                "median_s": float(np.median(late)), "95_s": float(np.quantile(late, 0.95)),
                "within_0.4_s": float(np.mean(np.array(late) <= 0.4)),
            }  # fmt: skip
            print(row, flush=True)
            rows.append(row)
            written("stillness", rows)


def times() -> None:
    setup, _ = layout("panda", 0)
    guide, random = Guide(setup, 1e-3), np.random.default_rng(0)
    true = to_numpy(aj.perturbed_arm(setup.specification.space(), length=0.5, angle=1e-3, seed=1))
    pool, poses, limits = guide.search.pool(), [], np.asarray(joint_limits(true, None))
    for number, i in enumerate(random.permutation(len(pool.q))[:230], 1):
        place = setup.places[pool.place[i]]
        q, arrived = project_to_targets(true, pool.q[[i]], np.asarray(place.position)[None], limits)
        if arrived[0]:
            read = q[0] + float(setup.noise.noise.encoder) * random.normal(size=7)
            poses.append(TakenPose(number, place.name, 0.0, read, np.zeros(7)))
    taken = []
    for count in range(195, 205):
        begin = time.process_time()
        guide.next_pose(guide.calibrated(poses[:count]), poses[count].q)
        taken.append(time.process_time() - begin)
    row = {"median_s": float(np.median(taken[1:])), "largest_s": float(max(taken[1:])), "first_s": taken[0]}
    print(row)
    written("time", row)


SESSIONS, RESTS, TAUGHT, KINDS = 28, 40, 3, ("8 to 12 Hz", "wandering")


def written(key: str, value: object) -> None:
    known = json.loads(FILE.read_text()) if FILE.exists() else {}
    FILE.write_text(json.dumps(known | {key: value}, indent=1) + "\n")


if __name__ == "__main__":
    for part in sys.argv[1:] or ("arms", "stillness", "time"):
        {"arms": arms, "stillness": stillness, "time": times}[part]()
