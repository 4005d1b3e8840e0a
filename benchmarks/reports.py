"""The cost of a report, and whether a browser shows it: ``python benchmarks/reports.py``.

Writes the reports of the demonstration, of the real Panda in examples/mukca, of an acceptance test and of a study;
times the command in fresh processes (the second of two counts: programs are compiled by then); opens each report in
Chromium at 400 and 1600 px; and keeps the measurements in results/. It prints the folder of screenshots and PDFs.
"""

import datetime
import json
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent
PANDA = HERE.parent / "examples/mukca/capture.toml"
STUDY = """
arm = "cheng2018-simulation"
trials = 200
seed = 1
capture = { positions_mm = [[400, 200, 300]], poses = [20, 70] }
noise = { encoder_arcsec = [1, 2, 5], seating_mm = 0.005 }
reference = { length_mm = 500, u_mm = 0.002, region = { distance_mm = [300, 1000] } }
"""


def run(folder: Path, *arguments: str) -> float:
    """Run the command line in a fresh process; seconds."""
    start = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-m", "aacmm_jax", *arguments], cwd=folder, capture_output=True, text=True, check=False
    )
    if done.returncode > 1:
        sys.exit(f"aacmm {' '.join(arguments)}: {done.stderr}")
    return time.perf_counter() - start


def files(folder: Path) -> dict[str, str]:
    """The files to report on, by what they are."""
    run(folder, "demo", "demo")
    acceptance = ("--true-arm", "demo/true.toml", "--acceptance", "iso", "--encoder-arcsec", "2")
    run(folder, "simulate", "demo/nominal.toml", *acceptance, "-o", "iso.h5")
    limits = ("--mpe", "E_Uni=0.05+L/20000", "--test-u-mm", "0.001")
    run(folder, "evaluate", "demo/calibration.h5", "iso.h5", *limits, "-o", "acceptance.h5")
    (folder / "study.toml").write_text(STUDY)
    run(folder, "study", "study.toml", "-o", "study.h5")
    run(folder, "import", str(PANDA), "-o", "real-capture.h5")
    run(folder, "calibrate", "real-capture.h5", "-o", "real.h5", "--without", "mid_*/*")
    return {
        "demo": "demo/calibration.h5",
        "acceptance test": "acceptance.h5",
        "study": "study.h5",
        "real capture": "real.h5",
    }


def shown(page: Path, shots: Path) -> dict:
    """What Chromium shows of a page, requests and complains about."""
    from playwright.sync_api import sync_playwright

    found = {}
    with sync_playwright() as playwright:
        quiet = [
            "--no-sandbox",
            "--disable-gpu",
            "--disable-background-networking",
            "--disable-component-update",
            "--disable-sync",
        ]
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=quiet)
        for width in (400, 1600):
            opened = browser.new_context(viewport={"width": width, "height": 900}, offline=True).new_page()
            said, asked = [], []
            opened.on("console", lambda message, said=said: said.append(message.text))
            opened.on("pageerror", lambda error, said=said: said.append(str(error)))
            opened.on("request", lambda request, asked=asked: asked.append(request.url))
            opened.goto(page.as_uri())
            opened.wait_for_selector("body[data-ready=yes]", timeout=60_000)
            figures = opened.locator("[data-chart], [data-scene]").count()
            drawn = opened.locator("[data-drawn=yes]").count()
            network = [url for url in asked if not url.startswith(("data:", "blob:", "file:"))]
            over = opened.evaluate("document.documentElement.scrollWidth") - width
            found[width] = {
                "figures": figures,
                "drawn": drawn,
                "console": said,
                "network": network,
                "wider than the screen": max(over, 0),
            }
            opened.screenshot(path=shots / f"{page.stem}-{width}.png", full_page=True)
            if width == 1600:
                opened.pdf(path=shots / f"{page.stem}.pdf", format="A4", print_background=True)
        browser.close()
    return found


def main() -> None:
    folder = Path(tempfile.mkdtemp(prefix="aacmm-reports-"))
    results = {}
    for name, file in files(folder).items():
        page = folder / f"{name.replace(' ', '-')}.html"
        seconds = [run(folder, "report", file, "-o", page.name) for _ in range(3)]
        results[name] = {"seconds": [round(x, 2) for x in seconds], "MB": round(page.stat().st_size / 1e6, 2)}
        results[name] |= {"browser": shown(page, folder)} if shutil.which("chromium") else {}
        print(name, results[name])
    stamp = datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d-%H%M")
    (HERE / "results" / f"reports-{stamp}.json").write_text(json.dumps(results, indent=1) + "\n")
    print(f"Screenshots and PDFs: {folder}")


if __name__ == "__main__":
    main()
