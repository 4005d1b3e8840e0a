"""The command ``calibrate``."""

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from ..core.errors import IdentifiabilityWarning, InputError
from ..core.text import number
from ..core.units import DEG
from ..core.x64 import LARGEST_INTEGER
from ..files.outputs import reading, together
from ..model.loss_names import LossName
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
    names_option,
    show_summary,
    with_spinner,
)


@app.command(
    epilog=examples(
        "aacmm calibrate capture.h5 -o calibration.h5",
        "aacmm calibrate capture.h5 -o calibration.h5 --without 'test*' --method joint",
        "aacmm calibrate monday.h5 tuesday.h5 -o calibration.h5 --robust tukey",
        "aacmm calibrate capture.h5 -o calibration.h5 --prior length=0.5mm,angle=0.05deg",
    )
)
def calibrate(
    capture: Annotated[
        list[Path],
        typer.Argument(metavar="CAPTURE.h5 ...", help="Capture, or captures of one arm in several sessions."),
    ],
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE.h5",
            help="Calibration to write (HDF5)." + KEPT,
        ),
    ],
    method: Annotated[
        Literal["two-stage", "joint"] | None,
        typer.Option(
            help="two-stage: repeatability, then the scale by the reference lengths; joint: one least squares of all. "
            "Default: two-stage, but joint with observations besides sockets, a robust loss or a prior."
        ),
    ] = None,
    robust: Annotated[
        LossName | None,
        typer.Option(
            help="Robust loss, which takes weight from bad poses and lists them; encoders that are noisier than others "
            "are not looked for then."
        ),
    ] = None,
    model: Annotated[
        str | None,
        typer.Option(
            metavar="KINDS",
            help="What joints do besides their readings: dh,gravity,harmonics=1+2,gear,coupled=2-3. Default: the arm "
            "file's; dh alone for nothing.",
        ),
    ] = None,
    prior: Annotated[
        str | None,
        typer.Option(
            metavar="GROUP=SD,...",
            help="Standard deviations of parameters about their nominal values: 'length=0.5mm,angle=0.05deg', "
            "'d_3=750.2+-0.1mm', 'alpha=learn' from the data; 'learn' for all, 'none'. Default: the arm file's.",
        ),
    ] = None,
    scale: Annotated[
        Literal["measured", "nominal"],
        typer.Option(
            help="nominal: stage 1 alone, with the scale of the nominal arm, where nothing in the capture fixes it."
        ),
    ] = "measured",
    same_probe: Annotated[
        bool,
        typer.Option("--same-probe", help="Of several sessions: the probe was not remounted between them."),
    ] = False,
    only_poses: Annotated[
        int | None,
        typer.Option(
            min=1, metavar="N", help="Calibrate with N poses drawn at random, and test the result on the others."
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, max=LARGEST_INTEGER, metavar="N", help="Seed of --only-poses.")] = 0,
    hold: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="Length that anchors the scale in stage 1: a parameter, 'longest', or 'none' as in the paper.",
        ),
    ] = "longest",
    only: Only = None,
    without: Without = None,
    held: Annotated[
        str | None,
        typer.Option(
            metavar="NAMES", help="Parameters that are fixed, separated by commas; replaces the list in the arm's file."
        ),
    ] = None,
    free: Annotated[
        str | None,
        typer.Option(
            metavar="NAMES", help="Further parameters to identify, separated by commas (beta_2: Hayati's angle)."
        ),
    ] = None,
    length_bound_mm: Annotated[
        float | None, typer.Option(min=0, metavar="MM", help="Half-width of the bounds of length parameters.")
    ] = None,
    angle_bound_deg: Annotated[
        float | None, typer.Option(min=0, metavar="DEG", help="Half-width of the bounds of angle parameters.")
    ] = None,
    bound: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=WIDTH", help="Half-width of the bounds of one parameter, in mm or deg; repeatable."),
    ] = None,
    encoder_arcsec: KnownEncoderNoise = None,
    linear_encoder_mm: LinearEncoderNoise = None,
    seating_mm: KnownSeatingNoise = None,
    keep_noise: Annotated[
        bool,
        typer.Option("--keep-noise", help="Keep the noise as it is where an encoder proves noisier."),
    ] = False,
    shared_errors: Annotated[
        bool,
        typer.Option(help="Look for errors that poses share, and add what they do to the uncertainties."),
    ] = True,
    cross_validate: Annotated[
        bool | None,
        typer.Option(
            help="Calibrate once without each placement, station or other group of what was observed, or each region "
            "of joint space where all is one group, and test the result there. "
            "Default: yes, for a recorded capture with several placements of the reference length, where neither "
            "--model, --prior nor --robust is given."
        ),
    ] = None,
    leave_out: Annotated[
        list[str] | None,
        typer.Option(
            metavar="PATTERN",
            help="With --cross-validate: leave out all that has such a name together ('monday/*' with its session); "
            "repeatable.",
        ),
    ] = None,
    monte_carlo: Annotated[
        bool,
        typer.Option("--monte-carlo", help="Check the uncertainties by Monte Carlo (JCGM 101); takes a minute or two."),
    ] = False,
    strict: Annotated[
        bool,
        typer.Option("--strict", help="Refuse free parameters that such data could not determine even without noise."),
    ] = False,
    remove_contradicting: Annotated[
        bool,
        typer.Option(
            "--remove-contradicting",
            help="Leave out a socket, placement or station that contradicts all others, and say what that changed.",
        ),
    ] = False,
    figure: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Plot the residual of every pose: PNG, SVG or PDF by the name.")
    ] = None,
    max_steps: Annotated[
        int, typer.Option(min=1, max=1_000_000, metavar="N", help="Largest number of steps of each solve.")
    ] = 300,
    as_json: Json = False,
) -> None:
    """Identify the parameters of an arm from captures.

    Stage 1 makes the tips of each socket coincide; the reference lengths then fix the scale. Observations of other
    kinds (measured points, spheres, planes, artefacts) are solved with all else at once. Several captures are sessions
    of one arm.
    """
    from ..calibration.record import record_of
    from ..files.calibrations import save_calibration
    from ..summaries.calibration import calibration_summary
    from . import calibration_display

    with together(output, figure):
        for file in capture:
            reading(file)
        if figure is not None:
            from ..plot.figures import check_format

            check_format(figure)
        recording = _joined(capture, same_probe)
        recording = recording._replace(capture=recording.capture.select(only or None, without or ()))
        if leave_out and not cross_validate:
            raise InputError("--leave-out says what --cross-validate leaves out; give both.")
        others = None
        if only_poses is not None:
            from ..data.capture import draw_poses

            part, others = draw_poses(recording.capture, only_poses, seed)
            recording = recording._replace(capture=part)
        if model is not None:
            from ..files.joint_models import with_model

            recording = recording._replace(nominal=with_model(recording.nominal, model))
        bounds = _bounds(recording.nominal, held, free, length_bound_mm, angle_bound_deg, bound or [])
        recording = recording._replace(nominal=recording.nominal._replace(arm=bounds.space.base))
        solving = {
            "hold": None if hold == "none" else hold,
            "noise": known_noise(encoder_arcsec, seating_mm, linear_encoder_mm),
            "prior": _prior(recording.nominal, prior, model),
            "replace_noise": not keep_noise,
        }
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", IdentifiabilityWarning)  # the summary says it

            def solved(part: Any) -> Any:
                options = solving | {"robust": robust, "max_steps": max_steps}
                return _solved(bounds, part, scale, method, options, strict, shared_errors)

            result = with_spinner("Calibrating", lambda: solved(recording.capture))
            record = record_of(result, recording, robust=robust, others=others)
            if remove_contradicting:
                from ..diagnostics.contradictions import remove_contradicting as removed

                record = with_spinner("Comparing groups", lambda: removed(record, solved))
                result = solved(record.recording.capture) if record.removed and monte_carlo else result
            recording, capture_used = record.recording, record.recording.capture
            plain = robust is None and solving["prior"] is None
            alike = scale == "measured" and plain and not capture_used.observations
            if cross_validate or (
                cross_validate is None
                and alike
                and recording.true is None
                and _several(capture_used, len(bounds.space.names))
            ):
                from ..pipeline.cross_validation import cross_validate as validated

                if scale != "measured":
                    raise InputError("--cross-validate needs a calibrated scale; leave out --scale nominal.")
                found = with_spinner("Cross-validating", lambda: validated(
                    bounds.space.base, capture_used, bounds, method=method, robust=robust, groups=leave_out,
                    shared_errors=shared_errors, **solving,
                ))  # fmt: skip
                record = record._replace(validation=found)
        if monte_carlo:
            from ..calibration.results import Calibration
            from ..calibration.sampling import monte_carlo as sample

            if not isinstance(result, Calibration) or robust is not None:
                raise InputError("--monte-carlo is for calibrations without --robust and --scale nominal.")
            sampled = with_spinner("Drawing trials", lambda: sample(result, capture_used))
            record = record._replace(sampled=sampled.table(), sampled_says=" ".join(sampled.sentences()))
        summary = calibration_summary(record)
        save_calibration(output, record, summary)
        if figure is not None:
            from ..plot import save_calibration_figure

            save_calibration_figure(record, figure)
    show_summary(summary | {"written": str(output)}, as_json, calibration_display.calibration)
    if _failed(record):
        raise typer.Exit(1)


def _failed(record: Any) -> bool:
    """Whether the result is not one to use."""
    from ..diagnostics.usability import does_not_fit

    return not record.converged or not record.plausible_scale or record.implausible_residual or does_not_fit(record)


def _joined(files: Sequence[Path], same_probe: bool) -> Any:
    """The recording of a file, or of several as the sessions of one arm, with the digests of the files."""
    from ..data.joined_captures import join_sessions
    from ..files.captures import load_capture
    from ..files.inputs import InputFile, fingerprint

    found = {}
    for file in files:
        recording = load_capture(read := InputFile(file))
        if file.stem in found:
            raise InputError(f"two captures have the name '{file.stem}', which names their session; rename one.")
        found[file.stem] = recording._replace(sources=(fingerprint(read), *recording.sources))
    first, *rest = found.values()
    if not rest:
        if same_probe:
            raise InputError("--same-probe is for several captures; name them, or leave it out.")
        return first
    for file, recording in zip(files[1:], rest, strict=True):
        if not same_arm(recording.nominal.arm, first.nominal.arm):
            raise InputError(f"{file} has another nominal arm than {files[0]}; import both with the same arm file.")
    capture = join_sessions({name: one.capture for name, one in found.items()}, own_probe=not same_probe)
    sources = tuple(source for recording in found.values() for source in recording.sources)
    return first._replace(capture=capture, true=None, seed=None, spheres=(), sources=sources)


def same_arm(one: Any, other: Any) -> bool:
    """Whether two arms are the same to the bit."""
    import jax
    import numpy as np

    leaves = [jax.tree.leaves(arm) for arm in (one, other)]
    return jax.tree.structure(one) == jax.tree.structure(other) and all(map(np.array_equal, *leaves))


def _solved(
    bounds: Any, capture: Any, scale: str, method: Any, solving: dict[str, Any], strict: bool, shared_errors: bool
) -> Any:
    """Both stages, or stage 1 alone."""
    from ..pipeline.single import calibrate as run
    from ..pipeline.single import identify

    if scale == "measured":
        # The summary has its own look at what is determined.
        undetermined = "raise" if strict else "ignore"
        options: dict[str, Any] = {"shared_errors": shared_errors, "undetermined": undetermined}
        options |= solving
        return run(bounds.space.base, capture, bounds, method=method, **options)
    if method is not None or strict:
        raise InputError("--scale nominal is stage 1 alone; leave out --method and --strict.")
    if any(observation.fixes_scale for observation in capture.observations):
        raise InputError(
            "--scale nominal is for captures without a scale, but these observations fix it; leave it out."
        )
    return identify(bounds.space.base, capture, bounds, **solving)


def _bounds(
    nominal: Any,
    held: str | None,
    free: str | None,
    length_mm: float | None,
    angle_deg: float | None,
    single: Sequence[str],
) -> Any:
    """The bounds that the arm's file proposes, changed by what the command line says."""
    from ..kinematics.arm import is_length
    from ..kinematics.parameters import Bounds, Parameters

    names = names_option(held) if held is not None else nominal.held
    proposed = [name for name in nominal.free if name not in (names or ())]
    space = Parameters.free_of(
        nominal.arm, held=names, free=tuple(dict.fromkeys([*proposed, *names_option(free or "")]))
    )
    override = {name: width for name, width in nominal.override.items() if name in space.names}
    seen = set()
    for text in single:
        name, _, width = text.partition("=")
        if name in seen:
            raise InputError(f"--bound gives {name} two half-widths; give it one.")
        seen.add(name)
        try:
            value = number(width.strip())
        except ValueError as error:
            raise InputError(f"--bound '{text}' is not of the form NAME=WIDTH, in mm or deg.") from error
        override[name] = value if is_length(name) else value * DEG
    return Bounds.around(
        space.base,
        space,
        length=nominal.length if length_mm is None else length_mm,
        angle=nominal.angle if angle_deg is None else angle_deg * DEG,
        override=override,
    )


def _prior(nominal: Any, text: str | None, model: str | None) -> Any:
    """The prior that the command line states; else that of the arm's file, or the default one of a model of joints."""
    if text is None and nominal.prior is None and model is not None and nominal.arm.corrections is not None:
        from ..kinematics.prior_scales import default_prior

        return default_prior(nominal.arm)
    if text is None:
        return nominal.prior
    from ..files.priors import prior_of_text

    return prior_of_text(text, nominal.arm)


def known_noise(encoder_arcsec: float | None, seating_mm: float | None, linear_encoder_mm: float | None) -> Any:
    """The noise that is known: encoders and seat, or None."""
    from ..data.noise import Noise

    if encoder_arcsec is None and seating_mm is None and linear_encoder_mm is None:
        return None
    if encoder_arcsec is None or seating_mm is None:
        missing = "--seating-mm" if seating_mm is None else "--encoder-arcsec"
        raise InputError(f"{missing} is missing: give both standard deviations, or neither to have both estimated.")
    return Noise(encoder_arcsec=encoder_arcsec, seating=seating_mm, linear_encoder=linear_encoder_mm)


def _several(capture: Any, parameters: int) -> bool:
    """Whether the reference length was measured in several placements, so that each can be left out."""
    if len(capture.lengths) < 2:
        return False
    from ..pipeline.cross_validation import can_cross_validate

    return can_cross_validate(capture, parameters)
