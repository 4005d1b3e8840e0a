"""The cost of a report, and whether a browser shows it: ``python benchmarks/reports.py``.

Writes the reports of the demonstration, of the real Panda in examples/mukca and of data that it has not seen, of an
acceptance test, a study, compared models, and of the UR10 in examples/ipa_ur10 with 16 and 397 parameters, of a
measuring arm with a laboratory's data, of images, and of two calibrations of one robot; writes the pages of a plan and
of a verification; times the command in fresh processes; opens each page in Chromium at 400, 1000 and 1600 px, light and
dark; says which of verdict, three numbers and picture are not on the first screen (900 px high); and keeps the
measurements in results/. It prints the folder of screenshots and PDFs. Names of pages as arguments write only these.
"""

import datetime
import itertools
import json
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent
PANDA = HERE.parent / "examples/mukca/capture.toml"
TRACKER = HERE.parent / "examples/ipa_ur10/positions.toml"
MEASURING_ARM = HERE.parent / "examples/measuring_arm"
WEBCAM = HERE.parent / "examples/webcam/webcam.toml"
# Decisions, and what else is marked, outside of what is seen without scrolling; not in tables that are folded.
OUTSIDE = """[...document.querySelectorAll("td[class*=mark-], .verdict")].filter((one) =>
    one.getClientRects().length && one.getBoundingClientRect().right > innerWidth + 1).length"""
# What the first screen must show, and does not.
BELOW = """[".verdict", ".numbers div:nth-child(3)", ".first figure svg"].filter((part) => {
    const box = document.querySelector(part)?.getBoundingClientRect();
    return !box || box.top < 0 || box.height == 0 || box.bottom > innerHeight; })"""
# Charts whose every plot has a size and marks, which needs no script; and views of the arm that the script has drawn.
DRAWN = """[...document.querySelectorAll("[data-chart]")].filter((one) =>
    [...one.querySelectorAll(".axes > svg")].every((svg) => {
        const size = svg.getBoundingClientRect();
        return size.width > 50 && size.height > 50 && svg.querySelector("path, use, rect");
    })).length + document.querySelectorAll("[data-drawn=yes]").length"""
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


def demonstration(folder: Path) -> None:
    run(folder, "demo", "demo")


def acceptance(folder: Path) -> None:
    demonstration(folder)
    acceptance = ("--true-arm", "demo/true.toml", "--acceptance", "iso", "--encoder-arcsec", "2")
    run(folder, "simulate", "demo/nominal.toml", *acceptance, "-o", "iso.h5")
    limits = ("--mpe", "E_Uni=0.05+L/20000", "--test-u-mm", "0.001")
    run(folder, "evaluate", "demo/calibration.h5", "iso.h5", *limits, "-o", "acceptance.h5")


def study(folder: Path) -> None:
    (folder / "study.toml").write_text(STUDY)
    run(folder, "study", "study.toml", "-o", "study.h5")


def real(folder: Path) -> None:
    run(folder, "import", str(PANDA), "-o", "real-capture.h5")
    run(folder, "calibrate", "real-capture.h5", "-o", "real.h5", "--without", "mid_*/*")
    run(folder, "evaluate", "real.h5", "real-capture.h5", "-o", "held-out.h5")


def models(folder: Path) -> None:
    run(folder, "import", str(PANDA.with_name("panda_3.toml")), "-o", "other-capture.h5")
    run(folder, "compare-models", "other-capture.h5", "-o", "models.h5")


def tracker(folder: Path) -> None:
    run(folder, "import", str(TRACKER), "-o", "tracker-capture.h5")
    some = ("--only-poses", "500", "--seed", "0")
    run(folder, "calibrate", "tracker-capture.h5", "-o", "tracker.h5", *some)
    run(folder, "calibrate", "tracker-capture.h5", "-o", "many.h5", *some, "--model", "dh,gravity,harmonics=1-31")


def laboratory(folder: Path) -> None:
    run(folder, "calibrate", str(MEASURING_ARM / "session.toml"), "-o", "laboratory.h5")
    lines = (MEASURING_ARM / "laboratory.toml").read_text().splitlines(keepends=True)
    # No test supports a statement of conformity in the report of a calibration.
    stated = "".join(line for line in lines if not line.startswith("conformity."))
    (folder / "laboratory.toml").write_text(stated)


def webcam(folder: Path) -> None:
    run(folder, "calibrate", str(WEBCAM), "-o", "webcam.h5")


def drift(folder: Path) -> None:
    for name, manifest in (("first", "panda_3"), ("second", "panda_3_bis")):
        run(folder, "calibrate", str(PANDA.with_name(f"{manifest}.toml")), "-o", f"{name}.h5", "--no-cross-validate")
    run(folder, "compare", "first.h5", "second.h5", "-o", "changes.h5")


# The file to report on and what writes it, by the page's name; an HTML page is written by its command itself.
PAGES = {
    "demo": ("demo/calibration.h5", demonstration),
    "acceptance test": ("acceptance.h5", acceptance),
    "study": ("study.h5", study),
    "real capture": ("real.h5", real),
    "evaluation": ("held-out.h5", real),
    "model comparison": ("models.h5", models),
    "tracker": ("tracker.h5", tracker),
    "397 parameters": ("many.h5", tracker),
    "laboratory": ("laboratory.h5", laboratory),
    "webcam": ("webcam.h5", webcam),
    "drift": ("changes.h5", drift),
}
WRITTEN = {
    "plan": ("plan", "cheng2018-simulation", "--sockets", "4", "--poses", "25", "-o", "plan.csv", "--page"),
    "verification": ("verify", str(PANDA.with_name("panda_3.toml")), "--delivered", "panda", "-o"),
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
        for width, colours in itertools.product((400, 1000, 1600), ("light", "dark")):
            context = browser.new_context(viewport={"width": width, "height": 900}, offline=True, color_scheme=colours)
            opened = context.new_page()
            said, asked = [], []
            opened.on("console", lambda message, said=said: said.append(message.text))
            opened.on("pageerror", lambda error, said=said: said.append(str(error)))
            opened.on("request", lambda request, asked=asked: asked.append(request.url))
            opened.goto(page.as_uri())
            opened.wait_for_selector("body[data-ready=yes]", timeout=60_000)
            figures = opened.locator("[data-chart], [data-scene]").count()
            drawn = opened.evaluate(DRAWN)
            network = [url for url in asked if not url.startswith(("data:", "blob:", "file:"))]
            over = opened.evaluate("document.documentElement.scrollWidth") - width
            found[f"{width} {colours}"] = {
                "figures": figures,
                "drawn": drawn,
                "console": said,
                "network": network,
                "wider than the screen": max(over, 0),
                "marks outside": opened.evaluate(OUTSIDE),
                "not on the first screen": opened.evaluate(BELOW),
            }
            opened.screenshot(path=shots / f"{page.stem}-{width}-{colours}.png", full_page=True)
            if width == 1600 and colours == "light":
                opened.pdf(path=shots / f"{page.stem}.pdf", format="A4", print_background=True)
            context.close()
        browser.close()
    return found


def main() -> None:
    folder = Path(tempfile.mkdtemp(prefix="aacmm-reports-"))
    results = {}
    asked = sys.argv[1:] or [*PAGES, *WRITTEN]
    for write in {PAGES[name][1]: None for name in asked if name in PAGES}:
        write(folder)
    for name in asked:
        page = folder / f"{name.replace(' ', '-')}.html"
        if name in PAGES:
            about = ("--about", "laboratory.toml") if name == "laboratory" else ()
            command = ("report", PAGES[name][0], *about, "-o")
        else:
            command = WRITTEN[name]
        seconds = [run(folder, *command, page.name) for _ in range(2)]
        results[name] = {"seconds": [round(x, 2) for x in seconds], "MB": round(page.stat().st_size / 1e6, 2)}
        results[name] |= {"browser": shown(page, folder)} if shutil.which("chromium") else {}
        print(name, results[name])
    if not sys.argv[1:]:
        stamp = datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d-%H%M")
        (HERE / "results" / f"reports-{stamp}.json").write_text(json.dumps(results, indent=1) + "\n")
    print(f"Screenshots and PDFs: {folder}")


if __name__ == "__main__":
    main()
