"""The page of a live session and its server: loopback only unless a token is given, and nothing obeyed without one.

Starlette and Uvicorn, since they are small, kept, and written in Python. State comes as a response that does not end,
one JSON object a line, which a page reads with the token in a header; a WebSocket or an event source could not carry
that header.
"""

import asyncio
import contextlib
import hmac
import ipaddress
import json
import logging
import math
import os
import re
import secrets
import socket
import tempfile
import threading
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from ..core.errors import InputError, require

_FILES = {
    "/": ("index.html", "text/html"),
    "/page.js": ("page.js", "text/javascript"),
    "/view.js": ("../../plot/view.js", "text/javascript"),
    "/style.css": ("style.css", "text/css"),
}
# What the page may ask for, with its fields; each is a method of the session.
_ACTIONS: dict[str, dict[str, type]] = {
    "take": {},
    "undo": {},
    "skip": {},
    "exclude": {"pose": int, "excluded": bool},
    "mark": {"text": str},
    "temperature": {"celsius": float},
    "auto": {"on": bool},
    "place": {"name": str},
    "finish": {"calibrate": bool},
}
_KINDS = {
    int: "number of a pose",
    float: "usable number",
    str: "text of at most 200 printable characters",
    bool: "choice of true or false",
}
_USABLE: dict[type, Callable[[Any], bool]] = {
    int: lambda value: 0 <= value < 2**31,
    float: lambda value: abs(value) < 2**31,
    str: lambda value: len(value) <= 200 and value.isprintable(),
    bool: lambda value: True,
}
_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
    "img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cache-Control": "no-store",
}
_FRAME, _SILENCE = 1 / 30, 1.0  # s: between two looks at the session; after which a line comes in any case
_BODY, _HEAD = 4096, 16_384  # bytes of a request, and of its head
_A_SECOND, _BURST = 20.0, 40.0  # actions
_CONNECTIONS, _STREAMS, _IDLE = 128, 24, 15.0  # at once; s without a request after which a connection is closed
_SHORTEST_TOKEN = 16  # characters: guessing at 10,000 a second takes longer than a session


@runtime_checkable
class LiveSession(Protocol):
    """What the server needs of a session, besides a method for each action."""

    def state(self, since: int | None = None) -> dict[str, Any]:
        """Everything, or what changes all the time where nothing else has changed since a version."""
        ...


@contextlib.contextmanager
def serving(session: LiveSession, *, host: str = "127.0.0.1", port: int = 0, token: str | None = None) -> Iterator[str]:
    """Serve the page of a session in a thread, until the block ends.

    Args:
        session: What is shown and commanded.
        host: Address to listen at. Any but a loopback address needs a ``token``, and is not encrypted.
        port: Port, 0 for a free one.
        token: Secret of at least 16 characters, without which nothing is shown or obeyed. Default: a random one.

    Yields:
        The address of the page, which ends with ``#`` and the token; a browser does not send that part.

    Raises:
        InputError: The extra ``live`` is missing, the token is too short or missing, or the address is in use.

    Example:
        >>> arm, noise = (load("panda") for load in (aj.files.load_specification, aj.files.load_noise))
        >>> setup = aj.live.setup_of(arm, noise, [aj.data.observations.SimulatedSocket("A", (400, 0, 300), 5)])
        >>> with (
        ...     aj.live.Session(setup, ["simulated:?seed=1"], path="served.h5") as session,
        ...     aj.live.serving(session, token="a-token-of-my-own") as address,
        ... ):
        ...     print(address.partition("#")[2])
        a-token-of-my-own
    """
    require("live", "The page of a live session")
    import uvicorn

    _check(host, token)
    secret = token or secrets.token_urlsafe(24)
    listening = _listening(host, port)
    port = listening.getsockname()[1]
    name = f"[{host}]" if ":" in host else host
    hosts = {f"{known}:{port}" for known in ("127.0.0.1", "localhost", "[::1]", name)} if _is_loopback(host) else None
    config = uvicorn.Config(
        application(session, secret, hosts),
        http=_protocol(),
        ws="none",
        lifespan="off",
        log_level="critical",
        access_log=False,
        server_header=False,
        date_header=False,
        proxy_headers=False,
        h11_max_incomplete_event_size=_HEAD,
        timeout_graceful_shutdown=1,
    )
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, args=([listening],), name="live page", daemon=True)
    thread.start()
    while not server.started and thread.is_alive():
        time.sleep(0.01)
    try:
        local = {"0.0.0.0": "127.0.0.1", "[::]": "[::1]"}.get(name, name)
        yield f"http://{local}:{port}/#{secret}"
    finally:
        server.should_exit = True
        thread.join(5.0)
        listening.close()


@contextlib.contextmanager
def opened(address: str) -> Iterator[bool]:
    """Open a page in the browser, without its token among the arguments of a process, which other users can read.

    Args:
        address: Of `serving`.

    Yields:
        Whether there is a browser.
    """
    import webbrowser

    handle, path = tempfile.mkstemp(".html", "aacmm-live-")  # readable by its owner alone
    try:
        with os.fdopen(handle, "w") as file:
            file.write(f'<!doctype html><meta http-equiv="refresh" content="0;url={address}"><title>Live</title>')
        yield webbrowser.open(Path(path).as_uri())
    finally:
        os.unlink(path)


def application(session: LiveSession, token: str, hosts: set[str] | None) -> Callable[..., Awaitable[None]]:
    """The ASGI application of a session.

    Args:
        session: What is shown and commanded.
        token: Without it in the header ``X-Token``, nothing is shown or obeyed.
        hosts: Names by which the server may be called, each with its port; None for any.
    """
    from starlette.applications import Starlette
    from starlette.concurrency import run_in_threadpool
    from starlette.requests import Request
    from starlette.responses import JSONResponse, Response, StreamingResponse
    from starlette.routing import Route

    allowance, streams = _Allowance(), 0

    def refused(status: int, message: str) -> Response:
        return JSONResponse({"message": message}, status)

    def guarded(answer: Callable[[Request], Awaitable[Response]]) -> Callable[[Request], Awaitable[Response]]:
        async def checked(request: Request) -> Response:
            head = request.headers
            if head.get("origin", f"http://{head.get('host')}") != f"http://{head.get('host')}":
                return refused(403, "The request comes from another page.")
            if head.get("sec-fetch-site", "same-origin") not in ("same-origin", "none"):
                return refused(403, "The request comes from another page.")
            if not hmac.compare_digest(head.get("x-token", "").encode(), token.encode()):
                return refused(403, "The token is missing or wrong; open the address that the terminal shows.")
            return await answer(request)

        return checked

    async def state(request: Request) -> Response:
        return Response(_json(await run_in_threadpool(session.state)), media_type="application/json")

    async def stream(request: Request) -> Response:
        if streams >= _STREAMS:
            return refused(503, "Too many pages are open; close some.")
        return StreamingResponse(lines(), media_type="application/x-ndjson")

    async def lines() -> AsyncIterator[bytes]:
        nonlocal streams
        streams += 1
        try:
            version, last, sent, due = None, b"", 0.0, time.monotonic()
            while True:
                now = await run_in_threadpool(session.state, version)
                version, line = now.get("version"), _json(now) + b"\n"
                if line != last or time.monotonic() - sent > _SILENCE:
                    yield line
                    last, sent = line, time.monotonic()
                due = max(due + _FRAME, time.monotonic())
                await asyncio.sleep(due - time.monotonic())
        finally:
            streams -= 1

    async def do(request: Request) -> Response:
        if request.headers.get("content-type") != "application/json":
            return refused(415, "An action is JSON.")
        if not allowance.take():
            return refused(429, "Too many actions in a second.")
        body = b""
        try:
            async with asyncio.timeout(_IDLE):
                async for part in request.stream():
                    body += part
                    if len(body) > _BODY:
                        return refused(413, f"An action has at most {_BODY} bytes.")
        except TimeoutError:
            return refused(408, "The request did not end.")
        try:
            action, fields = _action(body)
            await run_in_threadpool(getattr(session, action), **fields)
        except InputError as error:
            return refused(400, str(error))
        except Exception as error:  # the page says it, and the session goes on
            logging.getLogger(__name__).exception("an action of the page failed")
            return refused(500, f"It failed: {type(error).__name__}.")
        return JSONResponse({})

    async def static(request: Request) -> Response:
        content, kind = files[request.url.path]
        return Response(content, media_type=kind)

    folder = Path(__file__).parent / "page"
    files = {path: ((folder / name).read_bytes(), kind) for path, (name, kind) in _FILES.items()}
    routes = [Route(path, static) for path in files]
    routes += [Route("/state", guarded(state)), Route("/stream", guarded(stream))]
    routes += [Route("/do", guarded(do), methods=["POST"])]
    app = Starlette(routes=routes)

    async def called_by_name(scope: Any, receive: Any, send: Any) -> None:
        async def with_headers(message: Any) -> None:
            if message["type"] == "http.response.start":
                message["headers"] += [(key.lower().encode(), value.encode()) for key, value in _HEADERS.items()]
            await send(message)

        host = dict(scope["headers"]).get(b"host", b"").decode("latin-1").lower()
        known = hosts is None or host in hosts
        answer = app if known else refused(421, "This server is not called by that name.")
        await answer(scope, receive, with_headers)

    return called_by_name


class _Allowance:
    """Actions that may still be done: so many a second, and some saved up."""

    def __init__(self) -> None:
        self.left, self.at = _BURST, time.monotonic()

    def take(self) -> bool:
        now = time.monotonic()
        self.left, self.at = min(_BURST, self.left + (now - self.at) * _A_SECOND), now
        if self.left < 1:
            return False
        self.left -= 1
        return True


def _action(body: bytes) -> tuple[str, dict[str, Any]]:
    """Name and fields of an action; everything that is not in the table is refused."""
    try:
        given = json.loads(body)
    except (ValueError, RecursionError):
        raise InputError("an action must be JSON") from None
    name = str(given.get("action")) if isinstance(given, dict) else ""
    if (wanted := _ACTIONS.get(name)) is None:
        raise InputError(f"an action must be one of {', '.join(_ACTIONS)}")
    fields = {key: value for key, value in given.items() if key != "action"}
    if fields.keys() != wanted.keys():
        raise InputError(f"{name} takes {', '.join(wanted) or 'no fields'}")
    for key, kind in wanted.items():
        if kind is float and type(fields[key]) is int:
            fields[key] = float(min(fields[key], 2**31))
        if type(fields[key]) is not kind or not _USABLE[kind](fields[key]):
            raise InputError(f"{key} of {name} is not a {_KINDS[kind]}")
    return name, fields


def _json(state: Any) -> bytes:
    """JSON, in which a number that is not finite is null: a browser reads no other."""

    def finite(value: Any) -> Any:
        if isinstance(value, float):
            return value if math.isfinite(value) else None
        if isinstance(value, dict):
            return {key: finite(item) for key, item in value.items()}
        return [finite(item) for item in value] if isinstance(value, list | tuple) else value

    try:
        text = json.dumps(state, allow_nan=False, separators=(",", ":"))
    except ValueError:
        text = json.dumps(finite(state), allow_nan=False, separators=(",", ":"))
    return text.encode()


def _protocol() -> type:
    """Uvicorn's HTTP, with a limit of connections, and of the time that one stays without a request."""
    from uvicorn.protocols.http.h11_impl import H11Protocol

    class Limited(H11Protocol):
        def connection_made(self, transport: Any) -> None:
            super().connection_made(transport)
            if len(self.connections) > _CONNECTIONS:
                transport.close()
            self._idle = self.loop.call_later(_IDLE, self.close_if_idle)

        def connection_lost(self, exc: Exception | None) -> None:
            self._idle.cancel()  # it would keep what was received until then
            super().connection_lost(exc)

        def close_if_idle(self) -> None:
            if self.transport.is_closing():
                return
            if self.cycle is None or self.cycle.response_complete:
                self.transport.close()
            else:
                self._idle = self.loop.call_later(_IDLE, self.close_if_idle)

    return Limited


def _is_loopback(host: str) -> bool:
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _check(host: str, token: str | None) -> None:
    if token is None and not _is_loopback(host):
        raise InputError(f"{host} can be reached by others; give a token of at least {_SHORTEST_TOKEN} characters")
    if token is not None and not re.fullmatch(rf"[A-Za-z0-9_-]{{{_SHORTEST_TOKEN},200}}", token):
        raise InputError(f"the token must have at least {_SHORTEST_TOKEN} letters, digits, - or _")


def _listening(host: str, port: int) -> socket.socket:
    listening = None
    try:
        family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listening = socket.socket(family, kind)
        if os.name == "posix":
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind(address)
    except (OSError, OverflowError) as error:
        if listening is not None:
            listening.close()
        raise InputError(f"cannot listen at {host}, port {port} ({error}); choose another --port") from None
    return listening
