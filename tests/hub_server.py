# SPDX-License-Identifier: Apache-2.0
"""A small Hub on 127.0.0.1 that serves local folders to the real `huggingface_hub`, over real HTTP.

    with HubServer() as hub:
        hub.add("dataset", "user/data", folder, tags=["v3.0"])
        subprocess.run([...], env=hub.environment(tmp_path))

What clients asked for is in `requests`. The Hub is read-only so far. An upload would be handlers with lines of their own
in `ROUTES`, which find what was sent in `Asked.body` and end in `Repository.commit`, as `HubServer.add` does; a token
would be checked in `Asked.repository`, from the headers.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import threading
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, Literal, Self
from urllib.parse import parse_qs, unquote, urlsplit

RepoType = Literal["model", "dataset"]


@dataclass(frozen=True)
class Request:
    """What a client asked for, and the status of the answer."""

    method: str
    path: str
    status: int


class HubError(Exception):
    """An answer other than success, with the code by which `huggingface_hub` tells what is missing."""

    def __init__(self, code: str, message: str, status: HTTPStatus = HTTPStatus.NOT_FOUND) -> None:
        super().__init__(message)
        self.code, self.status = code, status


@dataclass
class Repository:
    """The commits of a repository, and the branches and tags that name them."""

    commits: dict[str, dict[str, bytes]] = field(default_factory=dict)  # by hash: the content of each path
    branches: dict[str, str] = field(default_factory=dict)
    tags: dict[str, str] = field(default_factory=dict)

    def commit(self, files: Mapping[str, bytes], branch: str = "main", tags: Iterable[str] = ()) -> str:
        """Puts a new state on top of a branch and returns the commit's hash."""
        digest = hashlib.sha1(self.branches.get(branch, "").encode())
        for path, content in sorted(files.items()):
            digest.update(f"{path} {blob_id(content)}\n".encode())
        sha = digest.hexdigest()
        self.commits[sha] = dict(files)
        self.branches[branch] = sha
        self.tags.update(dict.fromkeys(tags, sha))
        return sha

    def resolve(self, revision: str) -> str:
        """The commit that a branch, tag or hash stands for."""
        for names in (self.branches, self.tags, {sha: sha for sha in self.commits}):
            if revision in names:
                return names[revision]
        raise HubError("RevisionNotFound", f"Invalid rev id: {revision}")


class HubServer:
    """A Hub that runs as long as its context."""

    def __init__(self) -> None:
        self.repositories: dict[tuple[str, str], Repository] = {}
        self.broken: set[str] = set()  # repositories at whose mention the connection breaks
        self.requests: list[Request] = []
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), _handler_for(self))
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.05,), daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
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
    ) -> str:
        """Commits a folder, as it is now, to a repository, which appears if need be; returns the commit's hash."""
        files = {
            path.relative_to(folder).as_posix(): path.read_bytes()
            for path in folder.rglob("*")
            if path.is_file()
        }
        return self.repositories.setdefault((repo_type, repo_id), Repository()).commit(files, branch, tags)

    def environment(self, home: Path) -> dict[str, str]:
        """The environment of a process whose Hub is this one and whose caches lie below `home`."""
        others = {
            name: value for name, value in os.environ.items() if not name.startswith(("HF_", "HUGGING"))
        }
        return {
            **others,
            "HF_ENDPOINT": self.url,
            "HF_HOME": str(home),
            "HF_HUB_OFFLINE": "0",
            "HF_HUB_DISABLE_XET": "1",
            "HF_HUB_DISABLE_TELEMETRY": "1",
            "NO_PROXY": "127.0.0.1",
            "no_proxy": "127.0.0.1",
        }


@dataclass(frozen=True)
class Answer:
    """A successful answer."""

    content: bytes
    headers: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Asked:
    """A request, as its handler sees it."""

    hub: HubServer
    parts: Mapping[str, str]  # of the path, as named in ROUTES
    options: Mapping[str, list[str]]
    headers: Mapping[str, str]
    body: bytes

    @property
    def repo_id(self) -> str:
        return self.parts["repo"]

    @property
    def repository(self) -> Repository:
        repo_type = self.parts["type"].strip("/").removesuffix("s") or "model"
        if (repo_type, self.repo_id) not in self.hub.repositories:
            raise HubError("RepoNotFound", "Repository not found")
        return self.hub.repositories[repo_type, self.repo_id]

    @property
    def path(self) -> str:
        return self.parts["path"]

    @property
    def sha(self) -> str:
        return self.repository.resolve(self.parts.get("revision") or "main")

    @property
    def files(self) -> dict[str, bytes]:
        return self.repository.commits[self.sha]


def repository_info(asked: Asked) -> Answer:
    """What `repo_info`, `model_info` and `dataset_info` return."""
    siblings: list[dict[str, Any]] = [{"rfilename": path} for path in sorted(asked.files)]
    if "blobs" in asked.options:
        for sibling in siblings:
            content = asked.files[sibling["rfilename"]]
            sibling.update(size=len(content), blobId=blob_id(content))
    return _json(
        {
            "_id": asked.sha[:24],
            "id": asked.repo_id,
            "author": asked.repo_id.partition("/")[0],
            "sha": asked.sha,
            "private": False,
            "gated": False,
            "disabled": False,
            "tags": [],
            "siblings": siblings,
        }
    )


def references(asked: Asked) -> Answer:
    """What `list_repo_refs` returns."""

    def listed(kind: str, refs: Mapping[str, str]) -> list[dict[str, str]]:
        return [
            {"name": name, "ref": f"refs/{kind}/{name}", "targetCommit": sha} for name, sha in refs.items()
        ]

    repository = asked.repository
    return _json(
        {
            "branches": listed("heads", repository.branches),
            "tags": listed("tags", repository.tags),
            "converts": [],
            "pullRequests": [],
        }
    )


def tree(asked: Asked) -> Answer:
    """What `list_repo_tree` returns, and `snapshot_download` goes by."""
    folder = f"{asked.path}/" if asked.path else ""
    found = {path: entry for path, entry in _entries(asked.files).items() if path.startswith(folder)}
    if folder and not found:
        raise HubError("EntryNotFound", f"{asked.path} does not exist")
    if asked.options.get("recursive") != ["true"]:
        found = {path: entry for path, entry in found.items() if "/" not in path.removeprefix(folder)}
    return _json(list(found.values()))


def paths_info(asked: Asked) -> Answer:
    """What `get_paths_info` returns."""
    entries = _entries(asked.files)
    wanted = parse_qs(asked.body.decode()).get("paths", [])
    return _json([entries[path] for path in wanted if path in entries])


def file_content(asked: Asked) -> Answer:
    """A file, or what `hf_hub_download` wants to know before it asks for that."""
    if asked.path not in asked.files:
        raise HubError("EntryNotFound", "Entry not found")
    content = asked.files[asked.path]
    return Answer(content, {"ETag": f'"{blob_id(content)}"', "X-Repo-Commit": asked.sha})


_API = r"/api/(?P<type>models|datasets)/(?P<repo>[^/]+/[^/]+)"
# The paths are matched while still quoted: a slash inside a revision is no separator.
ROUTES: list[tuple[str, str, Callable[[Asked], Answer]]] = [
    ("GET", rf"{_API}(/revision/(?P<revision>[^/]+))?", repository_info),
    ("GET", rf"{_API}/refs", references),
    ("GET", rf"{_API}/tree/(?P<revision>[^/]+)(/(?P<path>.+))?", tree),
    ("POST", rf"{_API}/paths-info/(?P<revision>[^/]+)", paths_info),
    (
        "GET",
        r"(?P<type>/datasets)?/(?P<repo>[^/]+/[^/]+)/resolve/(?P<revision>[^/]+)/(?P<path>.+)",
        file_content,
    ),
]


def blob_id(content: bytes) -> str:
    """Git's name for a file of this content."""
    return hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()


def _entries(files: Mapping[str, bytes]) -> dict[str, dict[str, Any]]:
    """Files and folders as the Hub describes them, by path."""
    folders = {str(parent) for path in files for parent in Path(path).parents} - {"."}
    entries: dict[str, dict[str, Any]] = {
        path: {"type": "directory", "path": path, "oid": blob_id(path.encode()), "size": 0}
        for path in folders
    }
    for path, content in files.items():
        entries[path] = {"type": "file", "path": path, "oid": blob_id(content), "size": len(content)}
    return dict(sorted(entries.items()))


def _json(value: Any) -> Answer:
    return Answer(json.dumps(value).encode(), {"Content-Type": "application/json"})


def _handler_for(hub: HubServer) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            self._answer("GET")

        def do_HEAD(self) -> None:
            self._answer("HEAD")

        def do_POST(self) -> None:
            self._answer("POST")

        def log_message(self, *_: Any) -> None:
            """Says nothing: `HubServer.requests` keeps what was asked for."""

        def _answer(self, method: str) -> None:
            body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
            if any(repo_id in self.path for repo_id in hub.broken):
                self.close_connection = True
                return
            status = HTTPStatus.OK
            try:
                answer = self._find("GET" if method == "HEAD" else method, body)
            except HubError as error:
                status = error.status
                said = {"X-Error-Code": error.code, "X-Error-Message": str(error)}
                answer = Answer(json.dumps({"error": str(error)}).encode(), said)
            hub.requests.append(Request(method, self.path, status))
            self.send_response(status)
            for name, value in {**answer.headers, "Content-Length": str(len(answer.content))}.items():
                self.send_header(name, value)
            self.end_headers()
            if method != "HEAD":
                self.wfile.write(answer.content)

        def _find(self, method: str, body: bytes) -> Answer:
            url = urlsplit(self.path)
            for wanted, pattern, handle in ROUTES:
                match = re.fullmatch(pattern, url.path)
                if match and method == wanted:
                    parts = {name: unquote(part) for name, part in match.groupdict(default="").items()}
                    return handle(Asked(hub, parts, parse_qs(url.query), self.headers, body))
            raise HubError(
                "NotImplemented", f"this Hub knows no {method} {url.path}", HTTPStatus.NOT_IMPLEMENTED
            )

    return Handler
