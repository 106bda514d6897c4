"""The files of the pages, which are the same for every vehicle."""

from __future__ import annotations

import mimetypes
from pathlib import Path
from typing import Any

from aiohttp import web

from runner.page.access import Access
from runner.system.files import plotly_script

STATIC = Path(__file__).with_name("static")


class Documents:
    """Serves the files.

    raises  RunError if plotly is not installed
    """

    def __init__(self) -> None:
        self._plotly = plotly_script("page")

    def add_to(self, app: web.Application, access: Access) -> None:
        app.router.add_get("/plotly.js", _file_handler(self._plotly))
        if access.login:
            app.router.add_get("/login", document("login.html"))
            app.router.add_post("/login/challenge", access.on_challenge)
            app.router.add_post("/login", access.on_login)
        for file in STATIC.iterdir():
            app.router.add_get(f"/static/{file.name}", document(file.name))


def document(name: str) -> Any:
    """A handler that serves a small file from memory: a page requests dozens of them when it opens."""
    file = STATIC / name
    body, kind = file.read_bytes(), mimetypes.guess_type(file.name)[0]

    async def serve(_request: web.Request) -> web.Response:
        return web.Response(body=body, content_type=kind or "application/octet-stream")

    return serve


def _file_handler(path: Path) -> Any:
    """A handler that sends a large file from disk."""

    async def send(_request: web.Request) -> web.FileResponse:
        return web.FileResponse(path)

    return send
