"""The server of the page: it shows and obeys only who has the token, and bears what others send."""

import contextlib
import gc
import http.client
import json
import os
import random
import socket
import threading
import time
import webbrowser
from pathlib import Path

import pytest

import aacmm_jax as aj
from aacmm_jax.live import messages, server

from .stub_session import StubSession

psutil = pytest.importorskip("psutil")
TAKE = json.dumps({"action": "take"}).encode()


class Served:
    """A served session, and requests to it as a page would make them unless headers are replaced."""

    def __init__(self, session: StubSession, address: str):
        self.session, (place, self.token) = session, address.removeprefix("http://").split("/#")
        self.host, self.port = place, int(place.rpartition(":")[2])

    def ask(self, method="POST", path="/do", body=TAKE, **headers: str | None) -> tuple[int, bytes]:
        usual = {"Host": self.host, "Origin": f"http://{self.host}", "X-Token": self.token,
                 "Content-Type": "application/json"}  # fmt: skip
        usual |= {name.replace("_", "-"): value for name, value in headers.items()}
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=20)
        with contextlib.closing(connection):
            connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
            for name, value in usual.items():
                if value is not None:
                    connection.putheader(name, value)
            if method == "POST":
                connection.putheader("Content-Length", str(len(body)))
            connection.endheaders(body if method == "POST" else None)
            answer = connection.getresponse()
            return answer.status, answer.read()

    def raw(self) -> socket.socket:
        return socket.create_connection(("127.0.0.1", self.port), timeout=20)


@pytest.fixture
def served():
    session = StubSession()
    with server.serving(session) as address:
        yield Served(session, address)


FOREIGN = {
    "no token": ({"X_Token": None}, 403),
    "wrong token": ({"X_Token": "x" * 32}, 403),
    "token of other letters": ({"X_Token": "\xe9" * 32}, 403),
    "foreign origin": ({"Origin": "http://evil.example"}, 403),
    "origin without a page": ({"Origin": "null"}, 403),
    "origin at another port": ({"Origin": "http://127.0.0.1:1"}, 403),
    "another site": ({"Sec_Fetch_Site": "cross-site"}, 403),
    "another name of this computer": ({"Host": "evil.example", "Origin": "http://evil.example"}, 421),
    "no name": ({"Host": ""}, 421),
}


@pytest.mark.parametrize(("headers", "status"), FOREIGN.values(), ids=FOREIGN)
def test_who_is_not_the_page_sees_and_commands_nothing(served, headers, status):
    for method, path in (("POST", "/do"), ("GET", "/state"), ("GET", "/stream"), ("POST", "/ticket")):
        answered, body = served.ask(method, path, **headers)
        assert answered == status
        assert list(json.loads(body)) == ["message"]
    assert served.session.asked == []


def test_a_ticket_shows_the_report_once_and_gives_it_no_origin(served, tmp_path, monkeypatch):
    assert served.ask("POST", "/ticket")[0] == 404
    served.session.written = tmp_path / "capture-calibration.html"
    served.session.written.write_text("<p>A report</p>")
    addresses = []
    for _ in range(2):
        status, answer = served.ask("POST", "/ticket")
        assert status == 200
        addresses.append("/" + json.loads(answer)["path"])
    for address in addresses:  # a tab sends neither a token nor an origin
        assert served.ask("GET", address, X_Token=None, Origin=None) == (200, b"<p>A report</p>")
        assert served.ask("GET", address)[0] == 403
    for address in ("/report/", "/report/x", "/report/../capture.h5", "/report/" + served.token):
        assert served.ask("GET", address)[0] in (403, 404)
    monkeypatch.setattr(server, "_TICKET", -1.0)
    late = json.loads(served.ask("POST", "/ticket")[1])["path"]
    assert served.ask("GET", f"/{late}")[0] == 403


ODD = {
    "a form": (TAKE, {"Content_Type": "application/x-www-form-urlencoded"}, 415),
    "plain text, which needs no permission": (TAKE, {"Content_Type": "text/plain"}, 415),
    "not JSON": (b"\xff\x00{", {}, 400),
    "deep": (b"[" * 4000, {}, 400),
    "long": (b" " * 5000 + TAKE, {}, 413),
    "a list": (b"[]", {}, 400),
    "unknown": (b'{"action": "close"}', {}, 400),
    "private": (b'{"action": "__init__"}', {}, 400),
    "not a word": (b'{"action": ["take"]}', {}, 400),
    "a field too many": (b'{"action": "take", "path": "/etc/passwd"}', {}, 400),
    "a field too few": (b'{"action": "exclude", "pose": 1}', {}, 400),
    "true is not a pose": (b'{"action": "exclude", "pose": true, "excluded": true}', {}, 400),
    "a large pose": (b'{"action": "exclude", "pose": 1e400, "excluded": true}', {}, 400),
    "a temperature that is not a number": (b'{"action": "temperature", "celsius": NaN}', {}, 400),
    "an infinite temperature": (b'{"action": "temperature", "celsius": -1e999}', {}, 400),
    "a huge whole temperature": (b'{"action": "temperature", "celsius": 1' + b"0" * 3000 + b"}", {}, 400),
    "control characters": (b'{"action": "mark", "text": "\\u001b[2J"}', {}, 400),
    "a long text": (b'{"action": "mark", "text": "' + b"x" * 500 + b'"}', {}, 400),
}


@pytest.mark.parametrize(("body", "headers", "status"), ODD.values(), ids=ODD)
def test_an_odd_message_is_refused_in_a_sentence(served, body, headers, status):
    answered, answer = served.ask(body=body, **headers)
    assert answered == status
    assert set(json.loads(answer)) == {"message"}
    assert len(answer) < 400
    assert served.session.asked == []


@pytest.mark.parametrize(
    "path",
    ["/server.py", "/../server.py", "/%2e%2e/server.py", "//etc/passwd", "/page/../../journal.py", "/page.js/..",
     "/style.css%00", "/static/..\\server.py"],
)  # fmt: skip
def test_no_path_leads_to_other_files(served, path):
    assert served.ask("GET", path)[0] == 404


def test_the_page_is_whole_without_a_token_and_may_load_nothing_else(served):
    for path in ("/", "/page.js", "/view.js", "/style.css"):
        status, content = served.ask("GET", path, X_Token=None, Origin=None)
        assert status == 200
        assert b"http://" not in content
        assert b"https://" not in content
        assert b"innerHTML" not in content
    connection = http.client.HTTPConnection("127.0.0.1", served.port)
    with contextlib.closing(connection):
        connection.request("GET", "/")
        head = connection.getresponse().headers
    assert "default-src 'none'" in head["Content-Security-Policy"]
    assert "unsafe" not in head["Content-Security-Policy"]
    assert "Access-Control-Allow-Origin" not in head


ACTIONS = {
    "take": {}, "undo": {}, "skip": {}, "exclude": {"pose": 1, "excluded": True},
    "mark": {"text": "probe remounted, 20 °C"},
    "temperature": {"celsius": 21.5}, "auto": {"on": False}, "place": {"name": "B"}, "finish": {"calibrate": False},
}  # fmt: skip


def test_every_action_reaches_the_session_as_it_was_sent(served):
    served.ask()
    served.session.asked.clear()
    for action, fields in ACTIONS.items():
        if action == "exclude":
            served.session.take()
            served.session.asked.clear()
        assert served.ask(body=json.dumps({"action": action, **fields}).encode()) == (200, b"{}")
        assert served.session.asked.pop() == (action, fields)
    assert set(ACTIONS) == set(messages._ACTIONS)


def test_what_the_session_refuses_or_fails_at_is_said_and_nothing_ends(served, monkeypatch, caplog):
    assert served.ask(body=b'{"action": "undo"}') == (400, b'{"message":"there is no pose to undo"}')
    status, body = served.ask(body=b'{"action": "exclude", "pose": 7, "excluded": true}')
    assert (status, json.loads(body)["message"]) == (500, "It failed: IndexError.")
    assert served.ask()[0] == 200


def test_too_many_actions_in_a_second_are_refused(served):
    answers = [served.ask()[0] for _ in range(int(messages._BURST) + 60)]
    assert 429 in answers
    assert len(served.session.asked) == answers.count(200)


def read_lines(served: Served, until, seconds=10.0) -> list[dict]:
    """Lines of the stream until one fulfils a condition."""
    connection = http.client.HTTPConnection("127.0.0.1", served.port, timeout=seconds)
    lines = []
    with contextlib.closing(connection):
        connection.request("GET", "/stream", headers={"X-Token": served.token})
        answer = connection.getresponse()
        assert answer.status == 200
        while not lines or not until(lines[-1]):
            lines.append(json.loads(answer.readline()))
        answer.close()
    return lines


def test_two_pages_hear_of_what_one_does(served):
    served.session.poses = []
    heard: list[list[dict]] = []

    def read() -> None:
        heard.append(read_lines(served, lambda line: line.get("poses")))

    readers = [threading.Thread(target=read) for _ in range(2)]
    for reader in readers:
        reader.start()
    time.sleep(0.4)
    served.ask()
    for reader in readers:
        reader.join(20)
    for lines in heard:
        assert "poses" in lines[0]
        assert lines[-1]["poses"][0]["number"] == 1
        assert all("poses" not in line for line in lines[1:-1])  # what has not changed is not sent again
        assert len(lines) > 3


def test_a_number_that_is_not_finite_is_null(served, monkeypatch):
    monkeypatch.setattr(served.session, "state", lambda since=None: {"u": float("nan"), "q": [float("inf"), 1.5]})
    assert json.loads(served.ask("GET", "/state")[1]) == {"u": None, "q": [None, 1.5]}


def test_pages_beyond_a_limit_are_refused_and_those_that_close_make_room(served):
    open_, request = [], f"GET /stream HTTP/1.1\r\nHost: {served.host}\r\nX-Token: {served.token}\r\n\r\n".encode()
    for _ in range(server._STREAMS):
        open_.append(served.raw())
        open_[-1].sendall(request)
        assert open_[-1].recv(20).startswith(b"HTTP/1.1 200")
    assert served.ask("GET", "/stream")[0] == 503
    for one in open_:
        one.close()
    ended = time.monotonic() + 20
    while time.monotonic() < ended:
        with served.raw() as again:
            again.sendall(request)
            if again.recv(20).startswith(b"HTTP/1.1 200"):
                break
    else:
        pytest.fail("no room for a page after others have closed")


def test_connections_beyond_a_limit_are_closed_at_once(served):
    with contextlib.ExitStack() as stack:
        for _ in range(server._CONNECTIONS):
            stack.enter_context(served.raw())
        time.sleep(0.2)  # until the server has taken all of them
        for _ in range(5):
            with served.raw() as beyond:
                beyond.settimeout(0.5 * server._IDLE)
                assert beyond.recv(10) == b""
    time.sleep(0.2)
    assert served.ask()[0] == 200


def test_silent_connections_are_closed_and_keep_nobody_out(monkeypatch):
    monkeypatch.setattr(server, "_IDLE", 0.5)
    with server.serving(session := StubSession()) as address:
        served = Served(session, address)
        with contextlib.ExitStack() as stack:
            silent = [stack.enter_context(served.raw()) for _ in range(2 * server._CONNECTIONS)]
            for one in silent[::2]:
                with contextlib.suppress(OSError):
                    one.sendall(b"GET / HTTP/1.1\r\nX: ")  # a head that does not end
            for one in silent:
                with contextlib.suppress(ConnectionError):
                    while one.recv(1000):
                        pass
            assert served.ask()[0] == 200
            # A body that does not end either.
            slow = stack.enter_context(served.raw())
            head = f"POST /do HTTP/1.1\r\nHost: {served.host}\r\nX-Token: {served.token}\r\n"
            slow.sendall(head.encode() + b"Content-Type: application/json\r\nContent-Length: 99\r\n\r\n{")
            assert slow.recv(30).startswith(b"HTTP/1.1 408")


def hostile(rng: random.Random) -> tuple[bytes, dict[str, str | None]]:
    """A message of somebody who has the token, or has not, with something wrong in it."""
    fields = {"action": rng.choice([*ACTIONS, "close", "state", "__class__", ""])}
    for _ in range(rng.randrange(4)):
        value = rng.choice([-1, 2**70, 1e308, True, None, "../../etc/passwd", "<img src=x onerror=alert(1)>", "\x1b[2J",
                            "x" * 1000, [], {}, [[1]]])  # fmt: skip
        fields[rng.choice(["pose", "text", "name", "path", "celsius", "on", "calibrate", "excluded"])] = value
    body = json.dumps(fields).encode()
    if rng.random() < 0.4:
        at = rng.randrange(len(body))
        body = body[:at] + rng.randbytes(rng.randrange(1, 40)) + body[at + rng.randrange(5) :]
    headers = rng.choice([{}, {}, {}, {"X_Token": rng.randbytes(20).hex()}, {"Origin": "http://evil.example"},
                          {"Content_Type": "text/html"}, {"Host": "localhost:1"}])  # fmt: skip
    return body, headers


@pytest.mark.slow
@pytest.mark.parametrize("count", [200, pytest.param(10_000, marks=pytest.mark.exhaustive)])
def test_hostile_messages_are_not_obeyed_and_leave_nothing(served, monkeypatch, count):
    monkeypatch.setattr(messages, "_A_SECOND", 1e9)  # or most would be refused for their number alone
    monkeypatch.setattr(messages, "_BURST", 1e9)
    rng, size = random.Random(0), []
    for number in range(count):
        body, headers = hostile(rng)
        if number % 20 == 19:  # not even HTTP
            with served.raw() as connection, contextlib.suppress(OSError):
                connection.sendall(rng.randbytes(rng.choice([10, 1000, 100_000])))
            continue
        before = len(served.session.asked)
        status, answer = served.ask(body=body, **headers)
        if len(served.session.asked) == before:
            assert status in (400, 403, 413, 415, 421)
            assert len(answer) < 400
        else:  # it happened to be a right one
            assert not headers
            action, given = served.session.asked[-1]
            assert {key: type(value) for key, value in given.items()} == messages._ACTIONS[action]
            assert all(value.isprintable() and len(value) <= 200 for value in given.values() if type(value) is str)
        served.session.asked.clear()
        if number in (count // 5, count - 2):
            gc.collect()  # what waits to be collected is not kept
            size.append(psutil.Process().memory_info().rss / 1e6)
    assert served.ask()[0] == 200
    assert served.ask("GET", "/state")[0] == 200
    if count > 1000:
        assert size[1] - size[0] < 4.0, size  # MB


def test_other_computers_need_a_token_and_a_port_must_be_free(served):
    for words, arguments in {
        "give a token": {"host": "0.0.0.0"},
        "can be reached by others": {"host": "example"},
        "at least 16": {"token": "short"},
        "letters, digits": {"token": "<script>" * 4},
        "choose another": {"port": served.port},
    }.items():
        with pytest.raises(aj.InputError, match=words), server.serving(served.session, **arguments):
            pass
    with server.serving(served.session, host="0.0.0.0", token="a-long-enough-token") as address:
        assert address.endswith("/#a-long-enough-token")


def test_the_browser_is_opened_without_showing_the_token_to_other_users(monkeypatch):
    shown = []
    monkeypatch.setattr(webbrowser, "open", lambda address: shown.append(address) or True)
    with server.opened("http://127.0.0.1:1/#secret") as there:
        path = Path(shown[0].removeprefix("file://"))
        assert there
        assert "secret" not in shown[0]
        assert "secret" in path.read_text()
        assert os.name != "posix" or path.stat().st_mode & 0o077 == 0
    assert not path.exists()
