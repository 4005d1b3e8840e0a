"""Table 3, figure 8 and the 93 %: where the printed numbers lie among a thousand twins of the experiment."""

import csv

import numpy as np
import paper_method
import twin
from paper import FITTED, HERE, PUBLISHED, STORED, Row, box, number, position_in, random_starts, read_table, row, vector

TWINS = 1_000
SEED = 6
METHODS, AGAIN = 24, 2  # twins that the paper's method is also run on, and of these run again each time
KINDS = {"encoder noise alone": (0,), "seating alone": (1,), "eccentricity alone": (2,), "all three": (0, 1, 2)}


def noise_models(made: twin.Pool, rows: list[Row], search: bool) -> tuple[twin.Noise, list[dict[str, float | str]]]:
    """Which noise explains the printed metrics: each kind fitted to DE of Data1, and all three fitted to more.

    Fits are run again only with ``search``; otherwise it is checked that those stored are minima.
    """
    wanted, table, chosen = twin.printed_targets(), [], twin.Noise(0.0, 0.0, 0.0)
    stored, minima = {}, 0
    if not search:
        with (HERE / "results" / "noise_models.csv").open(newline="") as file:
            stored = {line["noise"]: line for line in csv.DictReader(file)}
    for name, kinds in KINDS.items():
        targets = 1 if len(kinds) == 1 else 3
        if search:
            noise = twin.fitted_noise(made, kinds=kinds, targets=targets)
        else:
            noise = twin.Noise(*(float(stored[name][key]) for key in twin.Noise._fields))
        minima += twin.is_fitted(made, noise, kinds, targets)
        shown = twin.medians(twin.identified(twin.draw(made, noise, 400, SEED + 1), hold="d_3"))
        table.append({"noise": name} | noise._asdict() | shown)
        chosen = noise if len(kinds) > 1 else chosen
    printed = wanted["Deltam of Data2 and Data3"] / PUBLISHED["table3"]["Data1"]
    ratios = {line["noise"]: line["Deltam of Data2 and Data3"] / line["Deltam of Data1"] for line in table}
    nearest = min(ratios, key=lambda name: abs(np.log(ratios[name] / printed)))
    rows.append(
        row(
            "Table 3: Deltam of Data2 and Data3 over that of Data1",
            f"{printed:.2f}",
            toolkit="; ".join(f"{name} {ratio:.2f}" for name, ratio in ratios.items()),
            verdict=(
                f"nearest: {nearest}; seating alone gives the least ({min(ratios.values()):.2f}), since angle errors "
                "grow with the distance from the joints and the twins' Data2 and Data3 are farther out. "
                f"The twins have {chosen.encoder_arcsec:.1g} arcsec, {1e3 * chosen.seating_mm:.1g} um and "
                f"{chosen.eccentricity_arcsec:.1g} arcsec, fitted to all three printed Deltam and to DE; {minima} of "
                f"{len(KINDS)} fits are minima: 10 % more or less of any kind is worse"
            ),
            tolerance=FITTED,
        )
    )
    return chosen, table


def compared(rows: list[Row], result: twin.Outcome, own: twin.Outcome) -> None:
    """Every printed metric of sections 4.1 to 4.4 among the twins: with all lengths free, and with a scale anchor."""
    experiment, table3, check = PUBLISHED["experiment"], PUBLISHED["table3"], PUBLISHED["verification"]

    def line(what: str, printed: float, of, note: str = "predicted; ", recomputed: str = "-") -> None:
        mine, theirs = of(own), of(result)
        rows.append(
            row(
                what,
                printed,
                recomputed=recomputed,
                method=f"all lengths free: median {number(np.median(theirs))}",
                toolkit=f"median {number(np.median(mine))}",
                verdict=note + position_in(printed, mine),
                tolerance=FITTED,
            )
        )

    nominal, printed_k = (
        check["nominal"],
        experiment["length_reference"]["mean"] / experiment["length_reference"]["nominal"],
    )
    largest = max(check["maximum"] - nominal, nominal - check["minimum"])
    mean = np.mean([table3[name] for name in twin.SOCKETS])
    fitted, held_out = "fitted, with the others of Table 3; ", np.mean([table3["Data2"], table3["Data3"]])
    # Before the scale fix all tips, and so both metrics, are k times as large.
    line("4.1 DE of Data1 [mm]", experiment["de"], lambda o: o.de[:, 0] * o.k, fitted)
    line("4.1 Deltam of Data1 [mm]", experiment["deltam"], lambda o: o.deltam[:, 0] * o.k, fitted)
    line(
        "Table 3 Data1 [mm]",
        table3["Data1"],
        lambda o: o.deltam[:, 0],
        fitted,
        f"{experiment['deltam'] / printed_k:.4f} (4.1 over k)",
    )
    line("Table 3 Data2 [mm]", table3["Data2"], lambda o: o.deltam[:, 1], fitted)
    line("Table 3 Data3 [mm]", table3["Data3"], lambda o: o.deltam[:, 2], fitted)
    note = f"includes Data1, from which the arm was identified: {held_out:.4f} without it; {fitted}"
    line("Table 3 mean [mm]", table3["mean"], lambda o: o.deltam.mean(axis=1), note, f"{mean:.4f}")
    note = f"matched by averaging {twin.READINGS} readings at each end; "
    line(
        "4.2 range of four lengths [mm]",
        experiment["length_reference"]["range"],
        lambda o: np.ptp(o.reference, axis=1),
        note,
    )
    line("4.4 largest length [mm]", check["maximum"], lambda o: o.plate.max(axis=1) + twin.PLATE)
    line("4.4 smallest length [mm]", check["minimum"], lambda o: o.plate.min(axis=1) + twin.PLATE)
    line(
        "4.4 largest deviation [mm]",
        check["max_deviation"],
        lambda o: np.abs(o.plate).max(axis=1),
        recomputed=f"{largest:.4f}",
    )
    line(
        "4.4 range [mm]",
        check["range"],
        lambda o: np.ptp(o.plate, axis=1),
        recomputed=f"{check['maximum'] - check['minimum']:.3f}",
    )
    line("4.4 two RMS [mm]", check["two_rms"], lambda o: 2 * np.sqrt((o.plate**2).mean(axis=1)))
    shape = 2 * check["range"] / check["two_rms"]
    line(
        "4.4 range over RMS, the shape of the 30 errors",
        round(shape, 2),
        lambda o: np.ptp(o.plate, axis=1) / np.sqrt((o.plate**2).mean(axis=1)),
    )
    printed, before = check["improvement_percent"], experiment["length_reference"]["max_error"]
    rows.append(
        row(
            "4.4 improvement [%]",
            printed,
            recomputed=f"{100 * (1 - check['max_deviation'] / before):.1f}; "
            f"for equal lengths {100 * (1 - check['max_deviation'] / twin.PLATE / before * twin.REFERENCE):.1f}",
            method=f"all lengths free: median {np.median(improvement(result)):.1f}",
            toolkit=f"median {np.median(improvement(own)):.1f}",
            verdict="a measure of k, not of the method: it compares an error of 201.5 mm with errors of 300 mm, "
            "and the former is as large as the error of k that the search leaves. "
            f"With the printed {before} mm as the former, {printed} is "
            + position_in(printed, 100 * (1 - np.abs(own.plate).max(axis=1) / before)),
            tolerance=FITTED,
        )
    )


def improvement(result: twin.Outcome) -> np.ndarray:
    """As the paper defines it: largest error of the reference before against that of the plate after, per cent."""
    before = np.abs(result.reference - twin.REFERENCE).max(axis=1)
    return 100 * (1 - np.abs(result.plate).max(axis=1) / before)


def scale_of_experiment(
    rows: list[Row], twins: twin.Twins, free: twin.Outcome, own: twin.Outcome, search: bool
) -> list[dict[str, float]]:
    """k of the experiment against k of identifications with noise and every length free.

    The paper's method is run on all its twins only with ``search``; otherwise their k are those stored.
    """
    reference = PUBLISHED["experiment"]["length_reference"]
    printed = reference["mean"] / reference["nominal"]
    lower, upper = box("experiment")
    starts = random_starts(lower, upper, METHODS, SEED)
    problems = [(q, lower, upper, start) for q, start in zip(twins.sockets[:METHODS, 0], starts, strict=True)]
    width = upper - lower

    def edge(values: np.ndarray) -> np.ndarray:
        return np.any((values - lower < 1e-6 * width) | (upper - values < 1e-6 * width), axis=-1)

    again = np.array([paper_method.one_in_box(problem) for problem in problems[:AGAIN]])
    if search:
        found = paper_method.many_in_boxes(problems)
        ks = twin.lengths_of(found, twins.reference[:METHODS]).mean(axis=1) / twin.REFERENCE
        runs = [{"twin": float(i), "k": float(ks[i]), "on_a_bound": float(edge(found)[i])} for i in range(METHODS)]
    else:
        runs = read_table(HERE / "results" / "paper_method_twins.csv")
    k, on_a_bound = (np.array([run[key] for run in runs]) for key in ("k", "on_a_bound"))
    # The noise, not the search, determines DE: every search, wherever it ends, comes as close as squared distances do.
    de = [twin.metrics_of(twin.tips_of(again[i : i + 1], problems[i][0][None]))[0][0] for i in range(AGAIN)]
    close = sum(abs(de[i] / (free.de[i, 0] * free.k[i]) - 1) < 0.05 for i in range(AGAIN))
    inside = "inside its box" if not edge(vector("experiment", "identified")) else "on a bound of its box"
    rows.append(
        row(
            "4.2 k of the identified arm",
            f"{printed:.5f}",
            method=f"interior point from random starts, {METHODS} twins: {k.min():.4f} to {k.max():.4f}, "
            f"{100 * np.mean(on_a_bound):.0f} % on a bound; {close} of {AGAIN} run again come within 5 % of the DE of "
            "squared distances",
            toolkit=f"all free, squared distances: median {np.median(free.k):.4f}, "
            f"{100 * np.mean(free.on_a_bound):.0f} % on a bound; "
            f"scale anchor d_3 at its nominal value: {np.median(own.k):.5f}, standard deviation {np.std(own.k):.1e}",
            verdict=f"eq. 18 lies {inside}; its k is {position_in(printed, k)} (interior point, whose end "
            f"depends on its start and on its limit of {paper_method.ITERATIONS} iterations)",
            tolerance=STORED,
        )
    )
    return runs


def stages(rows: list[Row], twins: twin.Twins, free: twin.Outcome, own: twin.Outcome) -> list[dict[str, float]]:
    """Improvement on the plate by two stages over one, and by the joint solve over two."""
    together = twin.joint(twins)
    joint = twin.lengths_of(together, twins.plate) - twin.PLATE
    noise_free = {"one stage, all free": free.plate_before, "one stage, scale anchor d_3": own.plate_before}
    two_stages = {"two stages, all free": free.plate, "two stages, scale anchor d_3": own.plate}
    errors = noise_free | two_stages | {"joint": joint}
    rms = {name: np.sqrt((error**2).mean(axis=1)) for name, error in errors.items()}
    middle = {name: float(np.median(values)) for name, values in rms.items()}
    all_free, anchored = middle["one stage, all free"], middle["one stage, scale anchor d_3"]
    two = middle["two stages, scale anchor d_3"]
    reference = PUBLISHED["experiment"]["length_reference"]
    at_printed = twin.PLATE * (1 - reference["mean"] / reference["nominal"])
    rows.append(
        row(
            "Two stages over one, joint over two: RMS on the plate [mm]",
            "-",
            method=f"all lengths free: one stage {all_free:.3f}, two {middle['two stages, all free']:.4f}",
            toolkit=f"scale anchor d_3: one stage {anchored:.3f}, two {two:.4f}, joint {middle['joint']:.4f}",
            verdict=(
                f"the scale fix reduces the RMS as much as k was wrong: {all_free / two:.0f} times where k ended "
                f"on a bound, {anchored / two:.0f} times with scale anchor d_3 at its nominal value, "
                f"{at_printed / two:.0f} times at the printed k. With one length in one position the joint solve "
                f"changes the median by {100 * (middle['joint'] / two - 1):+.1f} %"
            ),
            tolerance=FITTED,
        )
    )
    return [{"twin": float(i)} | {name: float(values[i]) for name, values in rms.items()} for i in range(len(joint))]


def run(search: bool = False) -> tuple[list[Row], dict[str, list[dict]]]:
    rows: list[Row] = []
    made = twin.pool()
    noise, models = noise_models(made, rows, search)
    twins = twin.draw(made, noise, TWINS, SEED)
    free, own = (twin.identified(twins, hold) for hold in (None, "d_3"))
    compared(rows, free, own)
    runs = scale_of_experiment(rows, twins, free, own, search)
    by_stage = stages(rows, twins, free, own)
    figures = [
        {
            "twin": float(i),
            "k_free": float(free.k[i]),
            "k_held": float(own.k[i]),
            **{f"deltam_{name}_mm": float(own.deltam[i, j]) for j, name in enumerate(twin.SOCKETS)},
            "de_Data1_mm": float(own.de[i, 0]),
            "plate_largest_mm": float(np.abs(own.plate[i]).max()),
            "plate_range_mm": float(np.ptp(own.plate[i])),
            "plate_two_rms_mm": float(2 * np.sqrt((own.plate[i] ** 2).mean())),
        }
        for i in range(TWINS)
    ]
    # The twin whose largest deviation is the median, measurement by measurement, as in the paper's figures 6 and 8.
    typical = int(np.argsort([line["plate_largest_mm"] for line in figures])[TWINS // 2])
    plate = [{"placement": float(i + 1), "deviation_mm": float(x)} for i, x in enumerate(own.plate[typical])]
    stage1 = np.where(twin.is_length(), own.parameters[typical] * own.k[typical], own.parameters[typical])
    tips = twin.tips_of(stage1[None], twins.sockets[typical, :1])[0]
    centred = [dict(zip(("x_mm", "y_mm", "z_mm"), map(float, tip - tips.mean(axis=0)), strict=True)) for tip in tips]
    return rows, {
        "noise_models": models,
        "paper_method_twins": runs,
        "twins": figures,
        "stages": by_stage,
        "figure8": plate,
        "figure6": centred,
    }


if __name__ == "__main__":
    for line in run()[0]:
        print(line)
