# SPDX-License-Identifier: Apache-2.0
"""What a `HubServer` keeps, who may see it, and how a request looks to the functions that answer it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from hub_server import HubServer

RepoType = Literal["model", "dataset"]

_LARGE = {".safetensors", ".parquet", ".png", ".mp4"}  # what goes through the large file storage


class HubError(Exception):
    """An answer other than success, with the code by which `huggingface_hub` tells what is missing."""

    def __init__(
        self, code: str | None, message: str, status: HTTPStatus = HTTPStatus.NOT_FOUND, **more: Any
    ) -> None:
        super().__init__(message)
        self.code, self.status, self.more = code, status, more


@dataclass
class Repository:
    """The commits of a repository, and the branches and tags that name them."""

    is_private: bool = False
    commits: dict[str, dict[str, bytes]] = field(default_factory=dict)  # by hash: the content of each path
    branches: dict[str, str] = field(default_factory=dict)
    tags: dict[str, str] = field(default_factory=dict)
    messages: dict[str, str] = field(default_factory=dict)  # of the commits that clients have sent

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

    def files(self, revision: str = "main") -> dict[str, bytes]:
        """The content of each path."""
        return self.commits[self.resolve(revision)]


@dataclass(frozen=True)
class Answer:
    """A successful answer."""

    content: bytes
    headers: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Asked:
    """A request, as the function sees it that answers it."""

    hub: HubServer
    parts: Mapping[str, str]  # of the path, as named in the routes
    options: Mapping[str, list[str]]
    headers: Mapping[str, str]
    body: bytes

    @property
    def user(self) -> str | None:
        """Who asks; None without a token."""
        token = (self.headers.get("Authorization") or "").removeprefix("Bearer ")
        if token and token not in self.hub.users:
            message = "Invalid credentials in Authorization header"
            raise HubError(None, message, HTTPStatus.UNAUTHORIZED)
        return self.hub.users[token] if token else None

    @property
    def writer(self) -> str:
        """Who asks, if the token allows to write at all."""
        user = self.user
        if user is None:
            raise HubError(None, "Invalid username or password.", HTTPStatus.UNAUTHORIZED)
        if self.headers["Authorization"].removeprefix("Bearer ") in self.hub.only_reads:
            raise HubError(None, "Your token has no write permission", HTTPStatus.FORBIDDEN)
        return user

    @property
    def repo_id(self) -> str:
        return self.parts["repo"]

    @property
    def repo_type(self) -> str:
        return self.parts["type"].strip("/").removesuffix("s") or "model"

    @property
    def repository(self) -> Repository:
        """The repository, if whoever asks may see it; otherwise the Hub does not say whether there is one."""
        user = self.user
        repository = self.hub.repositories.get((self.repo_type, self.repo_id))
        if repository is None or (repository.is_private and user != self.repo_id.partition("/")[0]):
            status = HTTPStatus.NOT_FOUND if user else HTTPStatus.UNAUTHORIZED
            raise HubError("RepoNotFound", "Repository not found", status)
        return repository

    @property
    def own_repository(self) -> Repository:
        """The repository, if whoever asks may write to it."""
        repository = self.repository
        if self.writer != self.repo_id.partition("/")[0]:
            raise HubError(
                None, "You have read access but not the required permissions", HTTPStatus.FORBIDDEN
            )
        return repository

    @property
    def path(self) -> str:
        return self.parts["path"]

    @property
    def revision(self) -> str:
        return self.parts.get("revision") or "main"

    @property
    def sha(self) -> str:
        return self.repository.resolve(self.revision)

    @property
    def files(self) -> dict[str, bytes]:
        return self.repository.files(self.revision)

    @property
    def json(self) -> dict[str, Any]:
        return json.loads(self.body)


def json_answer(value: Any) -> Answer:
    """A successful answer in JSON."""
    return Answer(json.dumps(value).encode(), {"Content-Type": "application/json"})


def is_large(path: str) -> bool:
    """Whether a file goes through the large file storage."""
    return Path(path).suffix in _LARGE


def content_id(path: str, content: bytes) -> str:
    """What the Hub calls a file of this content."""
    return hashlib.sha256(content).hexdigest() if is_large(path) else blob_id(content)


def blob_id(content: bytes) -> str:
    """Git's name for a file of this content."""
    return hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()
