"""Lines of devices: what a format reads of them, and a cable that is pulled."""

import os
import time
from functools import partial

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.live.devices.line_format import CHECKSUMS, LONGEST, format_of_lines
from tests.live.line_sources import Feeder, Growing, Pty, Server, columns

ARM = aj.Arm(alpha=[0, np.pi / 2, 0], a=[0, 300, 300], d=[200, 0, 0], limits=[(-3, 3)] * 3)


def read(line: bytes, **options: str):
    sample, reason, missing = format_of_lines("tcp:a:1", options, ARM).sample(line, 5.0)
    return sample, reason, missing


@pytest.mark.parametrize(
    ("line", "options", "q"),
    [
        (b"10,20,30", {}, np.radians([10, 20, 30])),
        (b" 10;\t20 ; 30\r", {}, np.radians([10, 20, 30])),
        (b"0.1 0.2 -3e-1", {"unit": "rad"}, [0.1, 0.2, -0.3]),
        (b"1024 0 2048", {"unit": "counts", "counts_per_turn": "4096"}, [np.pi / 2, 0, np.pi]),
        (b"11,-20,30", {"offset": "1,0,0", "sign": "1,-1,1"}, np.radians([10, 20, 30])),
        (b"7 30 20 10", {"columns": "-,q_3,q_2,q_1"}, np.radians([10, 20, 30])),
        (b"A=10 B=20 C=30", {"pattern": r"A=(?P<q_1>\S+) B=(?P<q_2>\S+) C=(?P<q_3>\S+)"}, np.radians([10, 20, 30])),
        (b"Q10,20,30", {"begins": "Q"}, np.radians([10, 20, 30])),
    ],
)  # fmt: skip
def test_lines_become_readings(line, options, q):
    sample, reason, _ = read(line, **options)
    assert reason == ""
    np.testing.assert_allclose(sample.q, q, atol=1e-15)


# Check values of the catalogue of parametrised CRC algorithms, for the text 123456789, and of NMEA 0183's example.
@pytest.mark.parametrize(
    ("name", "text", "value"),
    [
        ("crc16", b"123456789", 0x4B37),
        ("crc16-ccitt", b"123456789", 0x29B1),
        ("xor", b"GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,", 0x47),
        ("sum", b"\xff\x02", 0x01),
    ],
)
def test_checksums_are_those_of_their_standards(name, text, value):
    assert CHECKSUMS[name][0](text) == value


@pytest.mark.parametrize(
    ("line", "options", "reason"),
    [
        (b"10,20", {}, "wrong number of values"),
        (b"10,20,nan", {}, "not a number"),
        (b"10,20,1_0", {}, "not a number"),
        (b"10,20,1e400", {}, "not a number"),
        (b"10,20,\xff30", {}, "not text"),
        (b"10,20,30*01", {"checksum": "xor"}, "wrong checksum"),
        (b"10,20,30", {"checksum": "crc16"}, "wrong checksum"),
        (b"1e8,0,0", {}, "beyond 50 turns"),
        (b"x" * (LONGEST + 1), {}, f"longer than {LONGEST} characters"),
        (b"nothing", {"pattern": r"(?P<q_1>\d)(?P<q_2>\d)(?P<q_3>\d)"}, "does not match the pattern"),
        (b"\x1b[2J,1,2", {"columns": "q_1,q_2,q_3"}, "not a number"),
        (b"1\x00,1,2", {}, "not a number"),
        (
            b"a" * 4000,
            {"pattern": r"(?P<q_1>(((a{1,1000}){1,1000}){1,1000}){1,1000})(?P<q_2>b)(?P<q_3>c)"},
            "takes the pattern too long",
        ),
    ],
)
def test_bad_lines_have_a_reason(line, options, reason):
    assert read(line, **options)[:2] == (None, reason)


def test_lines_that_begin_otherwise_are_passed_over():
    assert read(b"# restarted", begins="Q")[:2] == (None, "")


def test_numbers_of_lines_tell_what_is_missing_or_sent_twice():
    written = format_of_lines("tcp:a:1", {"columns": "number,q_1,q_2,q_3"}, ARM)
    answers = [written.sample(f"{number},1,2,3".encode(), 0.0)[1:] for number in (7, 8, 8, 11, 3, 4)]
    assert answers == [("", 0), ("", 0), ("sent twice", 0), ("", 2), ("", 0), ("", 0)]


def test_what_stands_beside_the_readings_and_what_instruments_see():
    sample, *_ = read(b"1 2 3 20.5 1 7.25", columns="q_1,q_2,q_3,temperature_C,button,time_s")
    assert sample.columns == {"temperature_C": 20.5, "button": 1.0}
    assert sample.time == 7.25
    sample, *_ = read(b"1 2 3", columns="x,y,z", length_unit="inch")
    assert sample.q is None
    np.testing.assert_allclose(sample.measured["points"], np.array([25.4, 50.8, 76.2]))


def test_a_header_names_columns_and_unit():
    written = format_of_lines("file:a.csv", {}, ARM)
    assert written.sample(b"t,q_3_rad,q_1_rad,q_2_rad,note", 0.0) == (None, "", 0)
    np.testing.assert_allclose(written.sample(b"0,0.3,0.1,0.2,7", 0.0)[0].q, [0.1, 0.2, 0.3])


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"columns": "q_1,q_2"}, "2 joints"),
        ({"columns": "q_1,q_1,q_2,q_3"}, "twice"),
        ({"columns": "q_1,q_2,q_3,speed"}, "'speed'"),
        ({"columns": "x,y"}, "needs x, y and z"),
        ({"pattern": "("}, "no regular expression"),
        ({"columns": "q_1,q_2,q_3", "pattern": "a"}, "columns and a pattern"),
        ({"checksum": "md5"}, "checksum"),
        ({"unit": "counts"}, "counts_per_turn"),
        ({"colums": "q_1"}, "colums"),
        ({"format": "absent.toml"}, "absent.toml"),
        ({"format": "absent.toml", "unit": "rad"}, "format and unit"),
    ],
)
def test_formats_that_contradict_themselves_are_refused(options, says):
    with pytest.raises(aj.InputError, match=says):
        format_of_lines("tcp:a:1", options, ARM)


def test_a_format_may_stand_in_a_file(tmp_path):
    file = tmp_path / "encoders.toml"
    file.write_text('checksum = "xor"\nangles = { unit = "counts", counts_per_turn = 360, sign = [1, -1, 1] }\n')
    sample, *_ = read(b"10,20,30*1C", format=str(file))
    assert sample is None
    text = b"10,20,30"
    sample, *_ = read(text + f"*{CHECKSUMS['xor'][0](text):02X}".encode(), format=str(file))
    np.testing.assert_allclose(np.degrees(sample.q), [10, -20, 30])


# A cable


def setup_of(places: int):
    """An arm of three joints with an instrument that would see it anywhere, and the poses to send."""
    specification = aj.kinematics.ArmSpecification(ARM, "three joints")
    noise = aj.files.load_noise("cheng2018-simulation")
    sockets = [
        aj.data.observations.SimulatedSocket(f"S{i}", ARM.position(q), 1) for i, q in enumerate(poses_of(places))
    ]
    return aj.live.setup_of(specification, noise, sockets)


def poses_of(count: int):
    random = np.random.default_rng(3)
    return [np.array([0.5 * (i % 9) - 2, *random.uniform(0.3, 1.2, 2)]) for i in range(count)]


def fed(source, tmp_path, count, **options):
    """Session after a feeder has sent so many poses, with the feeder."""
    setup, poses = setup_of(count), poses_of(count)
    device = f"{source.kind}:{source.where}?columns={columns(3)}&checksum=xor"
    with aj.live.Session(setup, [device], path=tmp_path / "c.h5") as session:
        state = partial(session.state, -1)
        feeder = Feeder(source, poses, lambda: session._devices[0].connected, **options)
        feeder.start()
        assert feeder.done.wait(60 + 4 * count)
        time.sleep(0.3)
        source.close()
        return state(), feeder, session


def read_all(device, done, seconds=20.0):
    samples, until = [], time.monotonic() + seconds
    while not done() and time.monotonic() < until:
        samples += device.read()
    return samples


@pytest.mark.parametrize("kind", [pytest.param(Pty, marks=pytest.mark.slow), Server, Growing])
def test_a_line_of_10_MB_is_one_bad_line_and_takes_no_memory(kind, tmp_path):
    source, sent = kind(tmp_path), 0
    device = aj.live.open_device(f"{source.kind}:{source.where}", setup_of(1))
    read_all(device, lambda: device.connected)
    read_all(device, lambda: False, 0.15)  # a serial port begins within a line unless it was silent
    piece, whole = (b"\x1b[2J" * 256, 20_000) if kind is Pty else (b"\x1b[2J" * 10_000, 10_000_000)
    largest = 0
    while sent < whole:
        source.send(piece)
        sent += len(piece)
        device.read()
        device.raw()
        largest = max(largest, len(device._buffer))
    source.send(b"\n")
    read_all(device, lambda: device.lines)
    source.send(b"1,2,3\n")
    samples = read_all(device, lambda: device.lines == 2)
    assert device.bad == {f"longer than {LONGEST} characters": 1}
    assert len(samples) == 1
    assert largest <= LONGEST
    device.close()
    source.close()


def test_a_file_is_followed_where_it_is_cut_or_replaced_and_a_half_line_waits(tmp_path):
    source, read = Growing(tmp_path), []
    device = aj.live.open_device(f"file:{source.where}", setup_of(1))
    for text, lines in ((b"q_1_rad,q_2_rad,q_3_rad\n1,0,", 0), (b"0\n2,0,0\n", 2), (b"3,0", 2)):
        source.send(text)
        read += read_all(device, lambda lines=lines: device.lines > lines, 0.3)
    source.plug()  # cut, with half a line lost
    read += read_all(device, lambda: not device.connected)
    source.send(b"4,0,0\n")
    read += read_all(device, lambda: device.lines == 4)
    other = tmp_path / "other.csv"
    other.write_bytes(b"5,0,0\n" * 50)
    other.replace(source.where)
    read += read_all(device, lambda: device.lines == 54)
    assert [sample.q[0] for sample in read] == [1, 2, 4, *[5] * 50]
    assert device.bad == {"half a line": 1}
    device.close()


def test_what_is_written_just_before_a_file_is_replaced_is_read(tmp_path, monkeypatch):
    source, path = Growing(tmp_path), tmp_path / "recorder.csv"
    device, looked = aj.live.open_device(f"file:{source.where}", setup_of(1)), os.fstat

    def rotated(number):
        if not path.with_suffix(".1").exists():
            source.send(b"2,0,0\n")
            path.rename(path.with_suffix(".1"))
        return looked(number)

    source.send(b"q_1_rad,q_2_rad,q_3_rad\n1,0,0\n")
    read = read_all(device, lambda: device.lines == 1)
    monkeypatch.setattr(os, "fstat", rotated)  # what is asked once there is nothing more to read
    read += read_all(device, lambda: not device.connected)
    source.send(b"3,0,0\n")
    read += read_all(device, lambda: device.lines == 3)
    assert [sample.q[0] for sample in read] == [1, 2, 3]
    device.close()


@pytest.mark.parametrize("kind", [Pty, Server])
@pytest.mark.slow
@pytest.mark.usefixtures("unguided")
def test_no_pose_is_lost_or_doubled_and_every_bad_line_is_counted(kind, tmp_path):
    source = kind(tmp_path)
    state, feeder, _ = fed(source, tmp_path, 12)
    assert feeder.error is None
    assert [pose["place"] for pose in state["poses"]] == [f"S{i}" for i in range(12)]
    bad = dict(state["live"]["devices"][0]["bad"])
    bad.pop("missing", None)  # numbers of lines that were sent while nothing was connected
    assert sum(bad.values()) == sum(feeder.spoilt.values()), (bad, feeder.spoilt)
