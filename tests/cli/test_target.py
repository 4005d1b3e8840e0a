"""The command that prints boards, and the lines of a manifest that it prints."""

import json
import tomllib

import pytest

from aacmm_jax.data.targets import Checkerboard, target_of


def test_a_board_is_written_with_the_lines_of_its_manifest(aacmm, tmp_path):
    printed = aacmm("target", "checkerboard", "--squares", "8x5", "--size-mm", 30, "-o", "board.pdf").stdout
    assert (tmp_path / "board.pdf").read_bytes().startswith(b"%PDF")
    (table,) = tomllib.loads(printed[printed.index("[[target]]") :])["target"]
    assert table.pop("name") == "board"
    assert target_of(**table) == Checkerboard(8, 5, 30.0, u_scale=0.05 / 150)
    aacmm("target", "checkerboard", "--squares", "5x4", "--size-mm", 30, "-o", "board.pdf")  # its own file


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["charuco", "aruco", "april"])
def test_markers_have_a_usual_size_and_dictionary(aacmm, kind):
    pytest.importorskip("cv2")
    summary = json.loads(aacmm("target", kind, "--squares", "4x3", "--size-mm", 30, "-o", "b.pdf", "--json").stdout)
    board = target_of(**summary["target"])
    assert len(board.ids) == summary["corners"]
    assert board.dictionary == {"april": "apriltag_36h11"}.get(kind, "4x4_100")


@pytest.mark.first_rows(2)
@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("checkerboard", "--squares", "8,5", "--size-mm", 30), "--squares '8,5' is not of the form COLUMNSxROWS"),
        (("checkerboard", "--squares", "8x5", "--size-mm", 0.03), "0.03 mm; sizes are in mm, so 0.03 m are 30"),
        (("checkerboard", "--squares", "8x5", "--size-mm", 60), "choose a2, or make the board smaller"),
        (("checkerboard", "--squares", "8x5", "--size-mm", 30, "--gap-mm", 3), "--gap-mm does not apply"),
    ],
)
def test_a_wrong_board_is_one_sentence_and_no_file(aacmm, tmp_path, arguments, sentence):
    assert sentence in " ".join(aacmm("target", *arguments, "-o", "board.pdf", expect=2).stderr.split())
    assert not list(tmp_path.iterdir())
