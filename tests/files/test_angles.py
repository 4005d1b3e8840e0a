"""What a check prints for a manifest: pasted into it, its readings are those of the arm."""

import math

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.diagnostics.reading_fit import Explanation
from aacmm_jax.files.manifest import read_manifest
from aacmm_jax.files.reading_checks import angles_toml

Q = np.random.default_rng(0).uniform(-1.4, 1.4, (8, 6))  # rad, of the arm
ORDER, SIGNS, ZEROS = (0, 1, 2, 4, 3, 5), (1, 1, -1, 1, 1, 1), (0.0, -math.pi / 2, 0.0, 0.5 * math.pi, 0.0, 0.0)
PLAIN = tuple(range(6))
NAMES = ",".join(f"J{i}{{unit}}" for i in range(1, 7))


def explanation(order, offsets, angle=1.0):
    return Explanation(tuple(order), SIGNS, tuple(offsets), angle, 1.0, 0.1, 0.1, 0)


def recorded(order, offsets):
    """Columns that are read as the explanation has them, rad."""
    columns = np.zeros_like(Q)
    columns[:, list(order)] = (Q - np.array(offsets)) * np.array(SIGNS)
    return columns


COUNTS = 4096 / (2 * math.pi)


@pytest.mark.parametrize(
    ("header", "size", "angles", "socket"),
    [
        (NAMES.format(unit=" [deg]"), 180 / math.pi, "", ""),
        (NAMES.format(unit=" [rad]"), 1.0, "", ""),
        (NAMES.format(unit=""), 180 / math.pi, 'unit = "deg"', ""),
        (NAMES.format(unit=""), COUNTS, 'unit = "counts"\ncounts_per_turn = 4096', ""),
        (NAMES.format(unit=""), 180 / math.pi, 'unit = "rad"', 'units = { q = "deg" }'),
        (
            NAMES.format(unit=" [deg]"),
            180 / math.pi,
            'unit = "deg"\ncolumns = ["J1", "J2", "J3", "J4", "J5", "J6"]',
            "",
        ),
        (NAMES.format(unit=" [deg]"), 180 / math.pi, "", 'columns = "J*"'),
        (NAMES.format(unit=" [deg]"), 180 / math.pi, "", 'columns = { q = ["J1", "J2", "J3", "J4", "J5", "J6"] }'),
    ],
)
@pytest.mark.parametrize("order", [PLAIN, ORDER])
def test_the_table_pasted_into_the_manifest(tmp_path, header, size, angles, socket, order):
    np.savetxt(tmp_path / "a.csv", recorded(order, ZEROS) * size, delimiter=",", header=header, comments="")
    manifest = tmp_path / "m.toml"

    def write(table, line):
        text = f'arm = "cheng2018-simulation"\n{table}\n[[socket]]\nname = "A"\nfile = "a.csv"\n{line}\n'
        manifest.write_text(text)
        return np.asarray(read_manifest(manifest).capture.q)

    write(f"[angles]\n{angles}" if angles else "", socket)
    printed = angles_toml(explanation(order, ZEROS), None, manifest)
    assert ("In [[socket]] (a.csv), replace the picked columns with:" in printed) == (
        "columns" in socket and order != PLAIN
    )
    line = printed.split("\n# columns")[1].strip() if "\n# columns" in printed else socket.removeprefix("columns")
    line = f"columns {line}" if "columns" in socket else socket
    np.testing.assert_allclose(write(printed, line), Q, atol=1e-8)


@pytest.mark.parametrize(
    ("table", "angles", "part"),
    [
        (NAMES.format(unit=" [rad]"), "", "a.csv pose 1 joint 1 is 90 rad, more than four revolutions"),
        (NAMES.format(unit=""), '[angles]\nunit = "rad"\n', 'correct the header, or write unit = "deg" in [angles].'),
    ],
)
def test_degrees_read_as_rad(tmp_path, table, angles, part):
    np.savetxt(tmp_path / "a.csv", np.full((2, 6), 90.0), delimiter=",", header=table, comments="")
    manifest = tmp_path / "m.toml"
    manifest.write_text(f'arm = "cheng2018-simulation"\n{angles}[[socket]]\nname = "A"\nfile = "a.csv"\n')
    with pytest.raises(aj.InputError) as refused:
        read_manifest(manifest)
    assert part in str(refused.value)
    assert "numpy" not in str(refused.value)
