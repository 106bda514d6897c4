"""How browsers reach a page: its address, its connections, and who has access."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from aiohttp import web

from runner.page.access import LOOPBACK, Access
from runner.page.connections import MAX_BODY, Connections
from runner.page.login import PageLogin, people_of
from runner.page.tls import PageTls
from runner.security.keyring import Keyring
from runner.settings import Endpoint
from runner.system.reports import LimitedReports


class Front:
    """In the page's thread, except `url`.

    endpoint  where browsers reach the page
    keyring   of the operator, to serve other machines over HTTPS if they log in; None: loopback only
    people    file of others who may log in; None: nobody
    note      called with a message for the operator
    raises    UserError if that file cannot be used
    """

    def __init__(
        self, endpoint: Endpoint, keyring: Keyring | None, people: str | None, note: Callable[[str], None]
    ) -> None:
        self._endpoint = endpoint
        report = LimitedReports(note)  # of what browsers and others on the network can cause
        self.connections = Connections(PageTls(keyring, note) if keyring else None, report)
        self._holder = keyring.watched_holder(note) if keyring else None
        login = PageLogin(people_of(keyring, people, note)) if keyring else None
        self.access = Access(login, lambda: self._names, self.connections, report)

    @property
    def url(self) -> str:
        if self._holder is None:
            return f"http://{self._endpoint}/"
        return f"https://{replace(self._endpoint, host=next(iter(self._names), self._endpoint.host))}/"

    @property
    def _names(self) -> tuple[str, ...]:
        """Addresses and names at which browsers reach the page."""
        return self._holder.get().hosts if self._holder else (*LOOPBACK, self._endpoint.host)

    def application(self, check: Any = None) -> web.Application:
        """Its requests pass this check of access; None: the usual one."""
        middlewares = [self.connections.on_request_complete, self.access.add_headers, check or self.access.check]
        return web.Application(middlewares=middlewares, client_max_size=MAX_BODY)
