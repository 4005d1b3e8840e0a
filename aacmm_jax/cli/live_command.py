"""The command ``live``: a capture that is guided while it is taken."""

from pathlib import Path
from typing import Any

from ..core.text import pluralise
from ..uncertainty.coverage import U_AT_LEVEL
from . import options
from .app import command
from .options import flag, option, output


@command(
    "aacmm live panda --device simulated: --kit kit.toml -o capture.h5",
    "aacmm plan arm.toml -o plan.csv --manifest plan.toml && aacmm live arm.toml --plan plan.toml "
    "--device 'serial:/dev/ttyUSB0?format=encoders.toml' -o capture.h5",
    "aacmm live ur10e --device tcp:robot:30010 --device tcp:tracker:5000 --kit kit.toml -o capture.h5 --terminal",
)
def live(
    arm: str = options.NOMINAL_ARM,
    device: list[str] = option(
        "Device to read, as KIND:WHERE?OPTION=VALUE&...; may be given several times. Kinds: serial, tcp, udp, file "
        "(that grows), bag (played back), servos, camera, simulated.",
        "DEVICE",
        default=...,
    ),
    output: Path = output(
        "Capture to write when finished (HDF5). Every pose is kept at once in FILE.h5.journal; an "
        "existing journal is continued.",
        "FILE.h5",
    ),
    plan: Path | None = option(
        "Manifest of a plan (aacmm plan --manifest), with its table FILE.csv beside it.", "FILE.toml"
    ),
    kit: Path | None = option("Kit: the artefacts and instruments at hand, as for aacmm plan --kit.", "FILE.toml"),
    target_mm: float | None = option(f"{U_AT_LEVEL} of a length at which to stop.", min=0),
    terminal: bool = flag("--terminal", "Show the capture in this terminal instead of a browser."),
    manual: bool = flag("--manual", "Take poses by a key or the arm's button only, and not at every rest."),
    both_sides: bool = flag(
        "--both-sides", "Take every pose twice, with each joint from one side and from the other, which shows play."
    ),
    capture_only: bool = flag("--capture-only", "Do not calibrate when the capture is finished."),
    keep_stream: Path | None = option("Also append everything that the devices send to this file.", "FILE"),
    port: int = option("Port of the page. Default: a free one.", "N", default=0, min=0, max=65535),
    token: bool = flag(
        "--token", "Also serve the page to other computers; its address ends with a random token, which they need."
    ),
    no_browser: bool = flag("--no-browser", "Print the address of the page, and do not open a browser."),
    base: str | None = options.BASE_LINK,
    tip: list[str] | None = options.TIP_LINK,
) -> None:
    """Measure an arm, guided from pose to pose.

    The command says where to put the tip next, and when it is enough.
    A page in the browser (or --terminal) shows the arm as it moves, the next pose, the residual of each pose that was
    taken, and the uncertainty reached so far. Poses are taken when the arm is held still, by a key, or by the arm's
    button. Finishing writes the capture, its calibration and the report.
    """
    import typer

    from ..live.session import Session
    from ..live.setups import read_setup

    given: dict[str, Any] = {"base": base, "tip": tip}
    setup = read_setup(arm, plan=plan, kit=kit, **given)
    given = {"target": target_mm, "automatic": not manual, "stream": keep_stream, "both_sides": both_sides}
    with Session(setup, device, path=output, **given) as session:
        if terminal:
            from ..live.terminal import show

            written = show(session, calibrate=not capture_only)
        else:
            _serve(session, port, token, not no_browser)
            written = session.state()["paths"]
        state = session.state()
    poses, used = len(state["poses"]), len(state["written"])
    if written:
        left = f" ({poses - used} in {output}.journal only)" if used < poses else ""
        typer.echo("\n".join([f"{pluralise(used, 'pose')}{left}; written: {', '.join(written)}", *state["says"]]))
    else:
        typer.echo(f"{pluralise(poses, 'pose')} are kept in {output}.journal; run the same command to go on.")


def _serve(session: Any, port: int, others: bool, browser: bool) -> None:
    """Show the page until the command is interrupted."""
    import contextlib
    import secrets
    import socket
    import time

    import typer

    from ..live.server import opened, serving
    from ..live.shown import not_answering

    # A token of the user's own would stand in the list of processes, where other users read it.
    where = {"host": "0.0.0.0", "token": secrets.token_urlsafe(24)} if others else {}
    with serving(session, port=port, **where) as address, contextlib.ExitStack() as stack:
        typer.echo(f"The page is at {address} (Ctrl-C ends).")
        if others:
            typer.echo(f"From other computers: {address.replace('127.0.0.1', socket.gethostname(), 1)}")
        if browser and not stack.enter_context(opened(address)):
            typer.echo("No browser was found here; open the address in one.")
        told: set[str] = set()
        with contextlib.suppress(KeyboardInterrupt):
            while True:
                for text in not_answering(session.state()["live"]["devices"], told):
                    typer.echo(text)
                time.sleep(1.0)
