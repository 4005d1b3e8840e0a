"""The site as a browser shows it: what the search finds first, and whether pages can be read by everyone.

The site is built once, without notebooks and the reference of Python. Without Chromium, Playwright or axe, nothing is
tested.
"""

import functools
import re
import shutil
import subprocess
import sys
import threading
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
# What people type, and the page that is to come first.
QUERIES = {
    "acceptance test": "how_to/acceptance_tests",
    "troubleshooting": "troubleshooting",
    "swap columns": "troubleshooting",
    "recalibration interval": "how_to/drift",
    "residuals too large": "troubleshooting",
    "wrong sign": "troubleshooting",
    "degrees radians": "troubleshooting",
    "bad poses": "troubleshooting",
    "socket moved": "troubleshooting",
    "timestamps": "troubleshooting",
    "backlash": "troubleshooting",
    "payload": "troubleshooting",
    "noisy encoder": "troubleshooting",
    "temperature drift": "troubleshooting",
    "held-out errors": "troubleshooting",
    "tip remounted": "troubleshooting",
    "wrong scale": "troubleshooting",
    "no reference length": "troubleshooting",
    "not converged": "troubleshooting",
    "parameter on bound": "troubleshooting",
    "huge uncertainty": "troubleshooting",
    "joint does not move": "troubleshooting",
    "hand-eye": "how_to/cameras",
    "focal length": "troubleshooting",
    "command not found": "troubleshooting",
    "own joint model": "how_to/own_joint_model",
    "custom correction": "how_to/own_joint_model",
    "new model": "how_to/own_joint_model",
}
READ_BY_ALL = (
    "index",
    "start",
    "troubleshooting",
    "explanation/method",
    "how_to/setups",
    "reference/glossary",
    "search",
)


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, format, *args):
        pass


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The address of the built pages."""
    pytest.importorskip("sphinx_copybutton")
    target = tmp_path_factory.mktemp("site")
    left_out = "exclude_patterns=_build,notebooks/*,reference/api/*,reference/gallery*"
    command = [sys.executable, "-m", "sphinx", "-q", "-b", "html", "-D", left_out, str(DOCS), str(target)]
    subprocess.run(command, check=True, capture_output=True, timeout=600)
    with ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(target))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()


@pytest.fixture(scope="module")
def page(site):
    playwright = pytest.importorskip("playwright.sync_api")
    if CHROMIUM is None:
        pytest.skip("Chromium is not installed")
    with playwright.sync_playwright() as running:
        browser = running.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu"])
        opened = browser.new_page(base_url=site)
        opened.set_default_timeout(60_000)
        yield opened
        browser.close()


@pytest.mark.slow
def test_the_right_page_is_found_first(page):
    """For nine of ten queries; the others are listed."""
    wrong = {}
    for query, asked in QUERIES.items():
        page.goto(f"/search.html?q={query.replace(' ', '+')}")
        # The heading changes when the search has ended.
        page.wait_for_function("!document.querySelector('#search-results h2')?.textContent.startsWith('Searching')")
        results = page.locator("#search-results li a")
        first = results.first.get_attribute("href") if results.count() else None
        if first is None or first.partition(".html")[0].removeprefix("./") != asked:
            wrong[query] = first
    assert len(wrong) <= len(QUERIES) // 10, wrong


@pytest.mark.slow
@pytest.mark.parametrize("name", READ_BY_ALL)
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_pages_have_no_serious_finding_of_axe(page, name, scheme):
    axe = pytest.importorskip("axe_playwright_python.sync_playwright").Axe()
    page.emulate_media(color_scheme=scheme)
    page.goto(f"/{name}.html")
    findings = axe.run(page).response["violations"]
    serious = {
        finding["id"]: [node["html"][:120] for node in finding["nodes"][:3]]
        for finding in findings
        if finding["impact"] in ("serious", "critical")
    }
    assert not serious, serious


@pytest.mark.slow
@pytest.mark.parametrize("title", re.findall(r"\[`(.+?)`\][([]", (DOCS / "troubleshooting.md").read_text("utf-8")))
def test_troubleshooting_quotes_what_is_said(title):
    if not title.startswith("aacmm"):
        assert f"### `{title}`\n" in (DOCS / "warnings.md").read_text("utf-8")
