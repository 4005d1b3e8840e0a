"""Makes the pictures of README and site anew: python docs/pictures.py (needs Chromium for the report)."""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

DOCS = Path(__file__).resolve().parent
MANIFEST = DOCS.parent / "examples" / "mukca" / "capture.toml"
CHROMIUM = ("chromium", "chromium-browser", "google-chrome")
QUIET = ("--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--hide-scrollbars")

SCHEMES = {"report.png": 1, "report-dark.png": 0}  # Chromium's numbers of light and dark


def aacmm(folder: Path, *arguments: object) -> None:
    """Run the command line in a folder."""
    subprocess.run([sys.executable, "-m", "aacmm_jax", *map(str, arguments)], cwd=folder, check=True)


def main() -> None:
    """Picture the demonstration, and the beginning of the report of the Panda's calibration."""
    chromium = next((path for name in CHROMIUM if (path := shutil.which(name))), None)
    if chromium is None:
        sys.exit("Chromium is not installed; install it to picture the report.")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        aacmm(folder, "demo", "demo")
        shutil.copy(folder / "demo" / "calibration.png", DOCS / "demo.png")
        aacmm(folder, "import", MANIFEST, "-o", "capture.h5")
        without = ("--without", "mid_left/*", "--without", "mid_right/*")
        aacmm(folder, "calibrate", "capture.h5", "-o", "calibration.h5", *without)
        aacmm(folder, "report", "calibration.h5", "-o", "report.html")
        for name, scheme in SCHEMES.items():
            picture, setting = f"--screenshot={DOCS / name}", f"--blink-settings=preferredColorScheme={scheme}"
            command = [chromium, *QUIET, "--window-size=1060,700", setting, picture, (folder / "report.html").as_uri()]
            subprocess.run(command, check=True, capture_output=True, timeout=120)


if __name__ == "__main__":
    main()
