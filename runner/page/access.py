"""Who may use the page: its own documents only, and from other machines only after login."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from ipaddress import ip_address
from typing import Any

from aiohttp import web

from runner.mqtt.messages import read_message
from runner.page.connections import Connections
from runner.page.login import COOKIE, OPERATOR, RELAYED, PageLogin, Visitor
from runner.schema import shortened
from runner.system.reports import LimitedReports

LOOPBACK = ("127.0.0.1", "localhost")  # names of the page without keys
DEFAULT_PORTS = {"http": 80, "https": 443}
# Inline styles: Plotly adds style elements and attributes of its own. Inline scripts stay forbidden.
POLICY = (
    "default-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; worker-src 'self'; "
    "frame-ancestors 'self'; base-uri 'none'; form-action 'self'; object-src 'none'"
)
LOGIN_POLICY = POLICY.replace(" 'unsafe-inline'", "")
HEADERS = {
    "Content-Security-Policy": POLICY,
    "Cache-Control": "no-cache",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
LOGIN_HEADERS = HEADERS | {"Content-Security-Policy": LOGIN_POLICY}
# What a browser needs before login.
UNPROTECTED = (
    "/login",
    "/login/challenge",
    *(f"/static/{name}" for name in ("login.js", "login.css", "style.css")),
)


class Access:
    """In the page's thread.

    login   of other machines; None: this server needs none, since it serves loopback only
    names   returns addresses and names at which browsers reach the page
    report  called with each refusal
    """

    def __init__(
        self,
        login: PageLogin | None,
        names: Callable[[], Iterable[str]],
        connections: Connections,
        report: LimitedReports,
    ) -> None:
        self.login, self._names, self._connections, self._report = login, names, connections, report

    def visitor(self, request: web.Request) -> Visitor | None:
        """Whose request it is; None: this person has no access.

        Without a login everybody here may do everything, except of whom a relay says otherwise.
        """
        if self.login is None:
            relayed = request.headers.get(RELAYED)
            return Visitor.of(relayed) if relayed else OPERATOR
        return self.login.visitor(request.cookies.get(COOKIE), time.monotonic())

    @web.middleware
    async def add_headers(self, request: web.Request, handler: Any) -> web.StreamResponse:
        """Add HEADERS to every response, also to one that is raised."""
        headers = LOGIN_HEADERS if request.path in UNPROTECTED else HEADERS
        try:
            response: web.StreamResponse = await handler(request)
        except web.HTTPException as raised:
            raised.headers.update(headers)
            raise
        if not response.prepared:
            response.headers.update(headers)
        return response

    @web.middleware
    async def check(self, request: web.Request, handler: Any) -> web.StreamResponse:
        """Accept only this server's own pages, under its own name, and from other machines only after login.

        No other site in the same browser may read or send anything, by whatever host name it resolves this server (DNS
        rebinding).
        """
        if foreign := self._foreign(request):
            self._report_refusal(request, foreign)
            raise web.HTTPForbidden(text="accepted only from this server's own pages\n")
        if self.visitor(request) is None:
            if request.path.endswith("/"):  # a page, and none of its parts
                raise web.HTTPSeeOther(f"/login?{request.rel_url.raw_query_string}".rstrip("?"))
            if request.path not in UNPROTECTED:
                self._report_refusal(request, "not logged in")
                raise web.HTTPUnauthorized(text="login required: see /login\n")
        else:
            self._connections.grant(request)
        try:
            response: web.StreamResponse = await handler(request)
        except (web.HTTPNotFound, web.HTTPMethodNotAllowed) as refused:
            self._report_refusal(request, refused.reason.lower())
            raise
        return response

    def _foreign(self, request: web.Request) -> str | None:
        """How a request differs from those of this server's own pages; None if it does not."""
        sockname = request.get_extra_info("sockname") or ("", 0)  # not request.url, which raises for a malformed Host
        scheme, origin = "https" if self.login else "http", request.headers.get("Origin")
        allowed = hosts(self._names(), sockname[1], scheme)
        host = request.headers.get("Host", "")
        if host.lower() not in allowed:
            return f"Host {shortened(repr(host))} is not an address of this page"
        if origin is None:
            return "a POST without Origin" if request.method == "POST" else None
        own = {f"{scheme}://{name}" for name in allowed}
        return None if origin in own else f"Origin {shortened(repr(origin))} is another site"

    def _report_refusal(self, request: web.Request, why: str) -> None:
        path = shortened(repr(request.raw_path.partition("?")[0]))  # what follows may be anything, such as a password
        self._report(f"page: refused {request.method} {path} from {request.remote}: {why}", str(request.remote))

    async def on_challenge(self, _request: web.Request) -> web.Response:
        assert self.login
        return web.json_response({"challenge": self.login.challenge(time.monotonic())})

    async def on_login(self, request: web.Request) -> web.Response:
        assert self.login
        try:
            document = read_message(await self._connections.body(request))
        except ValueError as problem:
            raise web.HTTPBadRequest(text=f"{problem}\n") from None
        challenge, answer = (str(document.get(key, "")) for key in ("challenge", "answer"))
        session = self.login.open(challenge, answer, time.monotonic())
        if session is None:
            self._report_refusal(request, "wrong token")
            raise web.HTTPForbidden(text="wrong token\n")
        response = web.Response(text="logged in\n")
        response.set_cookie(COOKIE, session, secure=True, httponly=True, samesite="Strict")
        return response


def hosts(names: Iterable[str], port: int, scheme: str) -> set[str]:
    """What browsers send as Host: a name in lower case, without the port if it is the scheme's own."""
    known = {_as_in_url(name) for name in names}
    return {f"{name}:{port}" for name in known} | (known if port == DEFAULT_PORTS[scheme] else set())


def _as_in_url(name: str) -> str:
    """An address or name as browsers write it: IPv6 in its shortest form (RFC 5952), in brackets."""
    try:
        address = ip_address(name)
    except ValueError:
        return name.lower()
    return f"[{address}]" if address.version == 6 else str(address)
