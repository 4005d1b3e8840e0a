"""Table 3, figure 8 and the 93 %: where the printed figures lie among a thousand twins of the experiment."""

import numpy as np
import paper_method
import twin
from paper import PUBLISHED, Row, box, number, place, row

TWINS = 1_000
SEED = 6
METHODS = 4  # twins that the paper's method is also run on
KINDS = {"encoder noise alone": (0,), "seating alone": (1,), "eccentricity alone": (2,), "all three": (0, 1, 2)}


def noise_models(made: twin.Pool, rows: list[Row]) -> tuple[twin.Noise, list[dict[str, float | str]]]:
    """Which noise explains the printed figures: each kind alone, made to match DE of Data1; and all three, made to match what they can."""
    wanted, table, chosen = twin.printed_targets(), [], twin.Noise(0.0, 0.0, 0.0)
    for name, kinds in KINDS.items():
        noise = twin.fitted_noise(made, kinds=kinds, targets=1 if len(kinds) == 1 else 3)
        shown = twin.medians(twin.identified(twin.draw(made, noise, 400, SEED + 1), hold="d_3"))
        table.append({"noise": name} | noise._asdict() | shown)
        chosen = noise if len(kinds) > 1 else chosen
    held_out = {str(line["noise"]): float(line["Deltam of Data2 and Data3"]) for line in table}  # type: ignore[arg-type]
    rows.append(
        row(
            "Table 3: why Data2 and Data3 are worse than Data1",
            f"{wanted['Deltam of Data2 and Data3']:.3f} against {wanted['Deltam of Data1']:.4f}",
            toolkit="; ".join(f"{name} {value:.3f}" for name, value in held_out.items()),
            verdict=(
                "angle errors do it: they are fitted in the place of Data1 and seen elsewhere at another distance; seating alone does not. "
                f"The twins have {chosen.encoder_arcsec:g} arcsec, {1e3 * chosen.seating_mm:g} um, {chosen.eccentricity_arcsec:g} arcsec"
            ),
        )
    )
    return chosen, table


def compared(rows: list[Row], result: twin.Outcome, own: twin.Outcome) -> None:
    """Every printed figure of sections 4.1 to 4.4 among the twins: as the paper identifies (all free), and with one length held."""
    experiment, table3, check = PUBLISHED["experiment"], PUBLISHED["table3"], PUBLISHED["verification"]

    def line(what: str, printed: float, of, note: str = "") -> None:
        mine, theirs = of(own), of(result)
        rows.append(
            row(
                what,
                printed,
                method=f"median {number(np.median(theirs))}",
                toolkit=f"median {number(np.median(mine))}",
                verdict=note + place(printed, mine),
            )
        )

    line("4.1 DE of Data1 [mm]", experiment["de"], lambda o: o.de[:, 0], "matched by choice of noise; ")
    line("4.1 Deltam of Data1 [mm]", experiment["deltam"], lambda o: o.deltam[:, 0], "matched by choice of noise; ")
    line("Table 3 Data1 [mm]", table3["Data1"], lambda o: o.deltam[:, 0], "Deltam of 4.1 divided by k; ")
    line("Table 3 Data2 [mm]", table3["Data2"], lambda o: o.deltam[:, 1])
    line("Table 3 Data3 [mm]", table3["Data3"], lambda o: o.deltam[:, 2])
    line(
        "Table 3 mean [mm]",
        table3["mean"],
        lambda o: o.deltam.mean(axis=1),
        "averages in the training set: held out alone it prints 0.0300; ",
    )
    line("4.2 range of four lengths [mm]", experiment["length_reference"]["range"], lambda o: np.ptp(o.reference, axis=1))
    line("4.4 largest length [mm]", check["maximum"], lambda o: o.plate.max(axis=1) + twin.PLATE)
    line("4.4 smallest length [mm]", check["minimum"], lambda o: o.plate.min(axis=1) + twin.PLATE)
    line("4.4 largest deviation [mm]", check["max_deviation"], lambda o: np.abs(o.plate).max(axis=1))
    line("4.4 range [mm]", check["range"], lambda o: np.ptp(o.plate, axis=1))
    line("4.4 two RMS [mm]", check["two_rms"], lambda o: 2 * np.sqrt((o.plate**2).mean(axis=1)))
    printed, before = check["improvement_percent"], experiment["length_reference"]["max_error"]
    rows.append(
        row(
            "4.4 improvement [%]",
            printed,
            recomputed=f"{100 * (1 - check['max_deviation'] / before):.1f}; length for length {100 * (1 - check['max_deviation'] / twin.PLATE / before * twin.REFERENCE):.1f}",
            method=f"median {np.median(improvement(result)):.1f}",
            toolkit=f"median {np.median(improvement(own)):.1f}",
            verdict="a figure of k, not of the method: it compares an error of 201.5 mm with errors of 300 mm, and the one before is as large as the search left k. "
            f"With the printed {before} mm before, {printed} is "
            + place(printed, 100 * (1 - np.abs(own.plate).max(axis=1) / before)),
        )
    )


def improvement(result: twin.Outcome) -> np.ndarray:
    """As the paper counts it: largest error of the reference length before, against that of the plate after; per cent."""
    before = np.abs(result.reference - twin.REFERENCE).max(axis=1)
    return 100 * (1 - np.abs(result.plate).max(axis=1) / before)


def scale_slides(rows: list[Row], twins: twin.Twins, free: twin.Outcome, own: twin.Outcome) -> None:
    """k of the experiment against what free lengths give with noise."""
    reference = PUBLISHED["experiment"]["length_reference"]
    printed = reference["mean"] / reference["nominal"]
    lower, upper = box("experiment")
    ks = []
    for q, measured in zip(twins.sockets[:METHODS, 0], twins.reference[:METHODS], strict=True):
        values, _ = paper_method.minimise(q, lower, upper, (lower + upper) / 2)
        ks.append(float(twin.lengths_of(values[None], measured[None]).mean() / twin.REFERENCE))
    rows.append(
        row(
            "4.2 k, and no parameter on a bound",
            f"{printed:.5f}",
            method=f"interior point, {METHODS} twins: {min(ks):.4f} to {max(ks):.4f}; least DE with all free: median {np.median(free.k):.4f}",
            toolkit=f"one length held: median {np.median(own.k):.5f}",
            verdict=(
                f"not a minimum of DE: with every length free {100 * np.mean(free.on_a_bound):.0f} % of the twins shrink until a bound stops them. "
                "The printed k is where the search stopped"
            ),
        )
    )


def stages(rows: list[Row], twins: twin.Twins, free: twin.Outcome, own: twin.Outcome) -> list[dict[str, float]]:
    """What two stages gain over one, and the joint solve over two, on the plate."""
    together = twin.joint(twins)
    joint = twin.lengths_of(together, twins.plate) - twin.PLATE
    noise_free = {"one stage, all free": free.plate_before, "one stage, d_3 held": own.plate_before}
    errors = noise_free | {"two stages, all free": free.plate, "two stages, d_3 held": own.plate, "joint": joint}
    rms = {name: np.sqrt((error**2).mean(axis=1)) for name, error in errors.items()}
    middle = {name: float(np.median(values)) for name, values in rms.items()}
    better = float(np.mean(rms["joint"] < rms["two stages, d_3 held"]))
    rows.append(
        row(
            "Two stages over one, joint over two: RMS on the plate [mm]",
            "-",
            method=f"one stage {middle['one stage, all free']:.3f}, two {middle['two stages, all free']:.4f}",
            toolkit=f"two stages {middle['two stages, d_3 held']:.4f}, joint {middle['joint']:.4f}",
            verdict=f"the scale fix gains a factor {middle['one stage, all free'] / middle['two stages, all free']:.0f}; the joint solve beats two stages in {100 * better:.0f} % of the twins, by {100 * (1 - middle['joint'] / middle['two stages, d_3 held']):.1f} % in the median",
        )
    )
    return [{"twin": float(i)} | {name: float(values[i]) for name, values in rms.items()} for i in range(len(joint))]


def run() -> tuple[list[Row], dict[str, list[dict]]]:
    rows: list[Row] = []
    made = twin.pool()
    noise, models = noise_models(made, rows)
    twins = twin.draw(made, noise, TWINS, SEED)
    free, own = (twin.identified(twins, hold) for hold in (None, "d_3"))
    compared(rows, free, own)
    scale_slides(rows, twins, free, own)
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
    # The twin whose largest deviation is the median, shown measurement by measurement as the paper's figures 6 and 8 are.
    typical = int(np.argsort([line["plate_largest_mm"] for line in figures])[TWINS // 2])
    plate = [{"placement": float(i + 1), "deviation_mm": float(x)} for i, x in enumerate(own.plate[typical])]
    stage1 = np.where(twin.is_length(), own.parameters[typical] * own.k[typical], own.parameters[typical])
    tips = twin.tips_of(stage1[None], twins.sockets[typical, :1])[0]
    centred = [dict(zip(("x_mm", "y_mm", "z_mm"), map(float, tip - tips.mean(axis=0)), strict=True)) for tip in tips]
    return rows, {"noise_models": models, "twins": figures, "stages": by_stage, "figure8": plate, "figure6": centred}


if __name__ == "__main__":
    for line in run()[0]:
        print(line)
