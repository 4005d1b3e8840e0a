"""Makes the tables of this folder anew, by simulation: python examples/measuring_arm/make.py."""

import math
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np

import aacmm_jax as aj

FOLDER = Path(__file__).resolve().parent
NOISE = aj.Noise(encoder_arcsec=2.0, seating=0.005)
SESSION = {"A": (400, 200, 300), "B": (700, 500, 500), "C": (-300, 600, 400), "D": (500, -400, 200)}
BAR = 500.0  # mm, between the centres of the two seats of the ball bar
PLACES = {  # one seat of the bar in mm, and its direction
    "bar 1": ((300, -200, 250), (1, 0.4, 0)),
    "bar 2": ((250, 300, 200), (0.2, 0.5, 0.8)),
    "bar 3": ((-400, 500, 350), (0.9, 0.3, 0.1)),
    "bar 4": ((-250, -600, 300), (0.1, 0.6, 0.5)),
}


def main() -> None:
    """Write the recorder's tables that the manifests name."""
    nominal = aj.load_arm("cheng2018-simulation")
    true = aj.perturbed_arm(aj.Parameters.free_of(nominal), length=1.0, angle=math.radians(0.1), seed=3)
    session = aj.simulate(true, SESSION, poses=40, noise=NOISE, seed=3).sockets
    # The technician chose socket C in the recorder two poses before the tip was in it.
    late = np.asarray(session["B"])[-2:]
    session = dict(session) | {"B": np.asarray(session["B"])[:-2], "C": np.vstack([late, session["C"]])}
    _record(session, FOLDER / "session.csv", datetime(2026, 1, 30, 9, 0))
    seats = {}
    for name, (start, direction) in PLACES.items():
        unit = np.array(direction) / np.linalg.norm(direction)
        seats |= {f"{name}/left": np.array(start, float), f"{name}/right": np.array(start) + BAR * unit}
    _record(
        aj.simulate(true, seats, poses=10, noise=NOISE, seed=5).sockets, FOLDER / "bar.csv", datetime(2026, 1, 31, 9)
    )


def _record(sockets: dict[str, np.ndarray], path: Path, begin: datetime) -> None:
    """One row a pose, as a recorder with German settings writes it."""
    lines = ["Time;Socket;" + ";".join(f"Enc{joint} [deg]" for joint in range(1, 7)) + ";Temperature [C]"]
    rows = [(name, q) for name, readings in sockets.items() for q in np.degrees(np.asarray(readings))]
    for number, (name, q) in enumerate(rows):
        time = begin + timedelta(seconds=20 * number)
        values = [*(f"{value:.5f}" for value in q), f"{20.1 + 0.001 * number:.2f}"]
        lines.append(
            ";".join([time.strftime("%d.%m.%Y %H:%M:%S"), name, *(value.replace(".", ",") for value in values)])
        )
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
