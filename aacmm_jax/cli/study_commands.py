"""The command ``study``, and what ``show`` does with a study's file."""

import os
import shlex
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

from ..core.errors import InputError
from ..files.outputs import together
from . import INTERRUPTED, INTERRUPTED_SENTENCE, options
from .app import Stopped, command, progress_bar, show_summary, with_spinner
from .options import argument, flag, option, output


@command(
    "aacmm study bound-sensitivity -o study.h5",
    "aacmm study my-study.toml -o study.h5 --dask tls://scheduler:8786",
    "aacmm study --resume -o study.h5",
)
def study(
    output: Path = output("File to write the study to, or study to continue (HDF5).", "FILE.h5"),
    specification: str | None = argument(
        "Specification: a TOML file, or the name of a study that ships with aacmm.", "SPEC.toml", None
    ),
    resume: bool = flag("--resume", "Continue the study in the output file."),
    trials: int | None = option("Number of trials per cell. Default: the number in the specification.", "N", min=1),
    seed: int | None = option("Seed of the random numbers. Default: the seed in the specification.", "N", min=0),
    chunk: int | None = option(
        "Number of trials computed at a time; the results do not depend on this number. Default: 1000.", "N", min=1
    ),
    dask: str | None = option(
        "Run on the Dask cluster whose scheduler has this address. With tcp://, everybody who can reach the port can "
        "run programs with your user rights; tls:// requires certificates (see docs/scaling.md).",
        "ADDRESS",
    ),
    workers: int | None = option("Number of threads of this process. Default: one per core.", "N", min=1),
    shards: bool = flag(
        "--shards",
        "Let the Dask workers write their trials directly to the folder of the output; all workers must have access "
        "to this folder.",
    ),
    as_json: bool = options.JSON,
) -> None:
    """Run a Monte Carlo study of calibrations.

    Repeat the command to continue a study that was interrupted.
    """
    from ..study.definition import Study
    from ..study.results import study_summary
    from ..study.runner import dask_executor, run_study
    from ..study.sources import read_study
    from ..study.store import Results, read

    if resume and not os.path.exists(output):  # where `Path.exists` raises, of a name too long to be one
        raise InputError(
            f"{output} does not exist, so there is nothing to resume; leave out --resume to start a study."
        )
    changes = {name: value for name, value in (("trials", trials), ("seed", seed)) if value is not None}
    if specification is None:
        if not resume:
            raise InputError(
                "no specification is given; name a specification, or use --resume to continue the study in the output "
                "file."
            )
        if changes:
            raise InputError(
                "a resumed study keeps its trials and its seed; leave out --trials and --seed with --resume."
            )
        asked = read(output).study
    else:
        with together(output):  # refuses an output that the specification reads
            asked = read_study(specification)
            if changes:
                from ..files.toml import validated

                stated = asked.specification.model_dump(exclude_unset=True) | changes
                changed = validated(type(asked.specification), stated, specification)
                asked = Study(changed, asked.nominal, asked.recording)
    if shards and dask is None:
        raise InputError(
            "--shards applies to the workers of a Dask cluster only; leave out --shards, or name a cluster with --dask."
        )
    if workers is not None and dask is not None:
        raise InputError("a Dask cluster determines its own workers; leave out --workers.")
    with _leaving_threads():
        here = nullcontext((None, workers))
        with _progress_display() as show, here if dask is None else dask_executor(dask) as (executor, count):
            settings = {"executor": executor, "workers": count, "watch": show}
            outcome = run_study(asked, output, chunk=chunk, shards=shards, **settings)
        summary = {
            "kind": "study",
            "written": str(output),
            "trials": outcome.total,
            "trials_done": outcome.done,
            "trials_this_run": outcome.ran,
            "finished": outcome.finished,
            "finding": with_spinner("Summarising", lambda: study_summary(Results.of(output))["finding"]),
        }
        show_summary(summary, as_json, _ended)
        if not outcome.finished:
            raise Stopped(
                f"Stopped; {outcome.done:,} of {outcome.total:,} trials are saved. Continue with: aacmm study "
                f"--resume -o {shlex.quote(str(output))}"
            )


@contextmanager
def _leaving_threads() -> Iterator[None]:
    """After an interrupt, leave threads that still compute: at its end, Python would wait for them."""
    try:
        yield
    except (KeyboardInterrupt, Stopped) as interrupt:
        from ..core._compat import end_process
        from ..study.runner import THREADS

        if not any(thread.name.startswith(THREADS) for thread in threading.enumerate()):
            raise
        print(str(interrupt) or INTERRUPTED_SENTENCE, file=sys.stderr, flush=True)
        sys.stdout.flush()
        end_process(INTERRUPTED)


@contextmanager
def _progress_display() -> Iterator[Any]:
    """A progress bar with the time left, on standard error, where that is a terminal."""
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    counts = (BarColumn(), MofNCompleteColumn(), TextColumn("trials"))
    with progress_bar(TextColumn("{task.description}"), *counts, TimeElapsedColumn(), TimeRemainingColumn()) as bar:
        if bar is None:
            yield None
            return
        task = bar.add_task("Compiling ...", total=None)

        def show(state: Any) -> None:
            description = "Calibrating"
            if state.compiling:
                number = state.programs - state.compiling + 1
                description = f"Compiling program {number} of {state.programs} ..."
            elif state.stopping:
                description = "Stopping when the running blocks are finished; press Ctrl-C again to discard them"
            bar.update(task, description=description, total=state.total, completed=state.done)

        yield show


def _ended(summary: dict[str, Any]) -> list[str]:
    if not summary["finished"]:
        return []
    ran = f"{summary['trials_this_run']:,} trials run" if summary["trials_this_run"] else "no trials remained to be run"
    written = summary["written"]
    return [
        *filter(None, [summary["finding"]]),
        f"Written: {written} ({summary['trials']:,} trials, {ran}).",
        f"Show the results with: aacmm show {written}",
    ]
