"""The page of a live session and its server: loopback only unless a token is given, and nothing obeyed without one.

Starlette and Uvicorn, since they are small, kept, and written in Python. State comes as a response that does not end,
one JSON object a line, which a page reads with the token in a header; a WebSocket or an event source could not carry
that header.
"""

import asyncio
import contextlib
import hmac
import ipaddress
import logging
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
from .messages import Allowance, action_of, as_json

_FILES = {
    "/": ("index.html", "text/html"),
    "/page.js": ("page.js", "text/javascript"),
    "/view.js": ("../../plot/view.js", "text/javascript"),
    "/style.css": ("style.css", "text/css"),
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
# A report has its own scripts and styles, and no part in the page: it runs without an origin.
_OF_REPORT = {
    "Content-Security-Policy": "sandbox allow-scripts allow-downloads allow-modals; default-src 'none'; "
    "script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:; font-src data:",
    "Cross-Origin-Opener-Policy": "unsafe-none",  # with another one a browser shows nothing that runs without an origin
}
_TICKET = 60.0  # s for which the address of a report holds, once
_FRAME, _SILENCE = 1 / 30, 1.0  # s: between two looks at the session; after which a line comes in any case
_BODY, _HEAD = 4096, 16_384  # bytes of a request, and of its head
_CONNECTIONS, _STREAMS, _IDLE = 128, 24, 15.0  # at once; s without a request after which a connection is closed
_SHORTEST_TOKEN = 16  # characters: guessing at 10,000 a second takes longer than a session


@runtime_checkable
class LiveSession(Protocol):
    """What the server needs of a session, besides a method for each action."""

    def state(self, since: int | None = None) -> dict[str, Any]:
        """Everything, or what changes all the time where nothing else has changed since a version."""
        ...

    def report(self) -> Path | None:
        """The report to be shown, if there is one."""
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

    allowance, streams, tickets = Allowance(), 0, dict[str, float]()  # until when each ticket holds

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
        return Response(as_json(await run_in_threadpool(session.state)), media_type="application/json")

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
                version, line = now.get("version"), as_json(now) + b"\n"
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
            action, fields = action_of(body)
            await run_in_threadpool(getattr(session, action), **fields)
        except InputError as error:
            return refused(400, str(error))
        except Exception as error:  # the page says it, and the session goes on
            logging.getLogger(__name__).exception("an action of the page failed")
            return refused(500, f"It failed: {type(error).__name__}.")
        return JSONResponse({})

    async def ticket(request: Request) -> Response:
        """An address for a new tab, which sends no header: it holds once."""
        if not allowance.take():
            return refused(429, "Too many actions in a second.")
        if session.report() is None:
            return refused(404, "There is no report yet; finish, and calibrate.")
        for name in [name for name, until in tickets.items() if until < time.monotonic()]:
            del tickets[name]
        tickets[name := secrets.token_urlsafe(24)] = time.monotonic() + _TICKET
        return JSONResponse({"path": f"report/{name}"})

    async def report(request: Request) -> Response:
        path = session.report()
        if tickets.pop(request.path_params["ticket"], 0.0) < time.monotonic() or path is None:
            return refused(403, "This address of the report holds no more; open it from the page again.")
        return Response(await run_in_threadpool(path.read_bytes), media_type="text/html", headers=_OF_REPORT)

    async def static(request: Request) -> Response:
        content, kind = files[request.url.path]
        return Response(content, media_type=kind)

    folder = Path(__file__).parent / "page"
    files = {path: ((folder / name).read_bytes(), kind) for path, (name, kind) in _FILES.items()}
    routes = [Route(path, static) for path in files]
    routes += [Route("/state", guarded(state)), Route("/stream", guarded(stream))]
    routes += [Route("/do", guarded(do), methods=["POST"]), Route("/ticket", guarded(ticket), methods=["POST"])]
    routes += [Route("/report/{ticket}", report)]
    app = Starlette(routes=routes)

    async def called_by_name(scope: Any, receive: Any, send: Any) -> None:
        async def with_headers(message: Any) -> None:
            if message["type"] == "http.response.start":
                own = {key for key, _ in message["headers"]}
                usual = ((key.lower().encode(), value.encode()) for key, value in _HEADERS.items())
                message["headers"] += [(key, value) for key, value in usual if key not in own]
            await send(message)

        host = dict(scope["headers"]).get(b"host", b"").decode("latin-1").lower()
        known = hosts is None or host in hosts
        answer = app if known else refused(421, "This server is not called by that name.")
        await answer(scope, receive, with_headers)

    return called_by_name


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
