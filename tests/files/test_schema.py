"""Values that make no sense are refused in files whose digests are right, also where only their summary is shown."""

import h5py
import pytest

import aacmm_jax as aj
from aacmm_jax.files.hdf5_content import seal
from aacmm_jax.summaries.calibration import calibration_summary, capture_summary
from tests.refusals import assert_refused


@pytest.fixture(scope="module")
def files(tmp_path_factory, paper_arm, noisy_capture):
    """A capture and a calibration with their summaries."""
    folder = tmp_path_factory.mktemp("sense")
    specification = aj.kinematics.ArmSpecification(paper_arm, "test")
    recording = aj.Recording(noisy_capture, specification)
    record = aj.calibration.record_of(aj.calibrate(paper_arm, noisy_capture, specification.bounds()), recording)
    aj.files.save_capture(folder / "capture.h5", recording, capture_summary(recording))
    aj.files.save_calibration(folder / "calibration.h5", record, calibration_summary(record))
    return folder


@pytest.mark.first_rows(1)
@pytest.mark.parametrize(
    ("kind", "name", "value", "said"),
    [
        ("calibration", "k", 2.0, "the scale k does not agree with the reference lengths"),
        ("calibration", "u_k", -1.0, "u_k (standard uncertainty of k) is below 0"),
        ("calibration", "u_k", 1e-9, "the summary does not agree with the stored values"),
        ("calibration", "method", "guess", "method (method) is not one of two-stage, joint, repeatability"),
        ("calibration", "steps", -1, "steps (number of evaluations) is below 0"),
        ("calibration", "steps", 1.5, "steps (number of evaluations) has the wrong type"),
        ("calibration", "degrees_of_freedom", -1.0, "is below 0"),
        ("calibration", "measured", "soon", "the day of measurement is not a date"),
        ("capture", "measured", "soon", "the day of measurement is not a date"),
        ("capture", "seed", 1.5, "seed (seed of a simulated capture) has the wrong type"),
    ],
)
def test_show_refuses_what_makes_no_sense(aacmm, files, tmp_path, kind, name, value, said):
    path = tmp_path / f"{kind}.h5"
    path.write_bytes((files / f"{kind}.h5").read_bytes())
    aacmm("show", path)
    with h5py.File(path, "a") as file:
        (file.attrs if name in file.attrs or kind == "capture" else file["parameters"].attrs)[name] = value
    with open(path, "rb+") as stream:
        seal(stream)
    assert said in aacmm("show", path, expect=2).stderr
    if "summary" not in said:
        assert_refused(lambda: getattr(aj.files, f"load_{kind}")(path), path, said, "create it again")
