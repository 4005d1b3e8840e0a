"""The page in a real browser, with clicks and keys, of a session that is made up."""

import shutil
import time

import pytest

from aacmm_jax.live.server import serving

from ..conftest import SLOW
from .stub_session import StubSession

WIDTHS = [(400, "dark"), pytest.param(1600, "light", marks=pytest.mark.slow)]
ROWS = "count => document.querySelectorAll('#poses tr').length === count"
FRAMES = "least => Number(document.getElementById('view').dataset.frames) > least"
MARKUP = "<img src=x onerror=document.title='caught'>\x1b[2J\u202e" + "very long " * 300


@pytest.fixture(scope="module", params=SLOW)
def browser():
    api = pytest.importorskip("playwright.sync_api")
    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("no Chromium is installed (Debian: apt-get install chromium)")
    with api.sync_playwright() as playwright:
        running = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox", "--disable-gpu"])
        yield running
        running.close()


@pytest.fixture
def shown(browser):
    """Open the page of a session; what the console says of errors is kept on it."""
    contexts = []

    def show(address: str, width: int = 1600, scheme: str = "light", ready: bool = True, bypass_csp: bool = False):
        context = browser.new_context(
            viewport={"width": width, "height": 900}, color_scheme=scheme, bypass_csp=bypass_csp
        )
        context.set_default_timeout(60_000)  # ms; a busy machine takes longer than Playwright's 30 s
        contexts.append(context)
        page = context.new_page()
        page.said = []
        page.on("console", lambda message: page.said.append(message.text))
        page.on("pageerror", lambda error: page.said.append(str(error)))
        page.asked = []
        page.on("request", lambda request: page.asked.append(request.url))
        page.goto(address)
        if ready:
            page.wait_for_selector("body[data-ready=yes]")
        return page

    yield show
    for context in contexts:
        context.close()


def until(condition, seconds: float = 30.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.02)


@pytest.mark.parametrize(("width", "scheme"), WIDTHS)
def test_keys_and_clicks_do_what_they_say(shown, width, scheme):
    session = StubSession(poses=3)
    with serving(session) as address:
        page = shown(address, width, scheme)
        for press, expected in {
            " ": ("take", {}),
            "x": ("exclude", {"pose": 4, "excluded": True}),
            "u": ("undo", {}),
            "n": ("skip", {}),
            "a": ("auto", {"on": False}),
        }.items():
            page.keyboard.press(press)
            until(lambda expected=expected: session.asked and session.asked[-1] == expected)
            page.wait_for_function(ROWS, arg=len(session.poses))
        page.click("text=Undo")
        until(lambda: len(session.poses) == 2)
        page.keyboard.press(" ")  # the button that was clicked is not pressed again
        until(lambda: len(session.poses) == 3)
        page.wait_for_function(ROWS, arg=3)
        # A pose that is chosen from the table or by the arrows is the one that is excluded.
        page.click("#poses tr:last-child")
        page.wait_for_selector("#exclude:has-text('Exclude 1')")
        page.keyboard.press("ArrowUp")
        page.keyboard.press("x")
        until(lambda: session.asked[-1] == ("exclude", {"pose": 2, "excluded": True}))
        page.wait_for_selector("#poses tr.excluded")
        # Keys typed into a field are text, and a question is answered by keys as well.
        page.keyboard.press("s")
        page.fill("#answer", "x u warmed up")
        page.keyboard.press("Enter")
        until(lambda: session.asked[-1] == ("mark", {"text": "x u warmed up"}))
        page.fill("#celsius", "21,5")
        page.keyboard.press("Enter")
        until(lambda: session.asked[-1] == ("temperature", {"celsius": 21.5}))
        page.fill("#celsius", "warm")
        page.keyboard.press("Enter")
        page.wait_for_selector("#message:has-text('not a number')")
        page.click("#places button:has-text('C')")
        until(lambda: session.asked[-1] == ("place", {"name": "C"}))
        page.keyboard.press("m")
        page.wait_for_selector("#sound[aria-pressed=false]")
        page.keyboard.press("f")
        page.keyboard.press("Escape")
        page.keyboard.press("f")
        page.click("text=Write and calibrate")
        until(lambda: session.asked[-1] == ("finish", {"calibrate": True}))
        page.wait_for_selector("#paths:has-text('capture-report.html')")
        assert [name for name, _ in session.asked].count("finish") == 1
        assert page.said == []
        assert {url.split("?")[0].rpartition("/")[0] for url in page.asked if not url.startswith("data:")} == {
            address.partition("/#")[0]
        }
        assert not any(address.partition("#")[2] in url for url in page.asked[1:])


@pytest.mark.parametrize(("width", "scheme"), WIDTHS)
def test_the_arm_moves_and_the_page_is_no_wider_than_the_screen(shown, width, scheme):
    with serving(StubSession(poses=40, places=9)) as address:
        page = shown(address, width, scheme)
        first = int(page.get_attribute("#view", "data-frames") or 0)
        page.wait_for_function(
            "least => Number(document.getElementById('view').dataset.frames) > least", arg=first + 20
        )
        before = page.locator("#view").screenshot()
        page.focus("#view")
        page.keyboard.press("ArrowLeft")
        page.click("text=Top")
        page.mouse.wheel(0, 300)
        page.wait_for_timeout(200)
        assert page.locator("#view").screenshot() != before
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        # What is read from two metres: 14 mm of height are 40 pixels of a screen with 72 in an inch.
        size = page.evaluate("parseFloat(getComputedStyle(document.getElementById('headline')).fontSize)")
        assert size > (32 if width == 400 else 70)
        assert page.said == []


@pytest.mark.slow
@pytest.mark.parametrize(("width", "scheme"), [(400, "dark"), (1000, "light"), (1600, "dark")])
def test_everybody_can_read_it(shown, width, scheme):
    """Axe finds nothing serious, also with a pose left out and a question asked; its script is its own."""
    axe = pytest.importorskip("axe_playwright_python.sync_playwright").Axe()
    with serving(StubSession(poses=12, places=9)) as address:
        page = shown(address, width, scheme, bypass_csp=True)
        for key, there in (("", "#poses tr"), ("x", "#poses tr.excluded"), ("s", "dialog[open]")):
            if key:
                page.keyboard.press(key)
            page.wait_for_selector(there)
            found = [rule for rule in axe.run(page).response["violations"] if rule["impact"] in ("serious", "critical")]
            assert [(rule["id"], rule["nodes"][0]["html"]) for rule in found] == []


def test_a_click_opens_the_report_in_a_tab_without_an_origin(shown, tmp_path):
    session = StubSession(poses=3)
    with serving(session) as address:
        page = shown(address)
        assert not page.is_visible("#report")
        session.written = tmp_path / "capture-report.html"
        session.written.write_text("<title>A report</title><p id=p>no</p><script>p.textContent = origin</script>")
        session.finish(calibrate=True)
        with page.context.expect_page() as opened:
            page.click("#report")
        report = opened.value
        report.wait_for_function("document.title === 'A report'")
        assert report.text_content("#p") == "null"
        assert page.said == []


def test_what_a_device_says_is_text(shown):
    session = StubSession(poses=2, text=MARKUP)
    with serving(session) as address:
        page = shown(address, 400)
        page.keyboard.press("f")
        page.click("text=Write only")
        page.wait_for_selector("#sentences:has-text('<img src=x')")
        assert page.locator("img").count() == 0
        assert "caught" not in page.title()
        assert page.evaluate("document.documentElement.scrollWidth") <= 400
        assert page.said == []


@pytest.mark.slow
def test_a_reloaded_page_and_a_second_one_show_the_same(shown):
    session = StubSession(poses=5)
    with serving(session) as address:
        one, other = shown(address), shown(address, 400)
        one.keyboard.press(" ")
        for page in (one, other):
            page.wait_for_function(ROWS, arg=6)
        one.reload()
        one.wait_for_selector("body[data-ready=yes]")
        assert one.inner_text("#poses") == other.inner_text("#poses")
        assert one.inner_text("#u-now") == other.inner_text("#u-now")


@pytest.mark.slow
def test_a_page_without_the_token_shows_nothing_and_one_whose_session_ended_says_so(shown):
    session = StubSession(poses=5)
    with serving(session, token="the-token-of-a-test") as address:
        port = int(address.partition("/#")[0].rpartition(":")[2])
        stranger = shown(address.partition("#")[0], ready=False)
        stranger.wait_for_selector("#connection:has-text('token is missing')")
        stranger.keyboard.press(" ")
        stranger.wait_for_selector("#message:has-text('token is missing')")
        assert stranger.inner_text("#poses") == ""
        assert session.asked == []
        page = shown(address)
    page.wait_for_selector("body.lost")
    page.wait_for_selector("#connection:has-text('No connection')")
    page.keyboard.press(" ")
    page.wait_for_selector("#message:has-text('nothing was done')")
    with serving(session, port=port, token="the-token-of-a-test"):
        page.wait_for_selector("body:not(.lost)")
        page.keyboard.press(" ")
        page.wait_for_function(ROWS, arg=6)


FOREIGN = """async ([address, token]) => {
    const results = [], body = '{"action": "take"}', url = `${address}/do`;
    const attempts = [
        { method: "POST", mode: "no-cors", body },
        { method: "POST", body, headers: { "Content-Type": "application/json", "X-Token": token } },
        { method: "POST", mode: "no-cors", body, credentials: "include" },
    ];
    for (const attempt of attempts) {
        results.push(await fetch(url, attempt).then((answer) => answer.type, () => "refused"));
    }
    const state = { headers: { "X-Token": token } };
    results.push(await fetch(`${address}/state`, state).then(() => "read", () => "refused"));
    const frame = document.createElement("iframe");
    frame.src = `${address}/#${token}`;
    document.body.append(frame);
    await new Promise((resolve) => { frame.onload = resolve; setTimeout(resolve, 3000); });
    return results;
}"""


@pytest.mark.slow
def test_a_foreign_page_commands_and_reads_nothing_even_with_the_token(shown):
    session = StubSession()
    with serving(session) as address:
        place, token = address.split("/#")
        foreign = shown("data:text/html,<title>foreign</title><body></body>", ready=False)
        assert foreign.evaluate(FOREIGN, [place, token]) == 4 * ["refused"]
        assert all(frame.url.startswith(("data:", "about:", "chrome-error:")) for frame in foreign.frames)
        assert session.asked == []
