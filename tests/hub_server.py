# SPDX-License-Identifier: Apache-2.0
"""A small Hub on 127.0.0.1 for the real `huggingface_hub`, over real HTTP: it serves repositories and takes uploads.

    with HubServer() as hub:
        hub.add("dataset", "user/data", folder, tags=["v3.0"])
        hub.users["a token"] = "user"
        subprocess.run([...], env=hub.environment(tmp_path, token="a token"))

What clients asked for is in `requests`. A request is answered by a function of `hub_reads` or `hub_uploads`. Only files of
the older kind of large file storage can be uploaded, not those of Xet.
"""

from __future__ import annotations

import json
import os
import re
import threading
from collections.abc import Iterable
from dataclasses import dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, Self
from urllib.parse import parse_qs, unquote, urlsplit

from hub_reads import READS
from hub_repository import Answer, Asked, HubError, Repository, RepoType
from hub_uploads import UPLOADS


@dataclass
class Interruption:
    """An upload that does not arrive. It counts down by itself.

    Args:
        path: A part of the path of the requests that it hits, after their method: ``PUT /storage/``.
        n_bytes: How much of the request's body still arrives; None for all, and the request is done but not answered.
        n_times: How many requests it hits.
        is_silent: Whether the connection stays open, without an answer, instead of being closed.
    """

    path: str
    n_bytes: int | None = 100
    n_times: int = 1000
    is_silent: bool = False


@dataclass(frozen=True)
class Request:
    """What a client asked for, and the status of the answer."""

    method: str
    path: str
    status: int


class HubServer:
    """A Hub that runs as long as its context."""

    def __init__(self) -> None:
        self.repositories: dict[tuple[str, str], Repository] = {}
        self.users: dict[str, str] = {}  # by token
        self.only_reads: set[str] = set()  # tokens that allow no writing
        self.large_files: dict[str, bytes] = {}  # by SHA-256: uploads, whether a commit refers to them or not
        self.broken: set[str] = set()  # repositories at whose mention the connection breaks
        self.cuts: dict[str, int] = {}  # downloads still to be cut in the middle, by the end of the path
        self.interruptions: list[Interruption] = []
        self.closing = threading.Event()
        self.requests: list[Request] = []
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), _handler_for(self))
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.05,), daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.closing.set()
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self._server.server_port}"

    def add(
        self,
        repo_type: RepoType,
        repo_id: str,
        folder: Path,
        *,
        branch: str = "main",
        tags: Iterable[str] = (),
        private: bool = False,
    ) -> str:
        """Commits a folder, as it is now, to a repository, which appears if need be; returns the commit's hash."""
        files = {
            path.relative_to(folder).as_posix(): path.read_bytes()
            for path in folder.rglob("*")
            if path.is_file()
        }
        repository = self.repositories.setdefault((repo_type, repo_id), Repository(private))
        return repository.commit(files, branch, tags)

    def environment(self, home: Path, token: str | None = None) -> dict[str, str]:
        """The environment of a process whose Hub is this one and whose caches lie below `home`."""
        others = {
            name: value for name, value in os.environ.items() if not name.startswith(("HF_", "HUGGING"))
        }
        return {
            **others,
            **({} if token is None else {"HF_TOKEN": token}),
            "HF_ENDPOINT": self.url,
            "HF_HOME": str(home),
            "HF_HUB_OFFLINE": "0",
            "HF_HUB_DISABLE_XET": "1",
            "HF_HUB_DISABLE_TELEMETRY": "1",
            "NO_PROXY": "127.0.0.1",
            "no_proxy": "127.0.0.1",
        }

    def interruption(self, request: str) -> Interruption | None:
        """What interrupts this request, for example ``PUT /storage/...``; counts it."""
        for interruption in self.interruptions:
            if interruption.path in request and interruption.n_times:
                interruption.n_times -= 1
                return interruption
        return None

    def is_cut(self, path: str) -> bool:
        """Whether the download of this path breaks off in the middle; counts it."""
        for end, n_left in self.cuts.items():
            if path.endswith(end) and n_left:
                self.cuts[end] -= 1
                return True
        return False


def _handler_for(hub: HubServer) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            self._answer("GET")

        def do_HEAD(self) -> None:
            self._answer("HEAD")

        def do_POST(self) -> None:
            self._answer("POST")

        def do_PUT(self) -> None:
            self._answer("PUT")

        def do_DELETE(self) -> None:
            self._answer("DELETE")

        def log_message(self, *_: Any) -> None:
            """Says nothing: `HubServer.requests` keeps what was asked for."""

        def _answer(self, method: str) -> None:
            interruption = hub.interruption(f"{method} {self.path}")
            if interruption is not None:
                if interruption.n_bytes is None:
                    self._find(method, self._read_body())
                else:
                    self.rfile.read(min(interruption.n_bytes, int(self.headers.get("Content-Length") or 0)))
                if interruption.is_silent:
                    hub.closing.wait()
                self.close_connection = True
                return
            body = self._read_body()
            if any(repo_id in self.path for repo_id in hub.broken):
                self.close_connection = True
                return
            status = HTTPStatus.OK
            try:
                answer = self._find("GET" if method == "HEAD" else method, body)
            except HubError as error:
                status = error.status
                said = {"X-Error-Message": str(error)}
                if error.code is not None:
                    said["X-Error-Code"] = error.code
                answer = Answer(json.dumps({"error": str(error), **error.more}).encode(), said)
            hub.requests.append(Request(method, self.path, status))
            self.send_response(status)
            for name, value in {**answer.headers, "Content-Length": str(len(answer.content))}.items():
                self.send_header(name, value)
            self.end_headers()
            if method == "GET" and hub.is_cut(unquote(urlsplit(self.path).path)):
                self.wfile.write(answer.content[: len(answer.content) // 2])
                self.close_connection = True
            elif method != "HEAD":
                self.wfile.write(answer.content)

        def _read_body(self) -> bytes:
            if self.headers.get("Transfer-Encoding") != "chunked":
                return self.rfile.read(int(self.headers.get("Content-Length") or 0))
            chunks = []
            while size := int(self.rfile.readline(), 16):
                chunks.append(self.rfile.read(size))
                self.rfile.readline()
            self.rfile.readline()
            return b"".join(chunks)

        def _find(self, method: str, body: bytes) -> Answer:
            url = urlsplit(self.path)
            for wanted, pattern, handle in READS + UPLOADS:
                match = re.fullmatch(pattern, url.path)
                if match and method == wanted:
                    parts = {name: unquote(part) for name, part in match.groupdict(default="").items()}
                    return handle(Asked(hub, parts, parse_qs(url.query), self.headers, body))
            raise HubError(
                "NotImplemented", f"this Hub knows no {method} {url.path}", HTTPStatus.NOT_IMPLEMENTED
            )

    return Handler
