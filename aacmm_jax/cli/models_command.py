"""The command ``compare-models``."""

import warnings
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape

from ..core.errors import IdentifiabilityWarning, InputError
from ..core.x64 import LARGEST_INTEGER
from ..files.outputs import reading, together
from ..summaries.tables import difference_from_best
from .app import (
    KEPT,
    Json,
    KnownEncoderNoise,
    KnownSeatingNoise,
    LinearEncoderNoise,
    Only,
    Without,
    app,
    examples,
    show_summary,
    with_spinner,
)
from .calibration_commands import known_noise
from .display import formatted, new_console, new_table, print_table, print_warnings, print_written


@app.command(
    "compare-models",
    epilog=examples(
        "aacmm compare-models capture.h5",
        'aacmm compare-models capture.h5 --models "dh;gravity;gravity,harmonics=1" --leave-out "monday/*" '
        '--leave-out "tuesday/*"',
    ),
)
def compare_models(
    capture: Annotated[Path, typer.Argument(metavar="CAPTURE.h5", help="Capture, written by import or simulate.")],
    models: Annotated[
        str | None,
        typer.Option(
            metavar="MODELS",
            help="Models from simple to rich, separated by semicolons, as for calibrate --model. Default: dh; gravity; "
            "harmonics=1; gravity,harmonics=1; functions (harmonics=1-31); gravity,functions; of a capture with "
            "temperatures each of these also with expansion.",
        ),
    ] = None,
    leave_out: Annotated[
        list[str] | None,
        typer.Option(
            metavar="PATTERN",
            help="Leave out all that has such a name together ('monday/*'); repeatable. Default: each placement, "
            "station or other group where there are at least three, else either half of each joint's travel.",
        ),
    ] = None,
    only_poses: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="Use N poses drawn at random, to save time.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, max=LARGEST_INTEGER, metavar="N", help="Seed of --only-poses.")] = 0,
    only: Only = None,
    without: Without = None,
    encoder_arcsec: KnownEncoderNoise = None,
    linear_encoder_mm: LinearEncoderNoise = None,
    seating_mm: KnownSeatingNoise = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE.h5",
            help="Keep the comparison, for show and report." + KEPT,
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Compare models of the joints by unseen regions.

    Each model is calibrated with all poses, its prior learned from them, and predicts every region from the others.
    """
    from ..data.capture import draw_poses
    from ..files.captures import load_capture
    from ..files.compared_models import save_compared_models
    from ..files.inputs import InputFile, fingerprint
    from ..files.joint_models import masses_of
    from ..pipeline.model_ladder import compare_models as compared
    from ..summaries.compared_models import compared_models_summary

    with together(output):
        reading(capture)
        recording = load_capture(read := InputFile(capture))
    chosen = None if models is None else tuple(model.strip() for model in models.split(";"))
    if chosen is not None and not all(chosen):
        raise InputError(f"--models '{models}' names an empty model; separate models by one semicolon each.")
    part, nominal = recording.capture.select(only or None, without or ()), recording.nominal
    if only_poses is not None:
        part = draw_poses(part, only_poses, seed)[0]
    noise = known_noise(encoder_arcsec, seating_mm, linear_encoder_mm)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", IdentifiabilityWarning)
        found = with_spinner("Comparing models", lambda: compared(
            nominal.arm, part, nominal.bounds(), models=chosen, regions=leave_out, noise=noise, **masses_of(nominal)
        ))  # fmt: skip
    summary = compared_models_summary(found, nominal.name) | {"poses": len(part.owner) + _observed(part)}
    if output is not None:
        save_compared_models(output, summary, [fingerprint(read)], None if only_poses is None else seed)
        summary["written"] = str(output)
    show_summary(summary, as_json, display)
    if not found.recommended.result.converged:
        raise typer.Exit(1)


def _observed(capture: Any) -> int:
    return sum(observation.q.shape[0] for observation in capture.observations)


def display(summary: dict[str, Any]) -> None:
    """Compared models."""
    console = new_console()
    console.print(
        f"[bold]{escape(summary['arm'])}[/bold]: {len(summary['models'])} models on {summary['poses']} poses, "
        f"{len(summary['regions'])} regions left out one by one"
    )
    print_warnings(console, summary)
    for sentence in summary["findings"]:
        console.print(escape(sentence))
    table = new_table(
        "\nRMS distance from the geometry [mm]; to best: outside, less that of the best outside, compared region by "
        "region; u: standard errors by the scatter of the regions; ratio: mean of (error / predicted standard "
        "deviation)^2 outside; evidence: its logarithm, less the largest",
        "model", "parameters", "determined", "inside", "outside", "u", "to best", "u", "ratio", "evidence", "CPU [s]",
    )  # fmt: skip
    most_probable = max(row["log_evidence"] for row in summary["models"])
    least = min(row["rms_outside"] for row in summary["models"])
    for row in summary["models"]:
        numbers = (
            *(formatted(row[key]) for key in ("rms_inside", "rms_outside", "u_outside")),
            *("-" if one is None else formatted(one) for one in difference_from_best(row, least)),
        )
        table.add_row(
            escape(row["model"]),
            str(row["parameters"]),
            f"{row['effective_parameters']:.1f}",
            *numbers,
            formatted(row["ratio"], 2),
            f"{row['log_evidence'] - most_probable:.1f}",
            f"{row['cpu_seconds']:.1f}",
        )
    print_table(console, table)
    by_region = new_table(
        "\nRMS error of each region [mm]", "region", "poses", *(r["model"] for r in summary["models"])
    )
    for i, label in enumerate(summary["regions"]):
        each = [row["regions"][i] for row in summary["models"]]
        by_region.add_row(escape(label), str(each[0]["poses"]), *(formatted(one["rms"]) for one in each))
    print_table(console, by_region)
    print_written(console, summary)
